"""Scans and recordings that somebody replaces, cuts or removes while they are looked at and read."""

from __future__ import annotations

import gzip
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="recordings are read by the extra 'recordings'")

from recording_targets import seeds

import miniature_recordings as recordings
from lidar2pano.errors import InputError
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.recordings.recorded_scans import describe, frames, read
from lidar2pano.scan import Scan
from sample_files import every_format, street

RECORDINGS = ("bag.bag", "bag-bz2.bag", "db3.db3", "mcap.mcap", "mcap-plain.mcap", "capture.pcap", "ouster.osf")
PACKED = "packed.bag.gz"
SCANS = every_format(*street(columns=60))
NAMES = (*RECORDINGS, PACKED, *SCANS)
Change = Callable[[Path], object]
_watched: list[tuple[str, Callable[[], object]]] = []  # path and what is called before each opening of it


def _note_opening(event: str, arguments: tuple) -> None:
    if event == "open" and _watched and str(arguments[0]) == _watched[0][0]:
        _watched[0][1]()


sys.addaudithook(_note_opening)  # it cannot be taken away again


def other_recording(path: Path) -> None:
    """Another one has its name."""
    path.with_name("other").replace(path)


def text(path: Path) -> None:
    """The file is written anew, with other contents."""
    path.write_bytes(b"no recording at all\n" * 40)


def cut(path: Path) -> None:
    """The file loses its second half: it would end a process that has it mapped."""
    os.truncate(path, path.stat().st_size // 2)


def fifo(path: Path) -> None:
    """A FIFO without a writer takes its place: who opened it like a file would wait for ever."""
    path.unlink()
    os.mkfifo(path)


class Blocked(BaseException):
    """Something waits; no reader may take it for damage."""


def _blocked(*_: object) -> None:
    raise Blocked


@contextmanager
def changed(path: Path, opening: int, change: Change) -> Iterator[Callable[[], bool]]:
    """Change a file right before its opening of a number; gives a function that says whether it came so far."""
    number = count(1)
    reached: list[int] = []

    def opened() -> None:
        if next(number) == opening:
            reached.append(opening)
            watched = _watched.pop()  # the change opens it, too
            change(path)
            _watched.append(watched)

    _watched.append((str(path), opened))
    try:
        yield lambda: bool(reached)
    finally:
        _watched.clear()


def read_whole(path: Path, between: Callable[[], object] = lambda: None) -> str:
    """Look at a recording and read its scans; the line of its refusal, if any. `between` is called after the first."""
    try:
        if describe(path) is None:
            read(path)
            return ""
        for frame in frames(path, ReadOptions()):
            frame.cloud()
            between()
    except InputError as error:
        assert "\n" not in str(error)
        return str(error)
    return ""


@pytest.fixture(scope="module")
def contents(tmp_path_factory):
    recordings = seeds(tmp_path_factory.mktemp("seeds"))
    return recordings | {PACKED: gzip.compress(recordings["bag.bag"], mtime=0)} | SCANS


@pytest.fixture(autouse=True)
def _no_waiting():
    before = signal.signal(signal.SIGALRM, _blocked)
    signal.setitimer(signal.ITIMER_REAL, 120)
    yield
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("change", [other_recording, text, cut, fifo, Path.unlink])
@pytest.mark.parametrize("name", NAMES)
def test_a_file_that_changes_is_refused_or_read(tmp_path, contents, name, change):
    path = tmp_path / name
    for opening in count(1):
        path.unlink(missing_ok=True)
        path.write_bytes(contents[name])
        path.with_name("other").write_bytes(contents["mcap.mcap" if name != "mcap.mcap" else "bag.bag"])
        with changed(path, opening, change) as reached:
            read_whole(path)
        if not reached():
            break
    assert opening > 1


@pytest.mark.parametrize("name", (*RECORDINGS, PACKED))
def test_a_recording_that_is_cut_between_two_scans_is_refused_or_read(tmp_path, contents, name):
    path = tmp_path / name
    path.write_bytes(contents[name])
    read_whole(path, lambda: cut(path))


@pytest.mark.parametrize("ending", [".yaml", ".db3"])
def test_a_fifo_in_a_recordings_folder_is_refused_or_read(tmp_path, ending):
    scan = Scan(xyz=np.ones((100, 3), np.float32), remission=np.ones(100, np.float32))
    for opening in count(1):
        folder = recordings.write(tmp_path, "folder", [recordings.points(scan, recordings.START_NS)], stem=f"{opening}")
        (file,) = folder.glob(f"*{ending}")
        with changed(file, opening, fifo) as reached:
            read_whole(folder)
        if not reached():
            break
    assert opening > 1


def test_a_fifo_that_sqlite_would_open_blocks_nothing(tmp_path, contents, monkeypatch):
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    path = tmp_path / "db3.db3"
    path.write_bytes(contents["db3.db3"])
    opened = Sqlite3Reader.open

    def replace_and_open(reader: Sqlite3Reader) -> None:
        fifo(path)
        opened(reader)

    monkeypatch.setattr(Sqlite3Reader, "open", replace_and_open)
    said: list[str] = []
    reading = threading.Thread(target=lambda: said.append(read_whole(path)), daemon=True)
    reading.start()
    reading.join(20)
    waits = reading.is_alive()
    if waits:
        os.close(os.open(path, os.O_WRONLY | os.O_NONBLOCK))  # a writer ends the waiting
    assert not waits and "device, FIFO or socket" in said[0]
