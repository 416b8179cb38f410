"""Commands that are killed at random instants: repeated, they give the bytes of an undisturbed run, and leave nothing.

`--kills N` kills each N times (`make kills`). What `bulk` does is tested in tests/bulk, too.
"""

from __future__ import annotations

import json
import random
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

import miniature
from lidar2pano.cli.app import INTERRUPTED, TERMINATED
from random_weights import street, write_data_set, write_scan
from toy_training import gap

ENDS = (0, TERMINATED, INTERRUPTED, -signal.SIGKILL, -signal.SIGTERM)
LEAVINGS = ("*.part", ".*", "*.old")
Run = Callable[..., tuple[int, float, str]]


def contents(folder: Path, without: tuple[str, ...] = ()) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file() and path.name not in without)
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def after_kills(run: Run, words: Callable[[Path], list[str]], fresh: Callable[[Path], Path], kills: int) -> list[Path]:
    """Folders in which a command was killed so often in all, at random instants, and then repeated to its end."""
    draw, number, folders = random.Random(7), 0, [fresh(Path("killed-0"))]
    code, seconds, said = run(words(fresh(Path("timed"))))
    assert code == 0, said
    while kills:
        sign = draw.choice([signal.SIGKILL, signal.SIGTERM])
        code, _, said = run(words(folders[-1]), draw.uniform(0, seconds), sign)
        assert code in ENDS, said
        if code:
            kills -= 1
        else:
            number += 1
            folders.append(fresh(Path(f"killed-{number}")))
    for folder in folders:
        assert run(words(folder))[0] == 0
    return folders


def check(whole: Path, folders: list[Path], without: tuple[str, ...] = ()) -> None:
    expected = contents(whole, without)
    assert expected
    for folder in folders:
        assert contents(folder, without) == expected
        assert not [path for pattern in LEAVINGS for path in folder.rglob(pattern)]


@pytest.fixture
def here(tmp_path, monkeypatch, random_weights):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small").symlink_to(random_weights)
    return tmp_path


@pytest.fixture
def kills(request) -> int:
    return request.config.getoption("kills")


def absolute(folder: Path) -> Path:
    return folder.absolute()


def test_translate(here, run, kills):
    for number in range(4):
        write_scan(here / "drive" / f"{number:06d}.bin", street(seed=number))

    def words(out: Path) -> list[str]:
        return [
            *("translate", str(here / "drive"), "--weights", str(here / "small"), "--device", "cpu", "--save", "all"),
            *("--ply", "--out", str(out)),
        ]

    folders = after_kills(run, words, absolute, kills)
    check(here / "timed", folders)
    assert len(contents(folders[0])) == 4 * 5


def test_world(here, run, kills):
    def words(out: Path) -> list[str]:
        options = ["--frames", "2", "--save", "scans", "--sensor", "vlp16", "--place", "country", "--processes", "1"]
        return ["world", str(out), *options]

    check(here / "timed", after_kills(run, words, absolute, kills))


def test_prepare(here, run, kills):
    def fresh(folder: Path) -> Path:
        root = write_data_set(folder.absolute(), frames=3, size=(60, 20))
        for path in (root / "sequences" / "00" / "labels").iterdir():
            path.unlink()
        return root

    def words(root: Path) -> list[str]:
        return ["prepare", str(root), "--lidar", str(here / "small"), "--device", "cpu"]

    check(here / "timed", after_kills(run, words, fresh, kills), without=("prepared.jsonl",))


def test_train(here, run, kills):
    folders = after_kills(run, lambda out: ["toy-training", str(out)], absolute, kills)
    for folder in folders:
        assert gap(here / "timed", folder) == 0
        assert not [path for pattern in LEAVINGS for path in folder.rglob(pattern)]
        assert len(list((folder / "checkpoints").iterdir())) == 1


def test_bulk(here, run, kills):
    for number in range(4):
        write_scan(here / "drive" / f"{number:06d}.bin", street(seed=number))

    def words(out: Path) -> list[str]:
        options = ["--weights", str(here / "small"), "--device", "cpu", "--save", "all", "--out", str(out)]
        return ["bulk", str(here / "drive"), *options]

    folders = after_kills(run, words, absolute, kills)
    manifest = "manifest/0-of-1.jsonl"
    check(here / "timed", folders, without=("0-of-1.jsonl",))
    for folder in folders:
        lines = [json.loads(line) for line in (folder / manifest).read_text().splitlines()]
        assert sorted(line["input"] for line in lines) == [f"{number:06d}.bin" for number in range(4)]


def plain(value: object) -> object:
    """A row's evaluation without what differs from run to run: times, and names of folders."""
    if isinstance(value, dict):
        return {
            key: plain(part) for key, part in value.items() if key not in ("milliseconds", "hours", "weights", "key")
        }
    return [plain(part) for part in value] if isinstance(value, list) else value


def test_reproduce(here, run, kills):
    data = miniature.write_data_set(here / "data")

    def words(out: Path) -> list[str]:
        options = ["--rows", "scunet", "--budget", "4steps", "--segmenter", str(here / "small"), "--device", "cpu"]
        return ["reproduce", "--data", str(data), "--out", str(out), *options]

    folders = after_kills(run, words, absolute, kills)
    trained = Path("runs", "scunet")
    for folder in folders:
        assert gap(here / "timed" / trained, folder / trained) == 0
        assert plain(json.loads((folder / "results.json").read_text())) == plain(
            json.loads((here / "timed" / "results.json").read_text())
        )
        for part in ("images", "sheets", "data"):
            assert contents(folder / part) == contents(here / "timed" / part)
        assert not [path for pattern in LEAVINGS for path in folder.rglob(pattern)]
