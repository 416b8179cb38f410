"""Teachers over a data set: what is written, what is kept, and what happens when something changes or breaks."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from lidar2pano.cli import main
from lidar2pano.data.frames import IGNORE
from lidar2pano.data.journal import NAME, Journal, Record, Stamp
from lidar2pano.data.semantic_kitti import SemanticKittiFrame
from lidar2pano.errors import InputError
from lidar2pano.formats import image_files
from lidar2pano.formats.image_files import PART
from lidar2pano.formats.scan_files import write_bin
from lidar2pano.geometry.projection import project
from lidar2pano.labels import CITYSCAPES, SEMANTIC_KITTI, unpack_label
from lidar2pano.models import build
from lidar2pano.models.camera_teachers import CameraSegmenter, ImageNormalisation
from lidar2pano.models.card import Card, load, save
from lidar2pano.pipeline import Segmenter, load_segmenter
from lidar2pano.prepare import State, camera_teacher, frames_to_label, label, lidar_teacher
from random_weights import street, write_segmenter

SIZE = (60, 44)
SDNET = {"width": 4, "stem": 8, "blocks": 1, "modules": [1, 1, 1], "context": 16, "scales": [0.5, 1.0]}


def write_sdnet(path: Path, seed: int = 0) -> Path:
    torch.manual_seed(seed)
    network = build("sdnet", **SDNET).eval()
    for parameter in network.parameters():
        if parameter.ndim > 1:
            torch.nn.init.kaiming_normal_(parameter)
            parameter.data *= 0.85  # sure here and unsure there
    card = {"labels": CITYSCAPES.name, "normalisation": ImageNormalisation().as_dict(), "licence": "CC-BY-NC-4.0"}
    save(path, network, Card(network="sdnet", settings=SDNET, **card))
    return path


def write_lidar(folder: Path, seed: int = 0) -> Path:
    """A segmenter that sees several classes: its last bias is evened out."""
    network, card = load(write_segmenter(folder))
    torch.manual_seed(seed)
    torch.nn.init.normal_(network.logits.weight)
    segmenter = Segmenter.from_card(network, card)
    with torch.inference_mode():
        logits = network(segmenter.normalise(project(street(600), segmenter.view))[None])
    network.logits.bias.data -= logits.mean((0, 2, 3))
    network.logits.bias.data[0] = -1e3
    save(folder / "segmenter.safetensors", network, card)
    return folder / "segmenter.safetensors"


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a LiDAR teacher and a camera teacher, small and untrained."""
    folder = tmp_path_factory.mktemp("teachers")
    write_lidar(folder)
    write_sdnet(folder / "sdnet.safetensors")
    return folder


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two sequences: 00 with two scans and a picture, 08 with a scan and two other pictures."""
    images = {"00": {"000000": ".png"}, "08": {"000001": ".jpg", "000002": ".png"}}
    for number, (sequence, stem) in enumerate([("00", "000000"), ("00", "000001"), ("08", "000000")]):
        folder = tmp_path / "data" / "sequences" / sequence
        (folder / "velodyne").mkdir(parents=True, exist_ok=True)
        write_bin(folder / "velodyne" / f"{stem}.bin", street(600, number))
    for sequence, files in images.items():
        folder = tmp_path / "data" / "sequences" / sequence / "image_2"
        folder.mkdir()
        for number, (stem, suffix) in enumerate(files.items()):
            coarse = np.random.default_rng(number).integers(0, 256, (6, 8, 3), dtype=np.uint8)
            Image.fromarray(coarse).resize(SIZE).save(folder / f"{stem}{suffix}")
    return tmp_path / "data"


SCANS = ["00/labels/000000.label", "00/labels/000001.label", "08/labels/000000.label"]
IMAGE_LABELS = ["00/camera_labels/000000.png", "08/camera_labels/000001.png", "08/camera_labels/000002.png"]


@pytest.fixture
def prepare(root: Path, weights: Path, capsys: pytest.CaptureFixture[str]):
    """A function that runs `prepare --json` with both teachers: exit code, states by file, lines on stderr."""

    def run(*options: str, code: int = 0) -> tuple[dict[str, str], list[str]]:
        words = ["prepare", str(root), "--json", "--device", "cpu", "--lidar", str(weights / "segmenter.safetensors")]
        assert main([*words, "--teacher", str(weights / "sdnet.safetensors"), *options]) == code
        out, err = capsys.readouterr()
        lines = [json.loads(line) for line in out.splitlines()]
        outputs = [(line["frame"], output) for line in lines for output in line["outputs"]]
        for frame, output in outputs:
            assert Path(output["file"]).parent.parent.name == frame.split("/")[0]
        names = {str(Path(output["file"]).relative_to(root / "sequences")): output["state"] for _, output in outputs}
        return names, [line.removeprefix("lidar2pano: ") for line in err.splitlines()]

    return run


def contents(root: Path) -> dict[str, bytes]:
    """Every file below `root` but the journals."""
    return {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file() and p.name != NAME}


def touched(path: Path) -> None:
    """Give a file another time of change."""
    os.utime(path, ns=(time.time_ns(), path.stat().st_mtime_ns + 1_000_000_000))


# --- what is written ------------------------------------------------------------------------------------------------


def test_both_teachers_label_what_they_see(root, weights, prepare):
    before = contents(root)
    states, said = prepare()
    assert states == dict.fromkeys(SCANS + IMAGE_LABELS, "written")
    assert contents(root).keys() - before.keys() == {f"sequences/{name}" for name in states}
    assert said == [
        "labels: these weights are licensed CC-BY-NC-SA-4.0: not for commercial use",
        "camera_labels: these weights are licensed CC-BY-NC-4.0: not for commercial use",
    ]
    frame = SemanticKittiFrame(root / "sequences" / "00", "000000")
    scan = frame.scan
    expected = load_segmenter(weights / "segmenter.safetensors", torch.device("cpu"))[0].points(scan)
    assert np.array_equal(frame.point_labels, expected.numpy())
    raw = np.fromfile(root / "sequences" / SCANS[0], dtype="<u4")
    assert set(unpack_label(raw)[0]) <= set(SEMANTIC_KITTI.raw) and not unpack_label(raw)[1].any()
    assert len(set(raw)) > 1


def test_camera_labels_are_the_teachers_best_and_255_below_the_threshold(root, weights, prepare):
    network, card = load(weights / "sdnet.safetensors")
    frame = SemanticKittiFrame(root / "sequences" / "08", "000001")
    best, ids = CameraSegmenter.from_card(network, card).probabilities(frame.image).max(0)
    threshold = float(best.median())
    ids[best < threshold] = IGNORE
    prepare("--unsure", repr(threshold), "--lidar", "none")
    found = frame.camera_labels
    assert found.shape == SIZE[::-1]
    assert np.array_equal(found, ids.numpy())
    assert 0.4 < (found == IGNORE).mean() < 0.6
    with Image.open(root / "sequences" / IMAGE_LABELS[1]) as image:
        assert image.mode == "L" and image.format == "PNG"


def test_threshold_and_scales_reach_the_teacher(root, prepare):
    ids = {}
    for threshold, scales in [("0", "1"), ("0.9999", "1"), ("0", "1,2")]:
        prepare("--lidar", "none", "--unsure", threshold, "--scales", scales)
        ids[threshold, scales] = SemanticKittiFrame(root / "sequences" / "00", "000000").camera_labels
    assert (ids["0", "1"] != IGNORE).all()
    assert (ids["0.9999", "1"] == IGNORE).mean() > 0.9
    assert (ids["0", "1"] != ids["0", "1,2"]).any()


def test_people_are_informed_in_words(root, weights, capsys):
    words = ["prepare", str(root), "--lidar", str(weights / "segmenter.safetensors"), "--device", "cpu"]
    (root / "sequences" / "08" / "labels").mkdir()
    (root / "sequences" / SCANS[2]).write_bytes(b"ground truth")
    assert main(words) == 0
    out, err = capsys.readouterr()
    assert out == "labels: 2 written, 1 kept\n"
    assert err.splitlines() == [
        "lidar2pano: images are left alone: name their teacher with --teacher",
        "lidar2pano: labels: these weights are licensed CC-BY-NC-SA-4.0: not for commercial use",
        "lidar2pano: 1 files in labels/ are not prepare's own and stay as they are; to have labels beside them choose"
        " another --labels-folder",
    ]
    assert main(words) == 0
    assert capsys.readouterr().out == "labels: 2 up to date, 1 kept\n"


# --- splits ---------------------------------------------------------------------------------------------------------


def test_splits_without_a_listing_are_semantickittis(prepare):
    assert list(prepare("--split", "val")[0]) == [SCANS[2], *IMAGE_LABELS[1:]]
    assert list(prepare("--split", "train", "--split", "val")[0]) == [
        SCANS[0],
        IMAGE_LABELS[0],
        SCANS[1],
        SCANS[2],
        *IMAGE_LABELS[1:],
    ]


def test_splits_of_a_listing(root, prepare):
    (root / "splits.json").write_text(json.dumps({"val": ["00/000001"], "more": ["00/000001", "00/000000"]}))
    assert list(prepare("--split", "val")[0]) == [SCANS[1]]
    assert list(prepare("--split", "val", "--split", "more")[0]) == [SCANS[1], SCANS[0], IMAGE_LABELS[0]]
    assert len(prepare()[0]) == 6  # without a split everything there is


def test_frames_to_label(root):
    found = {
        one.name: (one.scan_file.is_file(), one.image_file and one.image_file.suffix) for one in frames_to_label(root)
    }
    assert found == {
        "00/000000": (True, ".png"),
        "00/000001": (True, None),
        "08/000000": (True, None),
        "08/000001": (False, ".jpg"),
        "08/000002": (False, ".png"),
    }
    (root / "sequences" / "00" / "velodyne" / "._000000.bin").write_bytes(b"")  # as some archivers leave
    assert len(frames_to_label(root)) == 5


# --- the second time ------------------------------------------------------------------------------------------------


@pytest.fixture
def no_network(monkeypatch):
    """A function after which loading a network is an error."""

    def close() -> None:
        def refuse(*_: object) -> None:
            raise AssertionError("a network was loaded")

        monkeypatch.setattr("lidar2pano.prepare.teachers.LidarTeacher.network", property(refuse))
        monkeypatch.setattr("lidar2pano.prepare.teachers.ImageTeacher.network", property(refuse))

    return close


def test_a_second_run_does_nothing(root, prepare, no_network):
    prepare()
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    no_network()
    states, said = prepare()
    assert states == dict.fromkeys(SCANS + IMAGE_LABELS, "current") and said == []
    assert {path: path.stat().st_mtime_ns for path in root.rglob("*")} == before


def test_a_copied_data_set_is_read_once_and_then_known(root, prepare, no_network, monkeypatch):
    prepare()
    for path in root.rglob("*.*"):
        touched(path)
    no_network()
    read, digest = [], hashlib.file_digest
    monkeypatch.setattr(
        hashlib, "file_digest", lambda file, algorithm: read.append(file.name) or digest(file, algorithm)
    )
    assert set(prepare()[0].values()) == {"current"}
    of_weights = 2
    assert len(read) == 12 + of_weights
    read.clear()
    assert set(prepare()[0].values()) == {"current"}
    assert len(read) == of_weights


def test_other_weights_make_their_files_again(root, weights, tmp_path, prepare):
    prepare()
    before = contents(root)
    other = write_sdnet(tmp_path / "other.safetensors", seed=5)
    states, _ = prepare("--teacher", str(other))
    assert {states[name] for name in IMAGE_LABELS} == {"written"} and {states[name] for name in SCANS} == {"current"}
    changed = {name for name, content in contents(root).items() if content != before[name]}
    assert changed == {f"sequences/{name}" for name in IMAGE_LABELS}
    assert set(prepare("--teacher", str(other))[0].values()) == {"current"}
    prepare()
    assert contents(root) == before
    journals = {path: path.read_bytes() for path in root.rglob(NAME)}
    assert set(prepare()[0].values()) == {"current"}
    assert {path: path.read_bytes() for path in journals} == journals  # the latest line is the one that counts


def test_a_changed_scan_is_labelled_again(root, prepare):
    prepare()
    scan = root / "sequences" / "00" / "velodyne" / "000001.bin"
    write_bin(scan, street(600, 77))
    touched(scan)
    states, _ = prepare()
    assert [name for name, state in states.items() if state == "written"] == [SCANS[1]]


@pytest.mark.parametrize("kept", [0, 5, -1])
def test_damaged_outputs_are_made_again(root, prepare, kept):
    prepare()
    before = contents(root)
    for name in (SCANS[0], IMAGE_LABELS[0]):
        path = root / "sequences" / name
        path.write_bytes(path.read_bytes()[:kept])
    (root / "sequences" / SCANS[1]).unlink()
    states, _ = prepare()
    assert {name for name, state in states.items() if state == "written"} == {SCANS[0], SCANS[1], IMAGE_LABELS[0]}
    assert contents(root) == before


# --- what is not ours -----------------------------------------------------------------------------------------------


def test_the_ground_truth_is_never_touched(root, tmp_path, prepare):
    for name, content in [(SCANS[0], b"ground truth"), (IMAGE_LABELS[2], b"drawn by hand")]:
        path = root / "sequences" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    states, said = prepare()
    assert states[SCANS[0]] == states[IMAGE_LABELS[2]] == "kept" and states[SCANS[1]] == "written"
    assert sum("not prepare's own" in line for line in said) == 2
    write_sdnet(tmp_path / "other.safetensors", seed=5)
    prepare("--teacher", str(tmp_path / "other.safetensors"), "--unsure", "0.1")
    assert (root / "sequences" / SCANS[0]).read_bytes() == b"ground truth"
    assert (root / "sequences" / IMAGE_LABELS[2]).read_bytes() == b"drawn by hand"


def test_predictions_go_beside_the_ground_truth(root, prepare):
    existing = root / "sequences" / SCANS[0]
    existing.parent.mkdir()
    existing.write_bytes(b"ground truth")
    states, _ = prepare("--labels-folder", "predicted_labels", "--teacher", "none")
    assert states == dict.fromkeys((name.replace("labels", "predicted_labels") for name in SCANS), "written")
    assert existing.read_bytes() == b"ground truth" and sorted(existing.parent.iterdir()) == [existing]


def test_a_file_that_somebody_corrected_is_theirs(root, tmp_path, prepare):
    """Whole, but no longer what was written: a mended label must survive other weights."""
    prepare()
    labels, camera = root / "sequences" / SCANS[0], root / "sequences" / IMAGE_LABELS[0]
    raw = np.fromfile(labels, dtype="<u4")
    raw[::2] = 10
    raw.tofile(labels)
    Image.fromarray(np.full(SIZE[::-1], 7, np.uint8)).save(camera)
    mended = {path: path.read_bytes() for path in (labels, camera)}
    other = write_sdnet(tmp_path / "other.safetensors", seed=5)
    for options in ([], ["--teacher", str(other), "--unsure", "0"]):
        states, _ = prepare(*options)
        assert states[SCANS[0]] == states[IMAGE_LABELS[0]] == "kept"
        assert {path: path.read_bytes() for path in mended} == mended


def test_without_its_journal_nothing_is_ours(root, tmp_path, prepare):
    prepare()
    before = contents(root)
    for journal in root.rglob(NAME):
        journal.unlink()
    states, _ = prepare("--unsure", "0.9")
    assert set(states.values()) == {"kept"} and contents(root) == before


# --- being stopped --------------------------------------------------------------------------------------------------

PLACES = ("written", "torn", "before", "after")


class Copyist:
    """A teacher that copies its name and the scan's first bytes; `write` can be made deadly."""

    folder, suffix, weights, network = "copies", ".txt", (), None

    def __init__(self, name: str) -> None:
        self.made_by = name

    def source(self, frame: SemanticKittiFrame) -> Path | None:
        return frame.scan_file if frame.scan_file.exists() else None

    def write(self, frame: SemanticKittiFrame, path: Path) -> None:
        path.write_text(self.made_by + frame.scan_file.read_bytes()[:9].hex())

    def whole(self, frame: SemanticKittiFrame, path: Path) -> bool:
        return len(path.read_text()) == 19


