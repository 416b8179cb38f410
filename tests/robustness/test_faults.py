"""What once surprised the program, each tried again through the command line: one line, a named exit code, no leavings.

A row of FAULTS is: what is wrong, how it is brought about in a folder that is otherwise good, the command, its exit
code (2 unless said), and a part of the line. `{}` in a command is the folder's good weights.
"""

from __future__ import annotations

import json
import os
import pickle
import shutil
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from lidar2pano.cli import main
from lidar2pano.scan import Scan
from random_weights import CALIB, write_data_set, write_scan

TRANSLATE = "translate good.bin --weights small --device cpu"
EVALUATE = "evaluate small --data data --device cpu"
TRAIN = "train salsanext-mini --data data --out run --device cpu --set data.train=val"
DEEP = "[" * 100_000 + "]" * 100_000
MOST_KIB = 700 << 10  # of memory that a fault may take
SEQUENCE = Path("data/sequences/00")


class Fault(NamedTuple):
    """A fault, how it is made, the command that meets it, and what it must say."""

    name: str
    make: Callable[[], object]
    command: str
    says: str
    code: int = 2


def nothing() -> None:
    """The command alone is the fault."""


def text(path: str, content: str) -> Callable[[], object]:
    return lambda: Path(path).write_text(content)


def sparse(path: str, size: int = 100 << 30) -> Callable[[], object]:
    def make() -> None:
        Path(path).unlink(missing_ok=True)
        with Path(path).open("wb") as file:
            file.truncate(size)

    return make


def link(path: str, target: str) -> Callable[[], object]:
    def make() -> None:
        Path(path).unlink(missing_ok=True)
        Path(path).symlink_to(target)

    return make


def fifo(path: str) -> Callable[[], object]:
    def make() -> None:
        Path(path).unlink(missing_ok=True)
        os.mkfifo(path)

    return make


def png(change: Callable[[bytearray], object]) -> Callable[[], object]:
    path = SEQUENCE / "camera_labels" / "000000.png"

    def make() -> None:
        content = bytearray(path.read_bytes())
        change(content)
        path.write_bytes(content)

    return make


def labels(ids: np.ndarray) -> Callable[[], object]:
    return lambda: Image.fromarray(ids.astype(np.uint8)).save(SEQUENCE / "camera_labels" / "000000.png")


def own(change: Callable[[dict, dict], object], part: str = "segmenter") -> Callable[[], object]:
    """Copies the weights to `own` and lets a function change a part's card and tensors."""

    def make() -> None:
        path = Path("own") / f"{part}.safetensors"
        shutil.copytree("small", "own")
        with safe_open(path, "pt") as file:
            card = json.loads(file.metadata()["card"])
        tensors = load_file(path)
        change(card, tensors)
        save_file(tensors, path, metadata={"card": json.dumps(card)})

    return make


def nan(card: dict, tensors: dict) -> None:
    next(one for one in tensors.values() if one.is_floating_point()).view(-1)[0] = torch.nan


def setting(**changes: object) -> Callable[[dict, dict], object]:
    return lambda card, tensors: card["settings"].update(changes)


def view(**changes: object) -> Callable[[dict, dict], object]:
    return lambda card, tensors: card["views"]["input"].update(changes)


def field(**changes: object) -> Callable[[dict, dict], object]:
    return lambda card, tensors: card.update(changes)


def calib(row: str) -> Callable[[], object]:
    other = [line for line in CALIB.splitlines() if not line.startswith(row.split(":", maxsplit=1)[0])]
    return text("calib.txt", "\n".join([row, *other]))


def scan(xyz: np.ndarray) -> Callable[[], object]:
    points = np.asarray(xyz, np.float32)
    return lambda: write_scan(Path("good.bin"), Scan(xyz=points, remission=np.zeros(len(points), np.float32)))


def image(width: int, height: int) -> Callable[[], object]:
    return lambda: Image.new("1", (width, height)).save("a.png")


def long_header() -> None:
    Path("x.safetensors").write_bytes(b"\0\0\0\x80" + bytes(60))


class Bomb:
    """Three GiB, as a pickle of few bytes."""

    def __reduce__(self) -> tuple:
        return bytearray, (3 << 30,)


def saved(content: object) -> Callable[[], object]:
    return lambda: torch.save(content, "x.pth")


def packed() -> None:
    torch.save({"a": torch.zeros(9)}, "plain.pth")
    with zipfile.ZipFile("plain.pth") as plain, zipfile.ZipFile("x.pth", "w", zipfile.ZIP_DEFLATED) as archive:
        for name in plain.namelist():
            archive.writestr(name, plain.read(name))


