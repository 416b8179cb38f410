"""Frames: what each layout of a data set knows of a frame, and what is said of damaged files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
import torch
from PIL import Image

from lidar2pano.data import frames as frames_module
from lidar2pano.data import semantic_kitti
from lidar2pano.data.frames import CITYSCAPES_TO_COMMON15, IGNORE, Frame
from lidar2pano.data.layouts import frames, frames_of
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import write_depth, write_palette, write_png
from lidar2pano.geometry.projection import pixels, project
from lidar2pano.labels import CITYSCAPES, COMMON15, SEMANTIC_KITTI
from lidar2pano.views import VIEWS, View
from miniature import CALIB, SIZE, street, write_data_set
from miniature_surround import write_nuscenes, write_pandaset

EIGHTH, QUARTER = (VIEWS["panorama"].scaled(1 / part) for part in (8, 4))


@pytest.fixture(scope="module")
def layout(tmp_path_factory) -> Path:
    return write_data_set(tmp_path_factory.mktemp("layout") / "set")


def write_world(root: Path) -> Path:
    """The miniature with what `lidar2pano world` writes besides: a card, poses, and panoramas of known contents."""
    write_data_set(root)
    (root / "world.json").write_text(json.dumps({"views": ["panorama/8", "panorama/4"]}))
    rows, columns = EIGHTH.rows, EIGHTH.columns
    for folder in (root / "sequences").iterdir():
        for part in ("pano", "pano_labels", "pano_depth"):
            (folder / part).mkdir()
        # camera 0 moves 2 m along its axis from frame to frame, and then to its right: our x and -y
        poses = [np.column_stack([np.eye(3), at]) for at in ((5.0, 0, 0), (5.0, 0, 2), (6.0, 0, 2))]
        (folder / "poses.txt").write_text("".join(" ".join(map(str, pose.ravel())) + "\n" for pose in poses))
        for scan in (folder / "velodyne").iterdir():
            column = np.tile(np.arange(columns), (rows, 1))
            colour = np.stack([column % 251, column // 251, np.full_like(column, int(scan.stem))], axis=-1)
            write_png(folder / "pano" / f"{scan.stem}.png", colour.astype(np.uint8))
            write_palette(folder / "pano_labels" / f"{scan.stem}.png", (column % 16).astype(np.uint8))
            write_depth(folder / "pano_depth" / f"{scan.stem}.png", column / 4.0)
    return root


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> Path:
    return write_world(tmp_path_factory.mktemp("world") / "set")


def test_a_frame_names_every_file_of_its_parts(world):
    named = {path for frame in frames_of(world, ("train", "val")) for path in frame.source_files}
    assert {path for path in world.rglob("*") if path.is_file()} - named == {world / "splits.json"}


PARTS = {"name", "scan", "point_labels", "calibration", "image", "camera_labels", "pose", "panorama"}


def known(frame: Frame) -> set[str]:
    return {name for name in sorted(PARTS) if getattr(frame, name) is not None}


def test_a_set_in_the_layout_tells_what_its_files_tell(layout):
    found = frames(layout, "train")
    assert len(found) == 3
    assert found.names == ("00/000000", "00/000001", "00/000002") == tuple(one.name for one in found)
    frame = found[1]
    assert known(frame) == {"name", "scan", "calibration", "image", "camera_labels", "point_labels"}
    assert frame.scan.name == "00/000001" and frame.scan.label is None, "who is measured must not see labels"
    assert frame.calibration is not None and frame.calibration.size == SIZE
    assert frame.image is not None and frame.image.shape == (72, 240, 3) and frame.image.dtype == np.uint8
    assert frame.image[71, 100].tolist() == [90, 90, 95]
    assert frame.camera_labels is not None and frame.camera_labels.shape == (72, 240)
    assert (frame.camera_labels[:, :5] == IGNORE).all(), "unsure is masked"
    named = {CITYSCAPES.classes[i] for i in np.unique(frame.camera_labels[:, 5:])}
    assert named == {"sky", "building", "road"} and CITYSCAPES.classes[frame.camera_labels[70, 100]] == "road"
    common = CITYSCAPES_TO_COMMON15[frame.camera_labels]
    assert (common[:, :5] == IGNORE).all() and COMMON15.classes[common[70, 100]] == "road"
    assert frame.point_labels is not None and np.array_equal(frame.point_labels, street(1).label)


def test_what_is_not_there_is_none(tmp_path):
    root = write_data_set(tmp_path / "set")
    folder = root / "sequences" / "00"
    (folder / "image_2" / "000000.png").unlink()
    (folder / "labels" / "000001.label").unlink()
    (folder / "camera_labels" / "000002.png").unlink()
    a, b, c = frames(root, "train")
    assert known(a) == {"name", "scan", "calibration", "camera_labels", "point_labels"}
    assert known(b) == {"name", "scan", "calibration", "image", "camera_labels"}
    assert known(c) == {"name", "scan", "calibration", "image", "point_labels"}
    for part in ("camera_labels", "labels"):
        (folder / part / "000000.png").unlink(missing_ok=True)
        (folder / part / "000000.label").unlink(missing_ok=True)
    (folder / "calib.txt").unlink()
    assert known(frames(root, "train")[0]) == {"name", "scan"}, "a bare scan needs no calibration"
    with pytest.raises(InputError, match="calib.txt"):
        _ = frames(root, "train")[1].calibration


def test_a_world_tells_everything(world):
    found = frames(world, "train")
    frame = found[2]
    assert known(frame) == PARTS
    around, calibration = frame.panorama, frame.calibration
    assert around is not None and calibration is not None
    assert around.view.origin == pytest.approx(calibration.centre) and around.view.columns == EIGHTH.columns
    assert around.valid.all() and around.valid.shape == around.depth_m.shape == (48, 576)
    assert around.image[7, 300].tolist() == [300 % 251, 1, 2] and around.image.dtype == np.uint8
    assert (
        around.labels is not None
        and around.labels.dtype == np.uint8
        and (around.labels[5] == np.arange(576) % 16).all()
    )
    assert around.depth_m.dtype == np.float32 and (around.depth_m[9] == np.arange(576) / 4).all()


def test_poses_lead_to_the_first_frames_place(world):
    a, b, c = (one.pose for one in frames(world, "train"))
    assert a == pytest.approx(np.eye(4), abs=1e-9)
    assert b is not None and b[:3, 3] == pytest.approx([2, 0, 0], abs=1e-9)
    assert c is not None and c[:3, 3] == pytest.approx([2, -1, 0], abs=1e-9)


def test_parts_are_read_on_first_access_and_go_with_their_frame(world, monkeypatch):
    read: list[str] = []

    def counted(name: str) -> None:
        real = getattr(semantic_kitti, name)
        monkeypatch.setattr(semantic_kitti, name, lambda path, *rest: read.append(path.name) or real(path, *rest))

    for name in ("read_bin", "read_label", "read_image", "read_calib"):
        counted(name)
    found = frames(world, "train")
    assert len(found) == 3 and found.names[1:] == found[1:].names
    frame = found[-1]
    assert frame.name == "00/000002" and not read
    assert frame.point_labels is not None and read == ["000002.label"], "the scan is not read for them"
    assert frame.scan is frame.scan and frame.image is frame.image
    assert read[1:] == ["000002.bin", "000002.png"]
    assert found[-1].scan is not frame.scan, "nothing is held"
    with pytest.raises(IndexError):
        found[3]


def test_frames_may_be_made_of_their_parts(layout):
    scan = frames(layout, "train")[0].scan
    frame = Frame("a/1", scan=scan, point_labels=np.zeros(len(scan), np.int64))
    assert known(frame) == {"name", "scan", "point_labels"} and frame.scan is scan
    with pytest.raises(InputError, match="a/1: this data set has no camera labels"):
        frame.require("scan", "camera_labels")


def test_what_is_required_is_there_or_its_file_is_named(world, layout):
    frame = frames(world, "train")[0]
    scan, image = frame.require("scan", "image")
    assert scan is frame.scan and image is frame.image
    path = layout / "sequences/00"
    for part, message in (
        ("pose", f"{path / 'poses.txt'}: is missing"),
        ("panorama", f"{path / 'pano/000000.png'}: is missing; only simulated data sets"),
    ):
        with pytest.raises(InputError) as caught:
            frames(layout, "train")[0].require("scan", part)
        assert str(caught.value).startswith(message)


def test_splits_join_and_a_split_named_twice_counts_twice(layout, world):
    joined = frames_of(layout, ("train", f"{world}:val", "train"))
    train, val = frames(layout, "train").names, frames(world, "val").names
    assert joined.names == (*train, *val, *train) and len(joined) == 8
    assert joined[3].panorama is not None and joined[2].panorama is None
    with pytest.raises(InputError, match="nowhere"):
        frames_of(layout, (f"{layout}/nowhere:train",))


def test_listing_looks_once_into_each_sequence(tmp_path, monkeypatch):
    names = [f"{number % 2:02d}/{number:06d}" for number in range(20_000)]
    for sequence in ("00", "01"):
        (tmp_path / "sequences" / sequence / "velodyne").mkdir(parents=True)
    for name in names:
        (tmp_path / "sequences" / name.replace("/", "/velodyne/")).with_suffix(".bin").touch()
    (tmp_path / "splits.json").write_text(json.dumps({"train": names}))
    looked: list[Path] = []
    real, stat = frames_module.os.scandir, Path.stat
    monkeypatch.setattr(frames_module.os, "scandir", lambda path: looked.append(path) or real(path))
    monkeypatch.setattr(Path, "stat", lambda path, **how: looked.append(path) or stat(path, **how))
    assert frames(tmp_path, "train").names == tuple(names)
    assert len(looked) < 10, "neither the files nor the frames are looked at one by one"
    assert [path.parent.name for path in looked if path.name == "velodyne"] == ["00", "01"]


@pytest.fixture(scope="module")
def painted(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("painted")
    write_pandaset(root / "pandaset")
    write_nuscenes(root / "nuscenes")
    return root


@pytest.mark.parametrize("data_set", ["pandaset", "nuscenes"])
def test_surround_frames_tell_the_panorama(painted, data_set):
    (frame,) = frames(painted / data_set, "all", QUARTER)
    labelled = {"point_labels"} if data_set == "pandaset" else set()
    assert known(frame) == {"name", "scan", "calibration", "image", "panorama", "pose"} | labelled
    assert frame.scan.label is None and frame.scan.name == frame.name
    around, front = frame.panorama, frame.calibration
    assert around is not None and front is not None and around.depth_m is not None
    assert around.view == View(**QUARTER.as_dict() | {"origin": front.centre})
    size = (around.view.rows, around.view.columns)
    assert around.image.shape == (*size, 3) and around.valid.shape == size and around.depth_m.shape == size
    assert around.valid.mean() > 0.9
    # the front camera's picture, looked up by hand, is the panorama ahead
    row, column = 48, 576
    azimuth = np.radians(180 - (column + 0.5) / 1152 * 360)
    slope = 0.24 - (row + 0.5) / 96 * 0.5236
    ray = front.K @ front.T_camera_lidar[:3, :3] @ (np.cos(azimuth), np.sin(azimuth), slope)
    u, v = (ray[:2] / ray[2]).round().astype(int)
    assert frame.image is not None
    assert np.abs(around.image[row, column].astype(int) - frame.image[v, u]).max() <= 4
    image = project(frame.scan, around.view)
    assert np.array_equal(around.depth_m, image.channels[0].numpy()), "nothing of it is guessed"
    assert 0.2 < (around.depth_m > 0).mean() < 0.99


def test_surround_ids_are_those_of_labelled_points(painted):
    (frame,) = frames(painted / "pandaset", "all", QUARTER)
    around = frame.panorama
    assert (
        around is not None
        and around.labels is not None
        and around.labels.dtype == np.uint8
        and frame.point_labels is not None
    )
    assert set(np.unique(around.labels)) == {COMMON15.id_of("road"), COMMON15.id_of("building"), IGNORE}
    assert np.array_equal(around.labels == IGNORE, around.depth_m == 0)
    number = 51_234
    x, y, z = (float(v) for v in frame.scan.xyz[number] - np.float32(around.view.origin))
    row, column = (int(part) for part in pixels(*torch.tensor([[x], [y], [z]]).unbind(0), around.view))
    assert SEMANTIC_KITTI.classes[frame.point_labels[number]] == COMMON15.classes[around.labels[row, column]]
    (none,) = frames(painted / "nuscenes", "all", QUARTER)
    assert none.panorama is not None and none.panorama.labels is None


def test_unlabeled_points_are_ignored(painted, tmp_path):
    root = tmp_path / "set"
    copytree(painted / "pandaset", root)
    path = root / "sequences/002/labels_pandaset/000000.label"
    ids = np.fromfile(path, "<u4")
    ids[:] = 0
    ids.tofile(path)
    (frame,) = frames(root, "all", QUARTER)
    assert frame.panorama is not None and frame.panorama.labels is not None
    assert (frame.panorama.labels == IGNORE).all() and frame.point_labels is not None and not frame.point_labels.any()


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "a panorama without classes": (
        lambda r: (r / "sequences/01/pano_labels/000000.png").unlink(),
        r"pano_labels/000000.png: is missing",
    ),
    "a damaged panorama": (
        lambda r: (r / "sequences/01/pano_depth/000000.png").write_bytes(b"no"),
        r"pano_depth/000000.png: is no readable image",
    ),
    "another raster": (
        lambda r: (r / "world.json").write_text('{"views": ["panorama/4"]}'),
        r"pano/000000.png: is \(48, 576, 3\) uint8, not 96x1152x3",
    ),
    "no raster": (lambda r: (r / "world.json").write_text('{"views": []}'), r"world.json: names no view"),
    "an unknown raster": (lambda r: (r / "world.json").write_text('{"views": ["x"]}'), r"world.json: names no view"),
    "half a card": (lambda r: (r / "world.json").write_text("{"), r"world.json: is no JSON"),
    "poses too short": (lambda r: (r / "sequences/01/poses.txt").write_text(""), r"poses.txt"),
    "another size": (
        lambda r: Image.new("RGB", (10, 10)).save(r / "sequences/01/image_2/000000.png"),
        r"camera_labels/000000.png: is 240x72 and its image 10x10",
    ),
    "too few labels": (
        lambda r: (r / "sequences/01/labels/000000.label").write_bytes(b"1234"),
        r"000000.label: 4 bytes",
    ),
    "another size of labels": (
        lambda r: Image.new("L", (12, 10)).save(r / "sequences/01/camera_labels/000000.png"),
        r"camera_labels/000000.png: is 12x10 and its image 240x72",
    ),
    "ids of another kind": (
        lambda r: Image.new("L", SIZE, 33).save(r / "sequences/01/camera_labels/000000.png"),
        r"camera_labels/000000.png: holds class 33; write Cityscapes train ids, 0 to 18, and 255",
    ),
    "labels in colours": (
        lambda r: Image.new("RGB", SIZE).save(r / "sequences/01/camera_labels/000000.png"),
        r"camera_labels/000000.png: is no image of class ids",
    ),
    "a torn image": (
        lambda r: tear(r / "sequences/01/image_2/000000.png"),
        r"image_2/000000.png: is no readable image",
    ),
    "an image with a damaged header": (
        lambda r: spoil(r / "sequences/01/image_2/000000.png"),
        r"image_2/000000.png: is no readable image",
    ),
    "splits that are none": (lambda r: (r / "splits.json").write_text("[1]"), r"splits.json: must be an object"),
    "a split that is none": (lambda r: (r / "splits.json").write_text('{"val": 3}'), r"split 'val' must be a list"),
    "a name that is none": (lambda r: (r / "splits.json").write_text('{"val": ["x"]}'), r"split 'val' must be a list"),
    "deep splits": (lambda r: (r / "splits.json").write_text("[" * 10**5), r"splits.json: is no JSON"),
    "a card that is none": (lambda r: (r / "world.json").write_text("[]"), r"world.json: names no view"),
    "poses that are no rotations": (
        lambda r: (r / "sequences/01/poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" + "0 " * 12 + "\n"),
        r"poses.txt: line 2 holds no rotation",
    ),
    "no calibration": (lambda r: (r / "sequences/01/calib.txt").write_text(CALIB[:20]), r"calib.txt: row P2"),
}


def tear(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-300])


def spoil(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[16:24] = b"\x7f\xff\xff\xff" * 2  # the header's width and height
    path.write_bytes(data)


@pytest.mark.parametrize("damage", DAMAGES)
def test_what_is_damaged_is_said_in_one_line(world, tmp_path, damage):
    harm, message = DAMAGES[damage]
    root = tmp_path / "set"
    copytree(world, root)
    harm(root)
    with pytest.raises(InputError, match=message) as caught:
        known(frames(root, "val")[0])
    assert str(root) in str(caught.value) and "\n" not in str(caught.value)


def test_a_folder_of_no_known_layout_is_refused(tmp_path, layout, painted):
    with pytest.raises(InputError, match=r"is no data set; name one in SemanticKITTI layout") as caught:
        frames(tmp_path, "val")
    assert str(tmp_path) in str(caught.value)
    for root in (layout, painted / "pandaset", painted / "nuscenes"):
        with pytest.raises(InputError, match="no split 'holiday'"):
            frames(root, "holiday")


def test_real_frames(kitti_mini, pandaset_mini):
    val = frames(kitti_mini, "val")
    frame = val[0]
    assert frame.image is not None and frame.camera_labels is not None and frame.point_labels is not None
    assert frame.camera_labels.max() == IGNORE and (frame.camera_labels == CITYSCAPES.id_of("road")).mean() > 0.05
    assert known(frames(kitti_mini, "unlabelled_scans")[0]) == {"name", "scan"}
    assert known(frames(kitti_mini, "labelled")[1]) == {"name", "scan", "point_labels"}
    around = frames(pandaset_mini, "all", VIEWS["panorama"].scaled(0.25))[3].panorama
    assert around is not None and around.labels is not None and around.valid.mean() > 0.9
    road = around.image[(around.labels == COMMON15.id_of("road")) & around.valid].astype(int)
    assert len(road) > 500 and np.ptp(road.mean(0)) < 25 and 30 < road.mean() < 130, "asphalt is grey"
