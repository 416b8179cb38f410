"""A growing folder: the scans of a recorder, as soon as each is complete."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from lidar2pano.drives.folders import drive_files
from lidar2pano.drives.reading import ScanSource, scan_sources
from lidar2pano.errors import InputError
from lidar2pano.formats.file_contents import stem_of
from lidar2pano.formats.readers import ReadOptions

LOOK_S = 0.2  # between looks into the folder
SETTLED_S = 1.0  # a file unchanged for so long is complete
GIVE_UP_S = 10.0  # an unreadable one may still grow for so long
Version = tuple[int, int]  # size in bytes and time of the last change in nanoseconds


def check_followed(paths: Sequence[Path], selection: ReadOptions) -> Path:
    """Return the one folder to follow; InputError for anything else."""
    if len(paths) != 1 or not paths[0].is_dir():
        raise InputError(f"--follow {' '.join(map(str, paths))}: name one folder, into which scans are written")
    if selection.start_s is not None or selection.end_s is not None:
        raise InputError("--follow takes scans as they come; leave out --from and --to")
    return paths[0]


def follow_folder(folder: Path, selection: ReadOptions, stopped: threading.Event) -> Iterator[ScanSource]:
    """Yield the scans of a folder as they are completed, in order of their names, until `stopped` is set.

    A later change of a file takes it again; an unreadable one fails after GIVE_UP_S only.
    """
    taken: dict[Path, Version] = {}
    first_look: dict[Path, tuple[Version, float]] = {}
    owner: dict[str, Path] = {}  # of a stem: its first file
    arrived = 0
    while not stopped.is_set():
        for file, version, age_s in _settled_files(folder, taken, first_look):
            if stopped.is_set():
                return
            stem = stem_of(file)
            stems = {file: stem if owner.setdefault(stem, file) == file else file.name}
            new = file not in taken
            arrived += new
            if new and (arrived - 1) % selection.every:
                taken[file] = version
                continue
            for source in _readable_sources(scan_sources([file], selection, stems), age_s > GIVE_UP_S):
                taken[file] = version
                yield source
            arrived -= new and file not in taken
        stopped.wait(LOOK_S)


def _settled_files(
    folder: Path, taken: dict[Path, Version], first_look: dict[Path, tuple[Version, float]]
) -> list[tuple[Path, Version, float]]:
    """List complete files, not taken in this version: path, version, seconds since the last change.

    first_look  when each version of a file was first seen, by our own clock: a file server's may be ahead of it.
    """
    try:
        files = drive_files(folder, ReadOptions())
    except InputError:
        if not folder.is_dir():
            raise
        return []  # none yet
    settled = []
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
            settled.append((file, version, age_s))
    return settled


def _readable_sources(sources: Iterator[ScanSource], final: bool) -> Iterator[ScanSource]:
    """Yield the scans of a file, the first one decoded; none for an unreadable file, unless this is `final`."""
    for index, source in enumerate(sources):
        if index:
            yield source
            continue
        try:
            cloud = source.cloud()
        except InputError:
            if not final:
                return
            yield source
        else:
            yield replace(source, cloud=lambda cloud=cloud: cloud)