BOMB = pickle.dumps({"a": Bomb()}, 2)
IMPORT = "weights import x.pth --as salsanext --out y.safetensors"
OWN = "translate good.bin --weights own --device cpu"
OTHER = "weights info x.safetensors"
VIEW = "view a.png --no-open"
FAULTS = [
    # files that are not what they claim
    Fault("a scan of 100 GiB without content", sparse("good.bin"), TRANSLATE, "are no single scan"),
    Fault("labels of 100 GiB", sparse(f"{SEQUENCE}/labels/000000.label"), EVALUATE, "at most 268435456 belong there"),
    Fault("a FIFO as a scan", fifo("good.bin"), TRANSLATE, "good.bin: "),
    Fault("a device as a scan", link("good.bin", "/dev/zero"), TRANSLATE, "good.bin: "),
    Fault("a folder as a scan", lambda: Path("f.bin").mkdir(), TRANSLATE.replace("good", "f"), "holds no scan"),
    Fault("a scan that links to itself", link("good.bin", "good.bin"), TRANSLATE, "good.bin: "),
    Fault("a calibration without end", nothing, f"{TRANSLATE} --calib /dev/zero", "is a device, FIFO or socket"),
    Fault("a FIFO as a calibration", fifo("pipe"), f"{TRANSLATE} --calib pipe", "is a device, FIFO or socket"),
    Fault("splits.json that is a FIFO", fifo("data/splits.json"), EVALUATE, "split 'val' has no scan"),
    Fault("an image that is no image", text(f"{SEQUENCE}/camera_labels/000000.png", "no"), EVALUATE, "no readable"),
    # JSON
    Fault("a list as splits.json", text("data/splits.json", "[]"), EVALUATE, "must be an object of split"),
    Fault("splits.json of deep lists", text("data/splits.json", DEEP), EVALUATE, "nested too deeply"),
    Fault("splits.json of numbers", text("data/splits.json", '{"val": [1]}'), EVALUATE, "must be a list of seq/"),
    Fault("splits.json of a text", text("data/splits.json", '{"val": "00/0"}'), EVALUATE, "must be a list of seq/"),
    Fault(
        "splits.json in Latin-1", lambda: Path("data/splits.json").write_bytes(b'{"v\xe4l": []}'), EVALUATE, "no JSON"
    ),
    Fault(
        "splits.json that reproduce cannot use",
        text("data/splits.json", "[]"),
        "reproduce --data data --out rep --rows titan --segmenter small",
        "must be an object of split",
    ),
    Fault("splits.json with NaN", text("data/splits.json", '{"val": NaN}'), EVALUATE, "NaN is not a number"),
    Fault("splits.json with 5000 digits", text("data/splits.json", f'{{"val": {"9" * 5000}}}'), EVALUATE, "64 bits"),
    Fault(
        "world.json that is a list", text("world/world.json", "[]"), "world world --frames 1", "no settings of a world"
    ),
    Fault("world.json of deep lists", text("world/world.json", DEEP), "world world --frames 1", "nested too deeply"),
    Fault("info.json of deep lists", text("odd/info.json", DEEP), "evaluate small --data odd", "nested too deeply"),
    Fault(
        "info.json without samples", text("odd/info.json", '{"data_list": 3}'), "evaluate small --data odd", "data_list"
    ),
    Fault(
        "an index of 400 digits in info.json",
        text("odd/info.json", f'{{"data_list": [{{"sample_idx": 1{"0" * 400}}}]}}'),
        "evaluate small --data odd --split all",
        "64 bits",
    ),
    # images
    Fault("an image cut off", png(lambda b: b.__delitem__(slice(60, None))), EVALUATE, "no readable image"),
    Fault(
        "an image of damaged pixels",
        png(lambda b: b.__setitem__(slice(-40, -20), bytes(20))),
        EVALUATE,
        "no readable image",
    ),
    Fault(
        "an image of 2^31 pixels a side",
        png(lambda b: b.__setitem__(slice(16, 24), (b"\x7f" + b"\xff" * 3) * 2)),
        EVALUATE,
        "no readable",
    ),
    Fault("labels of another size", labels(np.zeros((9, 9))), EVALUATE, "label the image again"),
    Fault("labels of Cityscapes' other ids", labels(np.full((20, 60), 26)), EVALUATE, "holds class 26"),
    # calibrations and poses
    Fault(
        "a negative focal length",
        calib("P2: -700 0 600 0 0 700 180 0 0 0 1 0"),
        f"{TRANSLATE} --calib calib.txt",
        "is no camera matrix",
    ),
    Fault(
        "skewed rows of P2",
        calib("P2: 700 0 600 0 90 700 180 0 3 0 1 0"),
        f"{TRANSLATE} --calib calib.txt",
        "is no camera matrix",
    ),
    Fault(
        "a camera 1e300 m away",
        calib("P2: 700 0 600 1e300 0 700 180 0 0 0 1 0"),
        f"{TRANSLATE} --calib calib.txt",
        "calib.txt: ",
    ),
    Fault(
        "poses on no planet",
        text(f"{SEQUENCE}/poses.txt", "1 0 0 1e300 0 1 0 0 0 0 1 0\n"),
        f"translate {SEQUENCE}/velodyne --weights small --device cpu --steady",
        "is on no planet",
    ),
    Fault("an empty calibration", text("calib.txt", ""), f"{TRANSLATE} --calib calib.txt", "has no row P2"),
    Fault(
        "an image size of gigabytes", nothing, f"{TRANSLATE} --calib calib.txt --image-size 99999x99999", "--image-size"
    ),
    # scans
    Fault("a scan of one place", scan(np.zeros((50, 3))), TRANSLATE, "has a place (all are 0 or NaN)"),
    Fault("a scan of NaN", scan(np.full((50, 3), np.nan)), TRANSLATE, "has a place (all are 0 or NaN)"),
    # weights
    Fault("weights that are not finite", own(nan), OWN, "not finite"),
    Fault("a view that is a number", own(field(views={"input": 1})), OWN, "'views'.input must be an object"),
    Fault("a view that is nothing", own(field(views={"input": None})), OWN, "'views'.input must be an object"),
    Fault("a view without a size", own(field(views={"input": {}})), OWN, "a whole number each"),
    Fault("a view of one pixel", own(view(rows=1, columns=1)), OWN, "its rows must divide by 16"),
    Fault("a view of 16 x 1 pixels", own(view(rows=16, columns=1)), OWN, "as many columns at least"),
    Fault(
        "a header of 2 GiB", lambda: Path("x.safetensors").write_bytes(b"\0\0\0\x80" + bytes(60)), OTHER, "its header"
    ),
    Fault(
        "normalisation that gives infinity",
        own(field(normalisation={"mean": [0] * 5, "deviation": [1, 1, 1, 1, 1e-300]})),
        OWN,
        "positive deviation",
    ),
    Fault(
        "normalisation that gives nothing but its mean",
        own(field(normalisation={"mean": [1e30] * 5, "deviation": [1] * 5})),
        OWN,
        "means of 1000 deviations at most",
    ),
    Fault("a code of 40000 numbers", own(setting(code=40_000), "painter"), OWN, "has shape"),
    Fault("a view of 30 million pixels", own(view(rows=1600, columns=19200)), OWN, "own/segmenter.safetensors: "),
    Fault("a view with half a row", own(view(rows=32.5)), OWN, "a whole number"),
    Fault("a view from infinity", own(view(origin=[1e999, 0, 0])), OWN, "own/segmenter.safetensors: "),
    Fault("a view with an odd field", own(view(row=3)), OWN, "unknown field 'row'"),
    Fault(
        "normalisation by nothing",
        own(field(normalisation={"mean": [0] * 5, "deviation": [0] * 5})),
        OWN,
        "positive deviation",
    ),
    Fault(
        "normalisation of three channels",
        own(field(normalisation={"mean": [0], "deviation": [1]})),
        OWN,
        "each of 5 channels",
    ),
    Fault("a card with text for hours", own(field(hours="2")), OWN, "'hours' must be a number"),
    Fault("labels of a set that there is not", own(field(labels="nope")), OWN, "no label set 'nope'"),
    Fault("a checkpoint of 1 kB that builds 3 GiB", saved({"a": Bomb()}), IMPORT, "cannot be read as weights"),
    Fault("a pickle of 1 kB that builds 3 GiB", lambda: Path("x.pth").write_bytes(BOMB), IMPORT, "cannot be read as"),
    Fault("a packed checkpoint", packed, IMPORT, "cannot be read as weights"),
    # options
    Fault("a rate of 1e38", nothing, f"{TRAIN} --set networks.segmenter.optimizer.rate=1e38", "optimizer.rate"),
    Fault("a negative rate", nothing, f"{TRAIN} --set networks.segmenter.optimizer.rate=-1", "optimizer.rate"),
    Fault("a negative seed", nothing, f"{TRAIN} --set training.seed=-1", "training.seed"),
    Fault("a seed beyond 64 bits", nothing, f"{TRAIN} --set training.seed=99999999999999999999", "training.seed"),
    Fault("no view of that name", nothing, f"{TRAIN} --set view=nope", "no view 'nope'"),
    Fault("a scale of nothing", nothing, f"{TRAIN} --set scale=0", "recipe.scale"),
    Fault("a scale of a billion", nothing, f"{TRAIN} --set scale=1e9", "recipe.scale"),
    Fault("no training data", nothing, f"{TRAIN} --set data.train=", "data.train"),
    Fault("no columns", nothing, f"{TRAIN} --set options.columns=-1", "options.columns"),
    Fault("a trillion columns", nothing, f"{TRAIN} --set options.columns=1000000000000", "options.columns"),
    Fault("no classes", nothing, f"{TRAIN} --set networks.segmenter.settings.classes=0", "classes"),
    Fault("steps of 400 digits", nothing, f"{TRAIN} --set training.steps=1{'0' * 400}", "training.steps"),
    Fault("a batch of a billion", nothing, f"{TRAIN} --set training.batch=1000000000", "training.batch"),
    Fault("a million workers", nothing, f"{TRAIN} --set training.workers=1000000", "training.workers"),
    Fault("a weight of 1e300", nothing, f"{TRAIN} --set options.lovasz=1e300", "options.lovasz"),
    Fault("minutes without end", nothing, f"{TRAIN} --set training.minutes=1e300", "training.minutes"),
    Fault("a world of a billion frames", nothing, "world new --frames 1000000000", "--frames"),
    Fault("a world of a billion drives", nothing, "world new --sequences 1000000000", "--sequences"),
    Fault("a negative seed of a world", nothing, "world new --seed=-1 --frames 1", "--seed"),
    Fault("a million processes", nothing, "world new --processes 1000000", "--processes"),
    Fault("a budget of 400 digits", nothing, f"reproduce --data data --out rep --budget {'9' * 400}s", "--budget"),
    Fault("a sensor at infinity", nothing, f"{TRANSLATE} --sensor-height inf", "--sensor-height"),
    # pictures
    Fault(
        "a picture in PostScript",
        text("a.png", "%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 12 1\n"),
        VIEW,
        "no readable",
    ),
    Fault("a picture of 177 million pixels", image(46080, 3840), VIEW, "more pixels"),
    Fault("a picture of 18 million pixels", image(14688, 1224), VIEW, "are too many"),
    Fault("a FIFO as picture", fifo("a.png"), VIEW, "device, FIFO or socket"),
    # outputs
    Fault("a run in a file", text("run", ""), TRAIN, "run"),
    Fault("outputs below a file", text("panoramas", ""), TRANSLATE, "is not a folder"),
    Fault("outputs below a name of 300 bytes", nothing, f"{TRANSLATE} --out {'n' * 300}", "too long"),
    Fault("outputs of /proc", nothing, f"{TRANSLATE} --out /proc/none/of", "cannot be written"),
    Fault("a device as folder", nothing, f"{TRANSLATE} --out /dev/null", "is not a folder"),
    Fault("a scan with a name of 300 bytes", nothing, TRANSLATE.replace("good", "n" * 300), "too long"),
    Fault("data with a name of 300 bytes", nothing, EVALUATE.replace("--data data", f"--data {'n' * 300}"), "too long"),
    Fault("weights with a name of 300 bytes", nothing, TRANSLATE.replace("small", "n" * 300), "too long"),
]


