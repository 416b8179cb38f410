"""The scans of a recording by their numbers: only requested ones are read, if the format has an index."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.geometry.motion import SensorMotion
from lidar2pano.recordings.description import RawMessage
from lidar2pano.recordings.joined_topics import join_topics
from lidar2pano.recordings.recorded_scans import Frame, none_selected, open_recording, span_ns
from lidar2pano.recordings.transforms import recorded_motion

NEAR = 3  # so many messages ahead are read rather than looked up
BLOCK = 64  # scans whose poses are read together


class Playback:
    """The scans of one topic of an open recording by their numbers; best read in ascending order.

    path  of the recording.
    """

    def __init__(self, path: Path, topic: str = "") -> None:
        """Open it, and read when the scans were recorded; InputError if it is damaged, none, or holds no such topic."""
        self.path, self._recording = path, join_topics(open_recording(path), topic)
        try:
            self._topic = self._recording.choose(topic)
            self._stamps_ns = self._recording.stamps_ns(self._topic)
        except BaseException:
            self._recording.close()
            raise
        self._next: int = 0
        self._motion: tuple[tuple[int, str], tuple[SensorMotion, str] | None] | None = None  # with its key
        self._following: Iterator[RawMessage] | None = None  # from the message `_next` on; None before and after damage

    def numbers(self, options: ReadOptions) -> Sequence[int]:
        """Return the numbers of the selected scans; InputError if there is none."""
        start_ns, end_ns = span_ns(self._recording.origin_ns(self._topic), options)
        selected = np.ones(len(self._stamps_ns), dtype=bool)
        if start_ns is not None:
            selected &= self._stamps_ns >= start_ns
        if end_ns is not None:
            selected &= self._stamps_ns < end_ns
        if not selected.any():
            raise none_selected(self.path, self._recording.description.duration_s, options)
        return np.flatnonzero(selected)[:: options.every].tolist()

    def frame(self, number: int) -> Frame:
        """Return the scan of a number; InputError if there is none, or nothing can be read from there on.

        Messages before it are looked up in the index and not read if there is one.
        """
        near = self._next + NEAR if self._recording.indexed else number
        following, self._following = self._following, None
        if following is None or not self._next <= number <= near:
            following = self._from(number)
        for place, message in enumerate(following, self._next):
            if place == number:
                self._next, self._following = place + 1, following
                return Frame.of(self._recording, number, message)
        raise InputError(f"{self.path}: has no scan {number}; it was changed while it was read")

    def recorded_s(self, number: int) -> float:
        """Return the time of recording of a scan, seconds since the epoch; of a damaged one too."""
        return int(self._stamps_ns[number]) * 1e-9

    def motion(self, number: int, frame: str) -> tuple[SensorMotion, str] | None:
        """Return the recorded motion of a coordinate frame near the time of a scan, and its source; None without one.

        It is read for BLOCK scans together; for all at once if there is no index. Raises InputError at damage.
        """
        last = len(self._stamps_ns) - 1
        first = number - number % BLOCK if self._recording.indexed else 0
        last = min(first + BLOCK - 1, last) if self._recording.indexed else last
        if self._motion is None or self._motion[0] != (first, frame):
            if not self._recording.indexed:
                self._following = None  # it reads from the same place of the file
            span_ns = (int(self._stamps_ns[edge]) for edge in (first, last))
            self._motion = (first, frame), recorded_motion(self._recording, frame, *span_ns)
        return self._motion[1]

    def close(self) -> None:
        """Close the files."""
        self._following = None
        self._recording.close()

    def _from(self, number: int) -> Iterator[RawMessage]:
        """Return the messages from `_next` on, and set it to `number` or less."""
        start_ns = None
        self._next = 0
        if self._recording.indexed and 0 <= number < len(self._stamps_ns):
            start_ns = int(self._stamps_ns[number])
            self._next = int(np.count_nonzero(self._stamps_ns < start_ns))
        return self._recording.messages((self._topic,), start_ns)
