"""Everything that takes bytes, texts or values from outside, as functions that may raise InputError alone."""

from __future__ import annotations

import io
import json
import random
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import e57_target
import numpy as np
from mutation import ODD_WORDS, mutant, odd_json, odd_text
from PIL import Image
from recording_targets import recording_runs
from request_target import request_run

import sample_files
from lidar2pano.bulk.entries import Shard
from lidar2pano.bulk.manifest import _made, _parsed
from lidar2pano.calibration import read_calib
from lidar2pano.cli import options
from lidar2pano.cli.inspect import described
from lidar2pano.data import kitti360, nuscenes, pandaset, semantic_kitti
from lidar2pano.data.camera_files import camera_matrix, read_camera_calibration
from lidar2pano.data.journal import Journal, Record, Stamp
from lidar2pano.data.poses import lidar_poses
from lidar2pano.drives.folders import times
from lidar2pano.errors import InputError
from lidar2pano.formats.arrays import cloud_of_message
from lidar2pano.formats.image_files import read_image
from lidar2pano.formats.interpretation import Overrides, interpret
from lidar2pano.formats.json_files import parse_json, validated
from lidar2pano.formats.readers import READERS
from lidar2pano.formats.scan_files import read_label
from lidar2pano.geometry.projection import Normalisation
from lidar2pano.models.card import Card, read_card
from lidar2pano.reproduce.run import budget
from lidar2pano.simulate.settings import WorldSettings, claim_folder, panorama_view
from lidar2pano.train.checkpoint import Progress, check_recipe
from lidar2pano.train.recipe import Network, Optimizer, override, resolved
from lidar2pano.train.recipes import RECIPES, recipe_named
from lidar2pano.views import VIEWS, View
from miniature_layouts import write_kitti360_layout
from random_weights import CALIB
from workshop import CAMERA_YAML

POINTS = 128  # of the scans that are damaged: `inspect` finds beams in 80 or more
IDENTITY = np.eye(4).tolist()
CAMERA = {"K": {"fx": 500.0, "fy": 500.0, "cx": 240.0, "cy": 150.0}, "size": [480, 300], "cam_from_lidar": IDENTITY}
PANDASET = {"cameras": {"front_camera": CAMERA, "back_camera": CAMERA}, "world_from_lidar": IDENTITY}
NUSCENES_CAMERA = {"img_path": "a.jpg", "cam2img": np.eye(3).tolist(), "lidar2cam": IDENTITY}
NUSCENES = {
    "data_list": [
        {
            "sample_idx": 3,
            "images": {"CAM_FRONT": NUSCENES_CAMERA},
            "lidar_points": {"lidar_path": "a.bin", "lidar2ego": IDENTITY},
            "ego2global": IDENTITY,
        }
    ]
}
Mutate = Callable[[random.Random, bytes], bytes]


class Target(NamedTuple):
    """Something that is fed with mutants of `seeds`; `run` may raise InputError, anything else is a fault."""

    seeds: Sequence[bytes]
    mutate: Mutate
    run: Callable[[bytes], object]


def bytes_of(seeds: Sequence[bytes]) -> Mutate:
    return lambda draw, data: mutant(draw, data, seeds)


def mixed(special: Mutate, seeds: Sequence[bytes]) -> Mutate:
    """Mostly the special mutation, sometimes one of bytes."""
    return lambda draw, data: mutant(draw, data, seeds) if draw.random() < 0.3 else special(draw, data)


def decoded(data: bytes, path: Path, name: str) -> None:
    """A scan file of any format, as the command reads it."""
    reader = next((one for one in READERS if one.name == name), None)
    with suppress(InputError):
        for other in READERS:
            other.accepts(data[:4096], path)
    assert reader is not None
    cloud = reader.decode(data, path)  # pyright: ignore[reportAttributeAccessIssue]
    assert len(cloud) == len(cloud.xyz)
    if len(data) % 16 == 0:
        described(*interpret(cloud, Overrides()))


def from_file(folder: Path, name: str, read: Callable[[Path], object]) -> Callable[[bytes], object]:
    path = folder / name

    def run(data: bytes) -> None:
        path.write_bytes(data)
        read(path)

    return run


def json_as(cls: type) -> Callable[[bytes], object]:
    return lambda data: validated(cls, parse_json(data, "file"), "file")


