"""Read the scans of a bulk run: files as they are needed, recordings by one thread and in order."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidar2pano.bounded_files import sha256_of
from lidar2pano.bulk.entries import Entry
from lidar2pano.bulk.stores import Store, local_copy
from lidar2pano.drives.drive_motion import DriveMotion
from lidar2pano.drives.reading import Reading, ReadingOptions, ScanSource, move_scan, read_scan
from lidar2pano.errors import InputError
from lidar2pano.formats.interpretation import Interpretation, Overrides, interpret
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.recordings.playback import Playback
from lidar2pano.recordings.reading_process import confined_playback, read_cloud
from lidar2pano.recordings.recorded_scans import Frame

ATTEMPTS = 8  # first scans of a recording; one of them tells how to read all others


class RecordedScan(NamedTuple):
    """A scan of a recording, not decoded yet.

    first   how the first scan of the recording was read, None for the first scan itself, and without one.
    motion  of the sensor, for points with times in a recording with poses.
    """

    frame: Frame
    first: Interpretation | None
    motion: DriveMotion | None


@dataclass(frozen=True, slots=True)
class Request:
    """A scan to be read when it is needed.

    recorded  of a recording's scan, read like the recording's first one and without skew, as `translate` does;
              None for a scan file.
    """

    entry: Entry
    store: Store
    options: ReadingOptions
    recorded: Future[RecordedScan] | None = None

    def read(self, note: Callable[[str], None]) -> Reading:
        """Read the scan, or its error.

        note  takes the SHA-256 of the content, of a bad scan too.
        """
        source = source_of(self.entry, self.store)
        if self.recorded is None:
            return read_scan(replace(source, cloud=partial(self._file_cloud, note)), self.options)
        try:
            frame, first, motion = self.recorded.result()
        except InputError as error:
            return Reading(source=source, error=error)
        note(frame.sha256)
        reading = read_scan(replace(source, cloud=partial(self._frame_cloud, frame)), self.options, first)
        return move_scan(reading, motion, poses=False) if motion else reading

    def sha256(self) -> str:
        """Return the SHA-256 alone; InputError for a damaged recording."""
        if self.recorded is not None:
            return self.recorded.result().frame.sha256
        with self.store.local(self.entry.key.input) as path:
            return sha256_of(path)

    def _file_cloud(self, note: Callable[[str], None]) -> PointCloud:
        if self.entry.error:
            raise InputError(self.entry.error)
        with local_copy(self.store, self.entry.key.input) as path:
            note(sha256_of(path))
            return read_cloud(path)

    def _frame_cloud(self, frame: Frame) -> PointCloud:
        try:
            return frame.cloud()
        except InputError as error:
            place = f"{self.store.place}/{self.entry.key.input}"
            raise InputError(str(error).replace(str(frame.path), place)) from None


def source_of(entry: Entry, store: Store) -> ScanSource:
    """Return an entry as the source of a single scan; its cloud is still to be given."""

    def cloud() -> PointCloud:
        raise InputError(f"{store.place}/{entry.key}: cannot be read")

    place, key = store.place, entry.key
    return ScanSource(path=Path(key.input), title=f"{place}/{key}", stem=entry.stem, cloud=cloud, number=key.scan)


class ScanReading:
    """Reads scans of a store. One recording at a time is open, in a thread of its own."""

    def __init__(self, source: Store, options: ReadingOptions) -> None:
        self._source, self._options = source, options
        self._thread = ThreadPoolExecutor(1)
        self._open = ExitStack()
        self._name, self._path = "", Path()
        self._scans: OpenRecording | None = None

    def request(self, entry: Entry) -> Request:
        """Return the request for an entry's scan. Those of recordings are read at once, one after the other."""
        name, number = entry.key
        recorded = None if number is None else self._thread.submit(self._recorded, name, number)
        return Request(entry, self._source, self._options, recorded)

    def close(self) -> None:
        """Close the open recording."""
        self._thread.submit(self._open.close)
        self._thread.shutdown(cancel_futures=False)

    def _recorded(self, name: str, number: int) -> RecordedScan:
        """Return a scan of a recording, opened unless it is open; errors name its place, not a download's."""
        try:
            if name != self._name or self._scans is None:
                self._open.close()
                self._name, self._scans = name, None
                self._path = self._open.enter_context(self._source.local(name))
                opened = self._open.enter_context(closing(confined_playback(self._path, self._options.selection.topic)))
                self._scans = OpenRecording(opened, self._options.overrides)
            return self._scans.scan(number)
        except InputError as error:
            raise InputError(str(error).replace(str(self._path), f"{self._source.place}/{name}")) from None


class OpenRecording:
    """The scans of an open recording, and how the first of them is read."""

    def __init__(self, opened: Playback, overrides: Overrides) -> None:
        self._opened, self._overrides = opened, overrides
        self._first: int | None = None
        self._interpretation: Interpretation | None = None
        self._has_times = False
        for number in range(ATTEMPTS):
            try:
                scan, self._interpretation = interpret(opened.frame(number).cloud(), overrides)
            except InputError:
                continue  # a bad one, or the end
            self._first, self._has_times = number, scan.time_s is not None
            break

    def scan(self, number: int) -> RecordedScan:
        """Return the scan of a number; InputError for a damaged one."""
        frame = self._opened.frame(number)
        first = None if number == self._first else self._interpretation
        return RecordedScan(frame, first, self._motion(number) if self._has_times else None)

    def pose(self, number: int) -> tuple[float, np.ndarray | None]:
        """Return a scan's time, seconds since the epoch, and T_world_sensor (4, 4) float64, None if unknown.

        Raises InputError for a damaged scan.
        """
        cloud = self._opened.frame(number).cloud()
        stamp_s = cloud.stamp_s or self._opened.recorded_s(number)
        try:
            if (motion := self._motion(number)) is None:
                return stamp_s, None
            _, interpretation = interpret(
                cloud, self._overrides, None if number == self._first else self._interpretation
            )
            return stamp_s, motion.pose(interpretation, stamp_s)
        except InputError:  # not a sweep, or damaged poses
            return stamp_s, None

    def _motion(self, number: int) -> DriveMotion | None:
        """Return the motion of the sensor around the time of a scan, None if the recording has none."""
        recorded = self._opened.motion(number, self._interpretation.frame) if self._interpretation else None
        return DriveMotion(*recorded, estimate=False) if recorded else None
