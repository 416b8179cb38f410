"""translate --follow: scans that a recorder writes into a folder, as soon as each is complete, until interrupted."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import FrameType

from lidar2pano.cli.scan_queue import QueuedScan, queued
from lidar2pano.errors import InputError
from lidar2pano.formats.file_contents import stem_of
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.recordings.drive_scans import drive_files

LOOK_S = 0.2  # between looks into the folder
SETTLED_S = 1.0  # a file that was not changed for so long is complete
GIVE_UP_S = 10.0  # one that cannot be read may still grow for so long
Version = tuple[int, int]  # size in bytes and time of the last change in nanoseconds


def check_followed(paths: list[Path], selection: ReadOptions) -> Path:
    """The one folder to follow; InputError for anything else."""
    if len(paths) != 1 or not paths[0].is_dir():
        raise InputError(f"--follow {' '.join(map(str, paths))}: name one folder, into which scans are written")
    if selection.start_s is not None or selection.end_s is not None:
        raise InputError("--follow takes scans as they come; leave out --from and --to")
    return paths[0]


@contextmanager
def until_interrupted() -> Iterator[threading.Event]:
    """An event that the first SIGINT or SIGTERM sets, so that the scan at work is finished; a second one kills."""
    stopped = threading.Event()

    def stop(*_: int | FrameType | None) -> None:
        stopped.set()
        restore()

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    try:
        yield stopped
    finally:
        restore()


def followed(folder: Path, selection: ReadOptions, stopped: threading.Event) -> Iterator[QueuedScan]:
    """The scans of a folder as they are completed, in order of their names, until `stopped` is set.

    A file that changes after it was taken is taken again; one that cannot be read fails after GIVE_UP_S only.
    """
    taken: dict[Path, Version] = {}
    first_look: dict[Path, tuple[Version, float]] = {}
    names: dict[str, Path] = {}
    arrived = 0
    while not stopped.is_set():
        for file, version, age_s in _settled(folder, taken, first_look):
            if stopped.is_set():
                return
            stem = stem_of(file)
            name = stem if names.setdefault(stem, file) == file else file.name
            new = file not in taken
            arrived += new
            if new and (arrived - 1) % selection.every:
                taken[file] = version
                continue
            for scan in _readable([file], {file: name}, selection, age_s > GIVE_UP_S):
                taken[file] = version
                yield scan
            arrived -= new and file not in taken
        stopped.wait(LOOK_S)


def _settled(
    folder: Path, taken: dict[Path, Version], first_look: dict[Path, tuple[Version, float]]
) -> list[tuple[Path, Version, float]]:
    """Files that are complete and were not taken like this: path, version, seconds since their last change.

    first_look  when each file was first found like this, by our own clock: that of a file server may be ahead of it.
    """
    try:
        files = drive_files(folder, ReadOptions())
    except InputError:
        if not folder.is_dir():
            raise
        return []  # none yet
    found = []
    for file in files:
        try:
            status = file.stat()
        except FileNotFoundError:
            continue  # renamed or removed since
        version, now_s = (status.st_size, status.st_mtime_ns), time.monotonic()
        if taken.get(file) == version:
            continue
        if first_look.get(file, (None, 0.0))[0] != version:
            first_look[file] = version, now_s
        age_s = max(time.time() - status.st_mtime, now_s - first_look[file][1])
        if age_s >= SETTLED_S:
            found.append((file, version, age_s))
    return found


def _readable(files: list[Path], names: dict[Path, str], selection: ReadOptions, final: bool) -> Iterator[QueuedScan]:
    """The scans of a file, the first one decoded; none where that cannot be done, unless this is `final`."""
    for number, scan in enumerate(queued(files, names, selection)):
        if number:
            yield scan
            continue
        try:
            cloud = scan.cloud()
        except InputError:
            if not final:
                return
            yield scan
        else:
            yield replace(scan, cloud=lambda cloud=cloud: cloud)