def odd_files(xyz: np.ndarray, ring: np.ndarray) -> dict[str, bytes]:
    """Files with values, columns and claims of geometry like those in people's reports."""
    spikes = np.where(np.arange(len(xyz)) % 50 == 7, 3e4, sample_files.remission(len(xyz)))
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty list uchar short a\n"
    header += b"".join(b"property float %c\n" % axis for axis in b"xyz") + b"property list uchar short b\nend_header\n"
    vertices = [b"\2aabb" + row.tobytes() + b"\1cc" for row in xyz[:3].astype("<f4")]
    posed = sample_files.pcd(xyz[:, [0, 2, 1]] * [1, 1, -1], spikes)
    table = "".join(f"{x:.3f};{y:.3f};{z:.3f};9\n" for x, y, z in xyz[:9]).replace(".", ",")
    clocks = "".join(f"2024-01-02T03:04:05.{place:03d},{x},{y},{z},9\n" for place, (x, y, z) in enumerate(xyz[:9]))
    return {
        "decimals.csv": f"X [mm];Y [mm];Z [mm];Intensity (0-255)\n{table}".encode(),
        "studio.csv": f'"Point:0";"Point:1";"Point:2";"Signal Photons"\n{table}'.encode(),
        "legacy.csv": "T,X\u5750\u6807,Y\u5750\u6807,Z\u5750\u6807,\u53cd\u5c04\u5f3a\u5ea6\n".encode("gbk")
        + clocks.encode(),
        "matrices.txt": b"1 0 0 0.5 0 1 0 2.5 0 0 1 0\n" * 12,
        "path.bin": np.linspace((0, 0, 0, 0), (400, 30, 2, 1), 200, dtype="<f4").tobytes(),
        "records.npy": sample_files.npy(np.array(np.rec.fromarrays(np.column_stack([xyz, spikes]).T))),
        "lists.ply": header + b"".join(vertices),
        "wide.bin": sample_files.rows(xyz, spikes, ring, np.arange(len(xyz)) * 1e-6, ring % 3),
        "posed.pcd": posed.replace(b"VIEWPOINT 0 0 0 1 0", b"VIEWPOINT 1 2 3 .7 -.7"),
        "ranges.npy": sample_files.npy(np.column_stack([np.linalg.norm(xyz, axis=1), xyz, spikes])),
    }


