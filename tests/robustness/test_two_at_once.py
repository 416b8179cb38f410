"""Each command twice at the same time with one output: the bytes of one alone, or a line that says who has the folder.

`--kills N` tries each N times with other delays (`make kills`). What `bulk` does is tested in tests/bulk, too.
"""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import miniature
from lidar2pano.cli.app import MISTAKE
from outputs import check_leavings, contents, plain
from random_weights import street, write_camera_teacher, write_data_set, write_scan
from toy_training import gap

TAKEN = "another process trains into it"
SCANS = 4
JOURNALS = ("prepared.jsonl", "0-of-1.jsonl")


def data_set(out: Path) -> None:
    """Scans and images without labels; each command has a copy of its own."""
    write_data_set(out, frames=3, size=(60, 20))
    for part in ("labels", "camera_labels"):
        shutil.rmtree(out / "sequences" / "00" / part)


WEIGHTS = "--weights {here}/small --device cpu"
# Words, with {here} and {out}; what is in the output folder before; whether a second process must be refused.
COMMANDS: dict[str, tuple[str, Callable[[Path], Any] | None]] = {
    "translate": (f"translate {{here}}/drive {WEIGHTS} --save all --ply --video {{out}}/a.mp4 --out {{out}}", None),
    "view": (f"view {{here}}/drive/0.bin {WEIGHTS} --no-open --out {{out}}/view.html", None),
    "bulk": (f"bulk {{here}}/drive {WEIGHTS} --save all --out {{out}}", None),
    "world": ("world {out} --frames 2 --save scans --sensor vlp16 --place country --processes 1", None),
    "prepare": ("prepare {out} --lidar {here}/small --teacher {here}/sdnet.safetensors --device cpu", data_set),
    "evaluate": (
        "evaluate {here}/small --data {here}/data --split val --metrics classes,pictures --json {out}/a.json"
        " --csv {out}/a.csv --worst 1 --out {out}/worst --device cpu",
        None,
    ),
    "export": ("export {here}/small --onnx {out}", None),
}


@pytest.fixture
def here(tmp_path, monkeypatch, random_weights):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small").symlink_to(random_weights)
    for number in range(SCANS):
        write_scan(tmp_path / "drive" / f"{number}.bin", street(seed=number))
    write_camera_teacher(tmp_path / "sdnet.safetensors")
    return tmp_path


@pytest.fixture
def times(request) -> int:
    return request.config.getoption("kills")


def result(folder: Path) -> dict[str, Any]:
    """A folder's files, without what differs from run to run: journals, and times in JSON and CSV."""
    found: dict[str, Any] = {}
    for name, data in contents(folder, JOURNALS).items():
        kind = Path(name).suffix
        lines = [line for line in data.splitlines() if b"milliseconds" not in line] if kind == ".csv" else data
        found[name] = plain(json.loads(data)) if kind == ".json" else lines
    return found


@pytest.mark.parametrize("name", COMMANDS)
def test_two_at_once_give_the_bytes_of_one(here, jobs, times, name):
    if name == "export" and times < 2:
        pytest.skip("it takes half a minute; all files are written alike: --kills 2")
    text, prepare = COMMANDS[name]
    miniature.write_data_set(here / "data")

    def words(out: Path) -> list[str]:
        if prepare:
            prepare(out)
        return text.format(here=here, out=out).split()

    ((code, seconds, said),) = jobs(words(here / "alone"))
    assert code == 0, said
    draw = random.Random(7)
    for number in range(times):
        both = here / f"both-{number}"
        for code, _, said in jobs(words(both), again_s=draw.uniform(0, seconds / 2)):
            assert code == 0, said
            assert "not prepare's own" not in said
        assert result(both) == result(here / "alone")
        check_leavings(both)


def test_of_two_trainings_the_second_is_refused(here, jobs, times):
    ((code, _, said),) = jobs(["toy-training", str(here / "alone")])
    assert code == 0, said
    for number in range(times):
        both = here / f"both-{number}"
        first, second = jobs(["toy-training", str(both)], again_s=0.1)
        assert first[0] == 0, first[2]
        assert second[0] == MISTAKE
        assert TAKEN in second[2]
        assert len(second[2].splitlines()) == 1
        assert gap(here / "alone", both) == 0
        check_leavings(both)


def test_of_two_reproductions_one_says_who_has_the_folder(here, jobs, times):
    data = miniature.write_data_set(here / "data")
    options = ["--rows", "scunet", "--budget", "4steps", "--segmenter", str(here / "small"), "--device", "cpu"]

    def words(out: Path) -> list[str]:
        return ["reproduce", "--data", str(data), "--out", str(out), *options]

    ((code, seconds, said),) = jobs(words(here / "alone"))
    assert code == 0, said
    draw = random.Random(7)
    for number in range(times):
        both = here / f"both-{number}"
        ended = jobs(words(both), again_s=draw.uniform(0, seconds))
        assert 0 in [code for code, _, _ in ended], ended
        for code, _, said in ended:
            assert code == 0 or TAKEN in said, said
        assert gap(here / "alone" / "runs" / "scunet", both / "runs" / "scunet") == 0
        for part in ("images", "sheets", "data"):
            assert contents(both / part) == contents(here / "alone" / part)
        check_leavings(both)
