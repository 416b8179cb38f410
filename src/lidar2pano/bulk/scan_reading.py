"""Reading the scans of a bulk run: files where they are needed, recordings by one thread and in order."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from lidar2pano.bulk.entries import Entry
from lidar2pano.bulk.stores import Store, local_copy
from lidar2pano.drive_motion import DriveMotion
from lidar2pano.errors import InputError
from lidar2pano.formats.interpretation import Interpretation, interpret
from lidar2pano.formats.readers import ReadOptions, read
from lidar2pano.recordings.playback import Playback, playback
from lidar2pano.recordings.recorded_scans import Frame
from lidar2pano.scan import Scan

ATTEMPTS = 8  # first scans of a recording, of which one says how to read the others


class Request(Protocol):
    """A scan that is read when it is needed."""

    @property
    def entry(self) -> Entry:
        """What it is."""
        ...

    def read(self, note: Callable[[str], None]) -> Scan:
        """The scan; InputError where it cannot be read.

        note  takes the SHA-256 of what it is read from, of a bad scan too.
        """
        ...

    def sha256(self) -> str:
        """The SHA-256 alone."""
        ...


@dataclass(frozen=True, slots=True)
class FileRequest:
    """The scan of a scan file; or one that is known to be bad."""

    entry: Entry
    source: Store

    def read(self, note: Callable[[str], None]) -> Scan:
        """See Request."""
        if self.entry.error:
            raise InputError(self.entry.error)
        with local_copy(self.source, self.entry.key.input) as path:
            note(file_hash(path))
            return read(path)

    def sha256(self) -> str:
        """See Request."""
        with self.source.local(self.entry.key.input) as path:
            return file_hash(path)


class RecordedScan(NamedTuple):
    """A scan of a recording, not decoded yet.

    like    how the first scan of the recording was read, None for that scan itself, and where there is none.
    motion  of the sensor, where its points have times and the recording holds poses.
    """

    frame: Frame
    like: Interpretation | None
    motion: DriveMotion | None


@dataclass(frozen=True, slots=True)
class FrameRequest:
    """A scan of a recording. It is read like the recording's first one, and without skew, as `translate` does."""

    entry: Entry
    place: str
    recorded: Future[RecordedScan]

    def read(self, note: Callable[[str], None]) -> Scan:
        """See Request."""
        frame, like, motion = self.recorded.result()
        note(frame.sha256())
        try:
            scan, found = interpret(frame.cloud(), None, like)
        except InputError as error:
            text = str(error) if str(error).startswith(frame.title) else f"{frame.title}: {error}"
            raise InputError(text.replace(str(frame.path), self.place)) from None
        if motion is not None:
            scan, _ = motion.step(scan, found, found.stamp_s or 0.0)
        return scan

    def sha256(self) -> str:
        """See Request."""
        return self.recorded.result().frame.sha256()


class ScanReading:
    """Reads scans of a store. One recording at a time is open, in a thread of its own.

    selection  names the topic of recordings.
    """

    def __init__(self, source: Store, selection: ReadOptions) -> None:
        self._source, self._topic = source, selection.topic
        self._thread = ThreadPoolExecutor(1)
        self._open = ExitStack()
        self._name, self._path = "", Path()
        self._scans: OpenRecording | None = None

    def request(self, entry: Entry) -> Request:
        """The scan of an entry. Those of recordings are read at once, one after the other."""
        if entry.key.scan is None:
            return FileRequest(entry, self._source)
        place = f"{self._source.place}/{entry.key.input}"
        return FrameRequest(entry, place, self._thread.submit(self._recorded, entry.key.input, entry.key.scan))

    def close(self) -> None:
        """Close the recording that is open."""
        self._thread.submit(self._open.close)
        self._thread.shutdown(cancel_futures=False)

    def _recorded(self, name: str, number: int) -> RecordedScan:
        """A scan of a recording, which is opened unless it is open; errors name its place, not that of a download."""
        try:
            if name != self._name or self._scans is None:
                self._open.close()
                self._name, self._scans = name, None
                self._path = self._open.enter_context(self._source.local(name))
                opened = self._open.enter_context(closing(playback(self._path, self._topic)))
                self._scans = OpenRecording(opened)
            return self._scans.scan(number)
        except InputError as error:
            raise InputError(str(error).replace(str(self._path), f"{self._source.place}/{name}")) from None


class OpenRecording:
    """The scans of an open recording, and how the first of them is read."""

    def __init__(self, opened: Playback) -> None:
        self._opened = opened
        self._first: int | None = None
        self._like: Interpretation | None = None
        self._has_times = False
        for number in range(ATTEMPTS):
            try:
                scan, self._like = interpret(opened.frame(number).cloud())
            except InputError:
                continue  # it is bad, or there are no more
            self._first, self._has_times = number, scan.time_s is not None
            break

    def scan(self, number: int) -> RecordedScan:
        """The scan of that number; InputError where it is damaged."""
        frame = self._opened.frame(number)
        like = None if number == self._first else self._like
        return RecordedScan(frame, like, self._motion(number) if self._has_times else None)

    def pose(self, number: int) -> tuple[float, np.ndarray | None]:
        """When that scan was taken, seconds since the epoch, and T_world_sensor (4, 4) float64 then, None if unknown.

        Raises InputError where it is damaged.
        """
        cloud = self._opened.frame(number).cloud()
        stamp_s = cloud.stamp_s or self._opened.recorded_s(number)
        try:
            if (motion := self._motion(number)) is None:
                return stamp_s, None
            _, found = interpret(cloud, None, None if number == self._first else self._like)
            return stamp_s, motion.pose(found, stamp_s)
        except InputError:  # it is no sweep, or the poses are damaged
            return stamp_s, None

    def _motion(self, number: int) -> DriveMotion | None:
        """The motion of the sensor around the time of a scan, where the recording holds it."""
        recorded = self._opened.motion(number, self._like.frame) if self._like else None
        return DriveMotion(*recorded, estimate=False) if recorded else None


def file_hash(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
