"""Scans that wait to be translated, of files, folders and recordings alike; and those that failed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from lidar2pano.cli.app import complain
from lidar2pano.errors import InputError
from lidar2pano.formats.interpretation import Interpretation, Overrides, interpret
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.formats.readers import ReadOptions, open_path
from lidar2pano.recordings.recorded_scans import recording_reader
from lidar2pano.scan import Scan


@dataclass(frozen=True, kw_only=True)
class QueuedScan:
    """A scan that waits to be translated.

    input   the scan file or recording;  stream: its folder or the recording, of which scans follow each other in time.
    title   for messages;  stem: of its outputs.
    number  of a recording's scan, None for a scan file.
    cloud   gives the points; InputError where they cannot be read.
    """

    input: Path
    stream: Path
    title: str
    stem: str
    number: int | None
    cloud: Callable[[], PointCloud]

    def read(self, overrides: Overrides, like: Interpretation | None) -> tuple[Scan, Interpretation]:
        """The scan, named by its title, and how it was read;  like: how the first one of its stream was."""
        cloud = replace(self.cloud(), name=self.title)
        try:
            return interpret(cloud, overrides, like)
        except InputError as error:
            raise InputError(f"{self.title}: {error}") from None

    def place(self, found: Interpretation) -> dict[str, Any]:
        """Number and stamp of a recording's scan for JSON; nothing for a file's."""
        return {} if self.number is None else {"scan": self.number, "stamp_s": found.stamp_s}


def queued(files: Iterable[Path], names: Mapping[Path, str], selection: ReadOptions) -> Iterator[QueuedScan]:
    """The scans of files and recordings; one that cannot be opened is queued too, and fails when it is read."""
    for file in files:
        try:
            reader = recording_reader(file)
            if reader is None:
                yield _queued_file(file, names[file], partial(_only_cloud, file, selection))
                continue
            for frame in reader.frames(file, selection):
                yield QueuedScan(
                    input=file,
                    stream=file,
                    title=frame.title,
                    stem=names[file] + frame.name.removeprefix(file.stem),
                    number=frame.number,
                    cloud=frame.cloud,
                )
        except InputError as error:
            yield _queued_file(file, names[file], partial(_fail, error))


def _queued_file(file: Path, stem: str, cloud: Callable[[], PointCloud]) -> QueuedScan:
    return QueuedScan(input=file, stream=file.parent, title=str(file), stem=stem, number=None, cloud=cloud)


def _only_cloud(file: Path, selection: ReadOptions) -> PointCloud:
    for cloud in open_path(file).clouds(file, selection):
        return cloud
    raise InputError(f"{file}: holds no scan; name another file")


def _fail(error: InputError) -> NoReturn:
    raise error


def refuse_doubts(found: Interpretation, scan: QueuedScan) -> None:
    """InputError where anything is strange about a scan."""
    if found.doubts:
        raise InputError(f"{scan.title}: {found.doubts[0]} (an error because of --strict)")


class Complaints:
    """Scans that failed: files one line each at once, those of a recording one line together at its end."""

    def __init__(self) -> None:
        self.failed = False
        self._assumed: set[Path] = set()
        self._doubts: set[tuple[Path, str]] = set()
        self._recording: Path | None = None
        self._first, self._more = "", 0

    def add(self, error: InputError, scan: QueuedScan) -> None:
        """Report a scan that failed."""
        self.failed = True
        if scan.number is None:
            complain(error)
        elif self._recording == scan.input:
            self._more += 1
        else:
            self.flush()
            self._recording, self._first = scan.input, str(error)

    def doubt(self, found: Interpretation, scan: QueuedScan) -> None:
        """Say once for each stream what is strange about its scans."""
        for text in found.doubts:
            if (scan.stream, text) not in self._doubts:
                self._doubts.add((scan.stream, text))
                complain(f"{scan.title}: {text} (a warning; --strict makes it an error)")

    def assume(self, found: Interpretation, scan: QueuedScan) -> None:
        """Say once for each stream where the sensor was put, if that is an assumption."""
        if found.assumed_height_m is not None and scan.stream not in self._assumed:
            self._assumed.add(scan.stream)
            complain(
                f"{scan.title}: the sensor is assumed {found.assumed_height_m:g} m above the ground, since its place"
                " cannot be found; name its height with --sensor-height"
            )

    def flush(self) -> None:
        """Report what is held back."""
        if self._recording:
            complain(self._first + (f"; {self._more} more of its scans failed" if self._more else ""))
        self._recording, self._first, self._more = None, "", 0
