"""A user's mistake is one line on stderr and exit code 2: no traceback, and nothing half-written stays."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from installed_families import install_only
from lidar2pano.cli import main
from lidar2pano.models.card import load as load_weights
from lidar2pano.models.card import save
from lidar2pano.scan import Scan
from random_weights import CALIB, street, write_data_set, write_scan, write_weights


@pytest.fixture
def here(tmp_path, monkeypatch, random_weights):
    """A working folder with a good scan, a calibration, weights and a regular file."""
    monkeypatch.chdir(tmp_path)
    write_scan(tmp_path / "good.bin")
    (tmp_path / "calib.txt").write_text(CALIB)
    (tmp_path / "file").write_text("")
    (tmp_path / "small").symlink_to(random_weights)
    return tmp_path


@pytest.fixture
def refused(here, capsys):
    """A function that runs a command which must fail: the line on stderr. Nothing may have been written meanwhile."""

    def run(command: str, code: int = 2) -> str:
        before = everything(here)
        assert main(command.split()) == code
        out, err = capsys.readouterr()
        assert out == ""
        assert err.count("\n") == 1 and err.startswith("lidar2pano: ") and "Traceback" not in err
        assert everything(here) == before
        return err.removeprefix("lidar2pano: ").removesuffix("\n")

    return run


def everything(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def points(*xyz: tuple[float, float, float]) -> Scan:
    return Scan(xyz=np.array(xyz, np.float32), remission=np.zeros(len(xyz), np.float32))


# --- scans ----------------------------------------------------------------------------------------------------------

BAD_SCANS: dict[str, tuple[Callable[[Path], object], str]] = {
    "empty": (lambda path: path.write_bytes(b""), "bad.bin: is empty"),
    "length": (lambda path: path.write_bytes(b"x" * 33), "bad.bin: 33 bytes are no whole number of points"),
    "nan": (lambda path: write_scan(path, points((np.nan, 0, 0), (np.inf, 1, 0))), "bad.bin: none of its 2 points"),
    "origin": (lambda path: write_scan(path, points((0, 0, 0), (0, 0, 0))), "bad.bin: none of its 2 points"),
    "view": (lambda path: write_scan(path, points((0.1, 0, 50), (0, 0.1, 50))), "bad.bin: no point is in view"),
    "missing": (lambda path: None, "bad.bin: does not exist"),
    "format": (lambda path: path.with_name("bad.gif").write_bytes(b"GIF89a" * 99), "bad.gif: is a picture"),
    "folder": (lambda path: Path("bad.bin").mkdir(), "bad.bin: holds no scan (known endings: .bin"),
}


@pytest.mark.child
@pytest.mark.parametrize("fault", BAD_SCANS)
def test_bad_scans(here, refused, fault):
    make, said = BAD_SCANS[fault]
    make(here / "bad.bin")
    name = "bad.gif" if fault == "format" else "bad.bin"
    assert refused(f"translate {name} --weights small --device cpu").startswith(said)


def test_unusable_points_are_counted_and_the_rest_is_painted(here, capsys):
    scan = street()
    scan.xyz[:7] = np.nan
    scan.xyz[7:10] = np.inf
    scan.xyz[10:12] = 0
    write_scan(here / "holes.bin", scan)
    assert main(["translate", "holes.bin", "--weights", "small", "--device", "cpu"]) == 0
    assert "4000 points, 12 of them unusable" in capsys.readouterr().out
    assert (here / "panoramas" / "holes.png").is_file()


# --- options --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--save rgb,deph", "--save: unknown output 'deph'; did you mean 'depth'?"),
        (
            "--save ,",
            "--save: empty list; choose from rgb, segments, labels, depth, confidence, measured, source, remission,",
        ),
        ("--sensor os1_64", "no sensor 'os1_64'; did you mean 'os1-64'?"),
        ("--sensor panorama", "no sensor 'panorama'"),
        (
            "--elevation 30,-30",
            "elevation '30,-30': is neither auto nor LOW,HIGH in degrees; name two numbers, -60 <= ",
        ),
        ("--elevation -61,0", "elevation '-61,0': is neither auto nor LOW,HIGH in degrees; name two numbers, -60 <= "),
        ("--elevation up", "elevation 'up': is neither auto nor LOW,HIGH in degrees; name two numbers, -60 <= LOW < "),
        ("--seed -1", "seed -1: is not between 0 and 9223372036854775807; name another"),
        ("--seed 9223372036854775808", "seed 9223372036854775808: is not between 0 and 9223372036854775807; name"),
        ("--topic /points", "good.bin: is a single scan; leave out --topic, --from and --to"),
        ("--from 1", "good.bin: is a single scan; leave out --topic, --from and --to"),
        ("--to 1", "good.bin: is a single scan; leave out --topic, --from and --to"),
        ("--from 5 --to 2", "--from 5 --to 2: ends before it begins; name a later --to"),
        ("--video a.avi", "--video a.avi: is written as .mp4; name a file with this ending"),
        ("--rerun a.txt", "--rerun a.txt: is written as .rrd; name a file with this ending"),
        ("--elevation 10,10.1", "good.bin: no point lies between "),
        ("--weights other", "no weights 'other': neither a released family nor a file"),
        ("--device gpu", "no device 'gpu'; there is auto, cpu and cuda"),
        ("--out file", "file: cannot be written (file is not a folder); choose another --out"),
        ("--out file/below/it", "file/below/it: cannot be written (file is not a folder); choose another --out"),
        ("--image-size 100x50", "--image-size 100x50 is the size of a camera's image; name its --calib too"),
        ("--save rgb,valid", "--save valid: is where the panorama reaches in a camera's image; name its --calib too"),
        ("--calib calib.txt --image-size 100", "--image-size '100' is not of the form WIDTHxHEIGHT"),
        ("--calib calib.txt --image-size 0x50", "--image-size '0x50' is not of the form WIDTHxHEIGHT"),
        ("--calib calib.txt --image-size -5x50", "--image-size '-5x50' is not of the form WIDTHxHEIGHT"),
        ("--calib missing.txt", "missing.txt: cannot be read as calib.txt"),
        ("--annotations coco --projection cubemap", "--annotations: are those of the cylinder; leave --projection out"),
        ("--colour", "No such option: --colour"),
    ],
)
def test_bad_options(here, refused, options, said):
    assert refused(f"translate good.bin --weights small --device cpu {options}").startswith(said)


@pytest.mark.parametrize("option", ["--device gpu", "--sensor os1_64", "--save x", "--weights other", "--calib file"])
def test_options_are_checked_before_scans_are_read(here, refused, option):
    (here / "bad.bin").write_bytes(b"")
    assert "bad.bin" not in refused(f"translate bad.bin good.bin --weights small {option}")


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a CUDA device")
def test_no_cuda_here(refused):
    assert refused("translate good.bin --weights small --device cuda").startswith("device cuda: torch finds no CUDA")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (CALIB.splitlines()[1], "has no row P2:"),
        (CALIB.splitlines()[0], "has no row Tr:"),
        (CALIB.replace("718.856", "wide"), "row P2: holds something that is no number"),
        ("P2: 1 2 3\nTr: 1 2 3", "row P2: must hold 12 finite numbers"),
    ],
)
def test_bad_calibrations(here, refused, text, said):
    (here / "bad.txt").write_text(text)
    assert refused("translate good.bin --weights small --calib bad.txt").startswith(f"bad.txt: {said}")


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("", "Missing argument"),
        ("translate", "Missing argument"),
        ("translato good.bin", "No such command 'translato'"),
        ("bench --runs 0", "Invalid value for '--runs'"),
        ("weights info unknown", "no weights 'unknown'"),
        ("train salsanext", "Missing option '--data'"),
    ],
)
def test_bad_commands(refused, command, said):
    if command:
        assert refused(command).startswith(said)


# --- weights --------------------------------------------------------------------------------------------------------


@pytest.fixture
def own(here, random_weights):
    """A copy of the family that may be damaged."""
    return Path(shutil.copytree(random_weights, here / "own"))


def test_weights_without_a_part(here, refused):
    write_weights(here, "critic", "projected-critic", {"width": 8})
    said = refused("translate good.bin --weights critic.safetensors --device cpu")
    assert said.startswith("critic.safetensors: a 'projected-critic' has no part in a system")


@pytest.mark.parametrize("kept", [0, 7, 300, -1])
def test_truncated_weights(own, refused, kept):
    path = own / "painter.safetensors"
    path.write_bytes(path.read_bytes()[:kept])
    said = refused("translate good.bin --weights own --device cpu")
    assert said.startswith("own/painter.safetensors is cut off or not a weight file")


def test_tampered_weights(own, refused):
    path = own / "painter.safetensors"
    content = bytearray(path.read_bytes())
    content[-3] ^= 1
    path.write_bytes(content)
    write_scan(path.parent.parent / "second.bin")  # said once, not once per scan
    said = refused("translate good.bin second.bin --weights own --device cpu")
    assert said.startswith("own/painter.safetensors was changed or damaged: its checksum is wrong")


def test_a_card_of_another_network(own, refused):
    network, card = load_weights(own / "segmenter.safetensors")
    save(own / "segmenter.safetensors", network, replace(card, views={}))
    said = refused("translate good.bin --weights own --device cpu")
    assert said.startswith("own/segmenter.safetensors: its card has no view 'input'")


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("weights import missing --as titan", "no checkpoint file missing"),
        ("weights import file --as titan", "file cannot be read as weights"),
        ("weights import file --as titn", "no published weights for network 'titn'; did you mean 'titan'?"),
        (
            "weights import file --as titan --out file/x",
            "file: cannot be written (file is not a folder); choose another --out",
        ),
        ("weights import file --as titan --out calib.txt", "calib.txt: exists already"),
    ],
)
def test_bad_imports(here, refused, command, said):
    (here / "file").write_text("not a checkpoint")
    assert refused(command).startswith(said)


def test_no_weights_at_all(refused, here, monkeypatch):
    install_only(monkeypatch, here / "none")
    assert refused("weights list").startswith("no weights are installed")
    assert refused("translate good.bin").startswith("no weights are installed")
    assert refused("translate good.bin --weights streets").endswith("; pip install lidar2pano-streets")


# --- evaluate, train ------------------------------------------------------------------------------------------------


@pytest.fixture
def data(here):
    """The root of a miniature data set."""
    return write_data_set(here / "data", frames=1, size=(60, 20))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--split vall", "data/splits.json: has no split 'vall'; did you mean 'val'?"),
        ("--json file/scores.json", "file: cannot be written (file is not a folder); choose another --json"),
        ("--json small", "small: is a folder; name a file for --json"),
        ("--csv small", "small: is a folder; name a file for --csv"),
        ("--worst 1 --out file", "file: cannot be written (file is not a folder); choose another --out"),
        ("--worst 1", "--worst needs a folder for its images; add --out DIR"),
        ("--out sheets", "--out is for images of --worst or --leave-out; add one of them"),
        ("--worst -1", "Invalid value for '--worst': Input should be greater than or equal to 0"),
        ("--metrics ssmi", "--metrics: nothing is called 'ssmi'; there is camera, classes"),
        ("--metrics=", "--metrics: empty list; choose from points, classes, pictures"),
        ("--metrics ,", "--metrics: empty list; choose from points, classes, pictures"),
        ("--sensor os1", "no sensor 'os1'"),
        ("--sdnet none", "no weight file none"),
        ("--inception none", "none: no such file; FID needs the weights of Inception-v3"),
        ("--device gpu", "no device 'gpu'"),
        ("--data small", "small: is no data set; name one in"),
    ],
)
def test_bad_evaluations(data, refused, options, said):
    assert refused(f"evaluate small --data data {options}").startswith(said)


def test_evaluated_weights_must_be_complete(data, here, refused, monkeypatch):
    install_only(monkeypatch, here / "none")
    said = refused("evaluate small/translator.safetensors --data data")
    assert said.startswith("small/translator.safetensors: no weights for the segmenter")


def shorten_labels(sequence: Path) -> None:
    path = sequence / "labels" / "000000.label"
    path.write_bytes(path.read_bytes()[:-4])


def colour_labels(sequence: Path) -> None:
    shutil.copy(sequence / "image_2" / "000000.png", sequence / "camera_labels" / "000000.png")


BAD_DATA: dict[str, tuple[Callable[[Path], object], str]] = {
    "labels": (shorten_labels, "labels/000000.label: 15996 bytes, but its scan has 4000 points"),
    "scan": (lambda seq: (seq / "velodyne" / "000000.bin").write_bytes(b""), "velodyne/000000.bin: is empty"),
    "no scan": (lambda seq: (seq / "velodyne" / "000000.bin").unlink(), "scan 000000.bin of split 'val' is missing"),
    "calib": (lambda seq: (seq / "calib.txt").unlink(), "calib.txt: cannot be read"),
    "picture": (lambda seq: (seq / "camera_labels" / "000000.png").write_bytes(b"no"), "is no readable image"),
    "colours": (colour_labels, "camera_labels/000000.png: is no image of class ids"),
}


@pytest.mark.parametrize("fault", BAD_DATA)
def test_bad_data_sets(data, refused, fault):
    damage, said = BAD_DATA[fault]
    damage(data / "sequences" / "00")
    assert said in refused("evaluate small --data data --device cpu")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("salsanxt", "no recipe 'salsanxt'; did you mean 'salsanext'?"),
        ("salsanext --set training.bath=2", "training.bath: Training has no 'bath'; did you mean 'batch'?"),
        ("salsanext --set training.batch=two", "training.batch wants a whole number, not 'two'"),
    ],
)
def test_bad_recipes(data, refused, words, said):
    assert refused(f"train {words} --data data --out run").startswith(said)


@pytest.fixture
def message(here, capsys):
    """A function that runs `train`, which says the recipe before it fails: the line on stderr."""

    def run(words: str, code: int = 2) -> str:
        assert main(["train", *words.split()]) == code
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        return err.removeprefix("lidar2pano: ")

    return run


def test_training_needs_data(message):
    assert message("salsanext --data small --out run").startswith(
        "small: is no data set; name one in SemanticKITTI layout"
    )


def test_training_needs_labels_that_fit(data, message):
    shorten_labels(data / "sequences" / "00")
    said = message("salsanext --data data --out run --set data.train=val --device cpu")
    assert "labels/000000.label: 15996 bytes, but its scan has 4000 points" in said


def test_training_needs_a_folder(data, message):
    assert message("salsanext --data data --out file --set data.train=val").startswith("file is a file")


def test_a_missing_extra_is_named(data, message, monkeypatch):
    monkeypatch.setitem(sys.modules, "lightning_fabric", None)
    monkeypatch.delitem(sys.modules, "lidar2pano.train.engine", raising=False)
    said = message("salsanext --data data --out run")
    assert said == "this command needs lightning_fabric: pip install 'lidar2pano[train]'\n"


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("--engine onnx", "engine onnx needs the extra 'export': pip install 'lidar2pano[export]'"),
        ("--engine openvino", "engine openvino needs the extra 'fast': pip install 'lidar2pano[fast]'"),
        ("--engine onyx", "no engine 'onyx'; did you mean 'onnx'?"),
        ("--format tiff", "--format 'tiff': no format for colour images; there is jpeg, png, webp"),
    ],
)
def test_engines_and_formats(refused, monkeypatch, options, says):
    monkeypatch.setattr("lidar2pano.engines._is_installed", lambda module: False)
    assert refused(f"translate good.bin --weights small {options}") == says


def test_bugs_are_not_hidden(here, monkeypatch, capsys):
    def broken(paths, options, places):
        raise RuntimeError("a bug")

    monkeypatch.setattr("lidar2pano.cli.batch.translate_files", broken)
    assert main(["translate", "good.bin", "--weights", "small"]) == 70
    assert capsys.readouterr().err.startswith("lidar2pano: a fault of the program (RuntimeError: a bug)")
    assert main(["translate", "good.bin", "--weights", "small", "--debug"]) == 70
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(("words", "said"), [((), "interrupted"), (("paused at step 3",), "paused at step 3")])
def test_ctrl_c_says_so(refused, monkeypatch, words, said):
    def interrupted(paths, options, places):
        raise KeyboardInterrupt(*words)

    monkeypatch.setattr("lidar2pano.cli.batch.translate_files", interrupted)
    assert refused("translate good.bin --weights small", code=130) == said


def test_a_closed_pipe_is_quiet(here):
    command = f"{sys.executable} -m lidar2pano inspect good.bin | true; echo ${{PIPESTATUS[0]}}"
    buffered = {**os.environ, "PYTHONUNBUFFERED": ""}
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False, env=buffered)
    assert (done.stdout, done.stderr) == ("1\n", "")


def test_a_loss_that_is_not_finite_is_no_mistake_of_options(refused, monkeypatch):
    def diverged(paths, options, places):
        raise FloatingPointError("loss is not finite near step 3")

    monkeypatch.setattr("lidar2pano.cli.batch.translate_files", diverged)
    assert refused("translate good.bin --weights small", code=1) == "loss is not finite near step 3"