def die_at(place: str, number: int, patch: pytest.MonkeyPatch) -> None:
    """Let this process be killed when it comes to a place for the `number`th time (from 0)."""
    left = iter(range(number, -1, -1))

    def deadly(real, *, early: bool):
        def act(*arguments, **settings):
            last = next(left) == 0
            if last and early:
                os.kill(os.getpid(), signal.SIGKILL)
            result = real(*arguments, **settings)
            if last:
                os.kill(os.getpid(), signal.SIGKILL)
            return result

        return act

    def half(journal: Journal, _: Record) -> None:
        with journal.path.open("ab") as file:
            file.write(b'{"file":"copies/000')
        os.kill(os.getpid(), signal.SIGKILL)

    if place == "written":
        patch.setattr(Copyist, "write", deadly(Copyist.write, early=False))
    elif place == "torn":
        enter = Journal.enter

        def torn(journal: Journal, record: Record) -> None:
            (half if next(left) == 0 else enter)(journal, record)

        patch.setattr(Journal, "enter", torn)
    else:
        patch.setattr(Path, "replace", deadly(Path.replace, early=place == "before"))


def killed(root: Path, teacher: Copyist, place: str, number: int) -> None:
    """Label in a process of its own that is killed at a place."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forking beside torch's threads: the child uses none
        child = os.fork()
    if child == 0:
        try:
            die_at(place, number, pytest.MonkeyPatch())
            list(label(frames_to_label(root), [teacher]))
        finally:
            os._exit(7)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


def states_of(root: Path, teacher: Copyist) -> list[str]:
    image_files._sweep.cache_clear()  # as in a new process: what a killed one left is removed once per folder
    return [one.state.value for _, done in label(frames_to_label(root), [teacher]) for one in done]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize("number", [0, 1, 2])
@pytest.mark.parametrize("place", PLACES)
def test_killed_at_any_time_it_goes_on(root, tmp_path, place, number):
    """Killed between writing, entering and naming a file, new or replacing an older one: as if never stopped."""
    aim = Path(shutil.copytree(root, tmp_path / "aim"))
    for name in ("a", "b", "a"):
        killed(root, Copyist(name), place, number)
        done = number + (place == "after")
        files = sorted(path.name for path in root.rglob("copies/0*"))
        assert name != "a" or len(files) in {done, 3}
        assert states_of(root, Copyist(name)) == ["current"] * done + ["written"] * (3 - done)
        states_of(aim, Copyist(name))
        assert contents(root) == contents(aim)
    assert states_of(root, Copyist("a")) == ["current"] * 3


def test_a_record_behind_half_a_line_is_not_glued_to_it(tmp_path, monkeypatch):
    """A disk that fills takes a part of a line, and has room again for the next one."""
    stamp = Stamp(sha256="0" * 64, size=1, changed_ns=1)
    first, second = (Record(file=name, made_by="x", source=stamp, stamp=stamp) for name in ("a", "b"))
    journal, write = Journal(tmp_path), os.write

    def full(file: int, data: bytes) -> int:
        if not (tmp_path / NAME).stat().st_size:
            return write(file, data[:20])
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        with pytest.raises(OSError, match="No space"):
            journal.enter(first)
    journal.enter(second)
    assert (Journal(tmp_path).of("a"), Journal(tmp_path).of("b")) == ([], [second])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_killed_before_a_file_is_replaced_the_older_one_is_known(root):
    states_of(root, Copyist("a"))
    before = contents(root)
    killed(root, Copyist("b"), "before", 0)  # b's line is in the journal, a's file is in the folder
    assert states_of(root, Copyist("a")) == ["current"] * 3
    assert {name for name in contents(root).keys() - before.keys() if not name.endswith(PART)} == set()
    assert states_of(root, Copyist("b")) == ["written"] * 3
    assert contents(root).keys() == before.keys()


def test_what_another_process_writes_meanwhile_is_prepares_own(root):
    labelling = label(frames_to_label(root), [Copyist("a")])
    assert [one.state.value for one in next(labelling)[1]] == ["written"]
    assert states_of(root, Copyist("a")) == ["current", "written", "written"]
    assert [one.state.value for _, done in labelling for one in done] == ["current"] * 2


KILLED = """
import os, signal, sys
from pathlib import Path
from lidar2pano.cli import main