@pytest.fixture
def here(tmp_path, monkeypatch, random_weights):
    """A working folder in which everything is good."""
    monkeypatch.chdir(tmp_path)
    write_scan(tmp_path / "good.bin")
    (tmp_path / "calib.txt").write_text(CALIB)
    (tmp_path / "small").symlink_to(random_weights)
    write_data_set(tmp_path / "data", frames=1, size=(60, 20))
    for name in ("world", "odd"):
        (tmp_path / name).mkdir()
    return tmp_path


def everything(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def most_kib(forget: bool = False) -> int:
    """The most memory that this process has had; since then, if `forget` was given before. 0 where it is not known."""
    if forget:
        with suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return next((int(line.split()[1]) for line in lines if line.startswith("VmHWM")), 0)


@pytest.mark.filterwarnings("ignore:Initializing zero-element")
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_fault_is_one_line_and_leaves_nothing(here, capfd, fault):
    fault.make()
    before, held = everything(here), most_kib(forget=True)
    assert main(fault.command.split()) == fault.code
    err = capfd.readouterr().err
    assert err.startswith("lidar2pano: ") and err.count("\n") == 1 and "Traceback" not in err
    assert fault.says in err
    assert len(err) < 2500
    assert everything(here) == before
    assert most_kib() - held < MOST_KIB, "memory beyond what was there before"