def scan_targets() -> dict[str, Target]:
    xyz, ring = sample_files.street(beams=4, columns=POINTS // 4)
    files = sample_files.every_format(xyz, ring) | odd_files(xyz, ring)
    packers = {"packed.bin.gz", "packed.bin.zst"}
    found = {}
    for file, content in files.items():
        if file in packers:
            continue
        path = Path(file)
        (name, *_) = [reader.name for reader in READERS if reader.accepts(content[:4096], path)]
        seeds = [content]
        textual = content[:200].isascii()
        mutate = mixed(odd_text, seeds) if textual and b" " in content else bytes_of(list(files.values()))
        found[f"scan {file}"] = Target(seeds, mutate, partial(decoded, path=path, name=name))
    if data := e57_target.seed(xyz):
        found["scan a.e57"] = Target(
            [data], e57_target.change([data]), partial(decoded, path=Path("a.e57"), name="E57")
        )
    return found


def json_targets(folder: Path) -> dict[str, Target]:
    """JSON files: those that become typed values at once, and those of data sets."""
    card = Card(network="salsanext", settings={"classes": 20}, views={"input": VIEWS["hdl64e"].as_dict()}, hours=0.5)
    stamp = Stamp(sha256="0" * 64, size=3, changed_ns=4)
    typed = {
        Card: json.loads(card.to_json()),
        Progress: asdict(Progress(step=3, seconds=2.5, validated=3, best=0.5)),
        View: VIEWS["panorama"].as_dict(),
        Normalisation: asdict(Normalisation()),
        Record: asdict(Record(file="labels/0.label", made_by="x", source=stamp, stamp=stamp)),
        WorldSettings: asdict(WorldSettings()),
        Optimizer: asdict(Optimizer()),
        Network: {"model": "salsanext", "settings": {"classes": 20}, "start": ""},
    }
    found = {f"json {cls.__name__}": ([json.dumps(value).encode()], json_as(cls)) for cls, value in typed.items()}
    root = folder / "pandaset"
    (root / "sequences" / "1" / "calib").mkdir(parents=True)
    calib = from_file(root / "sequences" / "1" / "calib", "0.json", partial(read_pandaset, root))
    found["json pandaset"] = ([json.dumps(PANDASET).encode()], calib)
    classes = from_file(root, "classes.json", pandaset.class_table)
    found["json classes"] = ([json.dumps({"5": "Vegetation", "7": "Road"}).encode()], classes)
    found["json nuscenes"] = ([json.dumps(NUSCENES).encode()], from_file(folder, "info.json", read_nuscenes))
    (folder / "kitti" / "sequences").mkdir(parents=True)
    splits = from_file(folder / "kitti", "splits.json", lambda path: semantic_kitti.frames(path.parent, "val"))
    found["json splits"] = ([b'{"val": [], "train": ["00/000001"]}'], splits)
    world = from_file(folder, "world.json", lambda path: claim_folder(path.parent, WorldSettings()))
    found["json world"] = ([json.dumps(WorldSettings().as_dict()).encode()], world)
    recipe = recipe_named("titan-mini")
    (folder / "run" / "checkpoints" / "000000001").mkdir(parents=True)
    run = from_file(folder / "run", "recipe.json", lambda path: check_recipe(path.parent, recipe))
    found["json recipe"] = ([json.dumps(resolved(recipe)).encode()], run)
    stamps = from_file(folder, "timestamps.json", lambda path: times([path.with_name("000000.bin")]))
    found["json times"] = ([b"[0.0, 0.1, 0.2]"], stamps)
    return {name: Target(seeds, mixed(odd_json, seeds), run) for name, (seeds, run) in found.items()}


def read_pandaset(root: Path, _: Path) -> None:
    frame = pandaset.PandasetFrame(root, VIEWS["panorama"], "1/0")
    path, content = frame.calib
    assert frame.pose.shape == frame.T_sensor_file.shape == (4, 4)
    for camera in content["cameras"].values():
        if isinstance(camera, dict):
            camera_matrix(path, camera)


def read_nuscenes(path: Path) -> None:
    for frame in nuscenes.info_frames(path.parent, "all", VIEWS["panorama"]):
        assert frame.pose is not None
        with suppress(InputError):  # its image is not there
            frame.calibration  # noqa: B018
        with suppress(InputError):
            frame.scan  # noqa: B018


def read_camera(path: Path) -> None:
    camera = read_camera_calibration(path, Path("a.png"), (480, 300))
    assert np.isfinite(camera.T_camera_lidar).all() and np.isfinite(camera.centre).all()


def read_fisheyes(path: Path) -> None:
    for lens in kitti360.fisheye_calibrations(path.parents[1]).values():
        assert lens.project(np.eye(3)).shape == (3, 2)


def text_targets(folder: Path) -> dict[str, Target]:
    """Texts, and binary files that are no scans."""
    sequence = folder / "sequence"
    sequence.mkdir()
    (sequence / "calib.txt").write_text(CALIB)
    png = io.BytesIO()
    Image.fromarray(np.arange(192, dtype=np.uint8).reshape(8, 8, 3)).save(png, "png")
    jpeg = io.BytesIO()
    Image.fromarray(np.arange(192, dtype=np.uint8).reshape(8, 8, 3)).save(jpeg, "jpeg")
    images = [png.getvalue(), jpeg.getvalue()]
    pose = b"1 0 0 0 0 1 0 0 0 0 1 0\n"
    calibration = write_kitti360_layout(folder / "kitti-360", (), fisheyes=True) / "calibration"
    fisheye = (calibration / "image_02.yaml").read_bytes()
    record = json.dumps({"input": "a", "outputs": ["b"], "error": None, "sha256": ""}).encode() + b"\n"
    journal = json.dumps({"file": "a", "made_by": "b", "source": {}, "stamp": {}}).encode() + b"\n"

    def poses(path: Path) -> None:
        found = lidar_poses(path.parent)
        assert found is None or np.isfinite(found.rows).all()

    found: dict[str, tuple[list[bytes], Mutate, Callable[[bytes], object]]] = {
        "calib.txt": ([CALIB.encode()], odd_text, from_file(folder, "calib.txt", read_calib)),
        "camera.yaml": ([CAMERA_YAML.encode()], odd_text, from_file(folder, "camera.yaml", read_camera)),
        "poses.txt": ([pose * 3], odd_text, from_file(sequence, "poses.txt", poses)),
        "times.txt": (
            [b"0.0\n0.1\n0.2\n", b"2011-09-26 13:02:25.964389445\n"],
            odd_text,
            from_file(sequence, "times.txt", lambda path: times([path.with_name("000000.bin")])),
        ),
        "fisheye": ([fisheye], odd_text, from_file(calibration, "image_02.yaml", read_fisheyes)),
        "image": (images, bytes_of(images), from_file(folder, "a.png", lambda path: read_image(path, "RGB"))),
        "label": ([bytes(64)], bytes_of([bytes(64)]), from_file(folder, "a.label", lambda path: read_label(path, 16))),
        "manifest": ([record], odd_json, lambda data: [_made(one) for one in _parsed(data)]),
        "journal": ([journal], odd_json, from_file(folder, "prepared.jsonl", lambda path: Journal(path.parent))),
    }
    return {
        name: Target(seeds, mixed(special, seeds) if special in (odd_text, odd_json) else special, run)
        for name, (seeds, special, run) in found.items()
    }


def weight_target(folder: Path, weights: bytes) -> dict[str, Target]:
    """The header of a weight file: only the card is read."""
    read = from_file(folder, "a.safetensors", read_card)
    return {"weights": Target([weights], _head_changed, read)}


def _head_changed(draw: random.Random, data: bytes) -> bytes:
    return mutant(draw, data[:4000], [data]) + data[4000:]


def option_targets() -> dict[str, Target]:
    """Words of the command line: values of recipes by name, and options with a form of their own."""
    seeds = []
    recipes = {name: recipe_named(name) for name in RECIPES}
    for name, recipe in recipes.items():
        seeds += [f"{name} {path}={value}".encode() for path, value in _leaves(resolved(recipe)) if path != "task"]

    def change(data: bytes) -> None:
        name, _, words = data.decode("utf-8", "surrogatepass").partition(" ")
        if name in recipes:
            changed = override(recipes[name], words)
            json.dumps(resolved(changed), allow_nan=False)

    def odd_value(draw: random.Random, data: bytes) -> bytes:
        path, _, value = data.partition(b"=")
        if draw.random() < 0.3:
            return path + b"=" + mutant(draw, value, seeds).decode("latin-1").encode()
        return path + b"=" + draw.choice(ODD_WORDS).encode("utf-8", "surrogatepass")

    parsers: dict[str, tuple[list[str], Callable[[str], Any]]] = {
        "budget": (["90s", "20m", "2h", "5000steps"], budget),
        "image size": (["1242x375"], options.parse_size),
        "save": (["rgb,segments", "all"], options.parse_save),
        "shard": (["0/1", "3/17"], Shard.parsed),
        "view": (["panorama", "panorama/2"], panorama_view),
    }
    found = {"option recipe": Target(seeds, odd_value, change)}
    for name, (words, parse) in parsers.items():
        texts = [word.encode() for word in words]
        run = partial(_parse, parse)
        found[f"option {name}"] = Target(texts, mixed(odd_text, texts), run)
    return found


def _parse(parse: Callable[[str], Any], data: bytes) -> None:
    parse(data.decode("latin-1"))


def _leaves(value: Any, path: str = "") -> list[tuple[str, Any]]:
    if isinstance(value, dict):
        return [leaf for key, part in value.items() for leaf in _leaves(part, f"{path}.{key}" if path else key)]
    return [(path, ",".join(map(str, value)) if isinstance(value, list) else value)]


def message_target() -> dict[str, Target]:
    """A PointCloud2 whose numbers are not those of its data."""
    fields = [{"name": name, "offset": 4 * place, "datatype": 7, "count": 1} for place, name in enumerate("xyz")]
    numbers = {"height": 1, "width": 8, "point_step": 16, "row_step": 128, "is_bigendian": False, "fields": fields}
    seeds = [json.dumps(numbers).encode()]

    def run(data: bytes) -> None:
        value = json.loads(data)
        try:  # a message's fields have these types, whatever sent it
            changed = {key: int(value[key]) % 2**32 for key in numbers if key != "fields"}
            parts = [
                SimpleNamespace(
                    name=str(one["name"]), **{key: int(one[key]) % 2**32 for key in ("offset", "datatype", "count")}
                )
                for one in value["fields"]
            ]
        except (KeyError, TypeError, ValueError, OverflowError):
            return
        cloud_of_message(SimpleNamespace(**changed, fields=parts, data=bytes(128)))

    return {"message": Target(seeds, odd_json, run)}


def recording_targets(folder: Path) -> dict[str, Target]:
    """Recordings of a drive, of every format."""
    runs = recording_runs(folder)
    every = [data for data, _ in runs.values()]
    return {f"recording {name}": Target([data], bytes_of(every), run) for name, (data, run) in runs.items()}


def request_target(folder: Path) -> dict[str, Target]:
    """Requests to the service."""
    seeds, run = request_run(folder)

    def change(draw: random.Random, data: bytes) -> bytes:
        head, _, body = data.partition(b"\n\n")
        if draw.random() < 0.5:
            head = odd_text(draw, head) if draw.random() < 0.5 else mutant(draw, head, seeds)
        else:
            body = mutant(draw, body, seeds)
        return head + b"\n\n" + body

    return {"request": Target(seeds, change, run)}


def all_targets(folder: Path, weights: bytes) -> dict[str, Target]:
    """Every target by name; `folder` is where files lie that are read by name."""
    return {
        **scan_targets(),
        **json_targets(folder),
        **text_targets(folder),
        **weight_target(folder, weights),
        **option_targets(),
        **message_target(),
        **recording_targets(folder),
        **request_target(folder),
    }