replace, names = Path.replace, []
def deadly(path, target):
    names.append(target)
    if len(names) == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return replace(path, target)
Path.replace = deadly
raise SystemExit(main(sys.argv[1:]))
"""


def test_the_program_killed_goes_on(root, weights, tmp_path, prepare):
    words = ["--device", "cpu", "--lidar", str(weights / "segmenter.safetensors")]
    command = [sys.executable, "-c", KILLED, "prepare", str(root), *words]
    done = subprocess.run(command, capture_output=True, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr
    states, _ = prepare("--teacher", "none")
    assert list(states.values()) == ["current", "written", "written"]
    assert not list(root.rglob(".*"))


def test_strange_lines_of_a_journal_are_passed_over(tmp_path):
    good = '{"file":"labels/0.label","made_by":"a","source":%s,"stamp":%s}'
    stamp = '{"sha256":"x","size":1,"changed_ns":2}'
    lines = ["", "{", "[]", "7", good % ("{}", stamp), good % (stamp, stamp), good % ("3", stamp), '{"file":']
    (tmp_path / NAME).write_bytes("\n".join(lines).encode() + b"\xff")
    journal = Journal(tmp_path)
    (record,) = journal.of("labels/0.label")
    assert (record.made_by, record.stamp.sha256, record.source.changed_ns) == ("a", "x", 2)
    journal.enter(record)
    assert len(Journal(tmp_path).of("labels/0.label")) == 2


# --- what cannot be used --------------------------------------------------------------------------------------------


def test_a_bad_scan_and_a_bad_image_do_not_stop_the_rest(root, prepare):
    scan = root / "sequences" / "00" / "velodyne" / "000000.bin"
    scan.write_bytes(scan.read_bytes()[:-3])
    blind = root / "sequences" / "08" / "velodyne" / "000000.bin"
    np.full((5, 4), np.nan, "<f4").tofile(blind)
    image = root / "sequences" / "08" / "image_2" / "000001.jpg"
    image.write_bytes(b"no picture")
    states, said = prepare(code=2)
    bad = {SCANS[0], SCANS[2], IMAGE_LABELS[1]}
    assert {name for name, state in states.items() if state == "failed"} == bad
    assert {states[name] for name in states.keys() - bad} == {"written"}
    problems = [line for line in said if "licensed" not in line]
    assert len(problems) == 3
    assert problems[0].startswith(f"{scan}: 9597 bytes are no whole number of points")
    assert problems[1].startswith(f"{blind}: none of its 5 points can be used")
    assert problems[2].startswith(f"{image}: is no readable image")
    assert not any((root / "sequences" / name).exists() for name in bad)


def test_json_says_what_the_problem_is(root, weights, capsys):
    (root / "sequences" / "00" / "velodyne" / "000001.bin").write_bytes(b"")
    words = ["--json", "--lidar", str(weights / "segmenter.safetensors"), "--device", "cpu"]
    assert main(["prepare", str(root), *words]) == 2
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["frame"] for line in lines] == ["00/000000", "00/000001", "08/000000", "08/000001", "08/000002"]
    assert lines[1]["outputs"][0]["problem"].endswith("is empty; a KITTI scan holds 16 bytes a point")
    assert [len(line["outputs"]) for line in lines] == [1, 1, 1, 0, 0]


def test_a_place_that_cannot_be_written_to(root, prepare):
    (root / "sequences" / "00" / "predicted").write_text("a file")
    states, said = prepare("--labels-folder", "predicted", code=2)
    assert {state for name, state in states.items() if name.startswith("00/predicted/")} == {"failed"}
    assert list(states.values()).count("written") == 4  # the pictures' labels and the other sequence
    assert [line for line in said if "000000.label: cannot be written" in line]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--lidar", "none", "--teacher", "none"], "--lidar none --teacher none: no teacher is left"),
        (["--labels-folder", "velodyne"], "--labels-folder velodyne: is no name for a folder of labels"),
        (["--labels-folder", "a/b"], "--labels-folder a/b: is no name"),
        (["--labels-folder", ""], "--labels-folder : is no name"),
        (["--camera-labels-folder", ".."], "--camera-labels-folder ..: is no name"),
        (["--camera-labels-folder", "labels"], "--camera-labels-folder labels: is the folder for the labels of scans"),
        (["--scales", "1,two"], "--scales 1,two: is no list of numbers; write it like 0.5,1,2"),
        (["--teacher", "{sdnet}", "--scales", "0,1"], "--scales 0,1 cannot be: name factors up to 4, each once"),
        (["--teacher", "{sdnet}", "--scales", "0.5,2"], "scales [0.5, 2.0] cannot be: name positive factors"),
        (["--teacher", "{sdnet}", "--unsure", "1"], "--unsure 1 is no probability"),
        (["--teacher", "{sdnet}", "--unsure", "nan"], "--unsure nan is no probability"),
        (["--unsure", "7"], "--unsure 7 is no probability"),
        (["--scales", "9"], "--scales 9 cannot be: name factors up to 4, each once"),
        (["--teacher", "nowhere"], "no camera teacher 'nowhere': name weights of sdnet, a run's folder, mask2former:P"),
        (["--teacher", "{segmenter}"], "{segmenter} has weights of another network: 'salsanext' instead of 'sdnet'"),
        (["--teacher", "mask2former:a/b"], "a/b: neither a folder nor a model in the hub's cache"),
        (["--lidar", "nowhere"], "no weights 'nowhere'"),
        (["--lidar", "{sdnet}"], "{sdnet}: a 'sdnet' has no part in a system"),
        (["--device", "gpu"], "no device 'gpu'"),
        (["--split", "vall"], "{root}/sequences: no split 'vall'; did you mean 'val'?"),
    ],
)
def test_mistakes_are_one_line_and_write_nothing(root, weights, capsys, options, said):
    if "mask2former" in str(options):
        pytest.importorskip("transformers")
    places = {"sdnet": weights / "sdnet.safetensors", "segmenter": weights / "segmenter.safetensors", "root": root}
    before = contents(root.parent)
    words = ["prepare", str(root), "--lidar", str(weights / "segmenter.safetensors")]
    assert main([*words, *(option.format(**places) for option in options)]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1
    assert err.removeprefix("lidar2pano: ").startswith(said.format(**places))
    assert contents(root.parent) == before


def test_data_sets_that_are_none(tmp_path):
    with pytest.raises(InputError, match="has no folder sequences/"):
        frames_to_label(tmp_path)
    (tmp_path / "sequences" / "00").mkdir(parents=True)
    with pytest.raises(InputError, match="has neither scans"):
        frames_to_label(tmp_path)


def test_a_run_is_a_camera_teacher(weights, tmp_path):
    (tmp_path / "run" / "weights").mkdir(parents=True)
    with pytest.raises(InputError, match="weights: holds no weights of sdnet"):
        camera_teacher(str(tmp_path / "run"))
    shutil.copy(weights / "segmenter.safetensors", tmp_path / "run" / "weights")
    shutil.copy(weights / "sdnet.safetensors", tmp_path / "run" / "weights" / "network.safetensors")
    shutil.copy(weights / "sdnet.safetensors", tmp_path / "run" / "weights" / "network.last.safetensors")
    teacher = camera_teacher(str(tmp_path / "run"))
    assert teacher.weights == (tmp_path / "run" / "weights" / "network.safetensors",)
    shutil.copy(weights / "sdnet.safetensors", tmp_path / "run" / "weights" / "second.safetensors")
    with pytest.raises(InputError, match="holds 2 weights of sdnet; name the file"):
        camera_teacher(str(tmp_path / "run"))


def test_a_teachers_name_is_its_weights_and_settings(weights):
    file = str(weights / "sdnet.safetensors")
    names = {camera_teacher(file, **options).made_by for options in ({}, {"min_probability": 0.3}, {"scales": [1.0]})}
    assert len(names) == 3
    assert camera_teacher(file).made_by == camera_teacher(file, folder="other", device="cpu").made_by
    assert lidar_teacher(str(weights / "segmenter.safetensors")).made_by not in names


def test_a_mask2former_labels_images(root, tmp_path, capsys):
    pytest.importorskip("transformers")
    from teacher_models import write_model

    folder = write_model(tmp_path / "model", "mask2former")
    capsys.readouterr()
    words = ["prepare", str(root), "--lidar", "none", "--teacher", f"mask2former:{folder}", "--device", "cpu"]
    assert main([*words, "--unsure", "0"]) == 0
    assert capsys.readouterr() == ("camera_labels: 3 written\n", "")
    ids = SemanticKittiFrame(root / "sequences" / "00", "000000").camera_labels
    assert ids.shape == SIZE[::-1] and ids.max() < len(CITYSCAPES)
    assert main([*words, "--unsure", "0"]) == 0
    assert capsys.readouterr().out == "camera_labels: 3 up to date\n"
    (folder / "config.json").write_text((folder / "config.json").read_text() + " ")
    assert main([*words, "--unsure", "0"]) == 0
    assert capsys.readouterr().out == "camera_labels: 3 written\n"


def test_real_scans(kitti_mini, tmp_path, weights):
    """SemanticKITTI's own ground truth stays; scans without it get labels of the right length."""
    sequence = tmp_path / "sequences" / "00"
    shutil.copytree(kitti_mini / "sequences" / "00" / "velodyne", sequence / "velodyne")
    shutil.copytree(kitti_mini / "sequences" / "00" / "labels", sequence / "labels")
    teacher = lidar_teacher(str(weights / "segmenter.safetensors"), device="cpu")
    states = {frame.stem: one.state for frame, (one,) in label(frames_to_label(tmp_path), [teacher])}
    kept = {"000000", "000001", "000002"}
    assert states == {stem: State.KEPT if stem in kept else State.WRITTEN for stem in states}
    for stem in states.keys() - kept:
        assert SemanticKittiFrame(sequence, stem).point_labels.max() > 0
    for stem in kept:
        assert (sequence / "labels" / f"{stem}.label").read_bytes() == (
            kitti_mini / "sequences" / "00" / "labels" / f"{stem}.label"
        ).read_bytes()
