"""Scans and recordings read in a child process with limits: for files of strangers, as commands and services get them.

The functions are those of `recorded_scans`, `playback` and `readers`, with the same errors.
"""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from operator import methodcaller
from pathlib import Path
from typing import Any, cast

import numpy as np

from lidar2pano.child_process import Bound, ChildProcess
from lidar2pano.errors import InputError
from lidar2pano.formats.map_blocks import Block, NearBlocks
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.formats.readers import ReadOptions, open_path
from lidar2pano.geometry.motion import SensorMotion
from lidar2pano.recordings import recorded_scans
from lidar2pano.recordings.description import Description
from lidar2pano.recordings.playback import Playback
from lidar2pano.recordings.recorded_images import ImagePlayback
from lidar2pano.recordings.recorded_scans import Frame

_own = threading.local()  # a child for each thread
_held: dict[int, Any] = {}  # in the child: open recordings by number
_numbers = itertools.count()


def _child() -> ChildProcess:
    if not hasattr(_own, "child"):
        _own.child = ChildProcess()
    return _own.child


def get_ready() -> None:
    """Start the process for this thread's scans, so that the first one need not wait for it."""
    _child().start()


def read_cloud(path: Path, *, most_points: float = math.inf, most_seconds: float = math.inf) -> PointCloud:
    """Return the points of a scan file; InputError as `open_path`, and for more points or seconds of reading."""
    bound = Bound.of(path)
    bound = replace(bound, seconds=min(bound.seconds, most_seconds))
    return _child().call(bound, str(path), _cloud, path, most_points)


def _cloud(path: Path, most_points: float) -> PointCloud:
    cloud = open_path(path).cloud(path)
    if len(cloud) > most_points:
        raise InputError(f"{path}: {len(cloud)} points are too many (at most {most_points}); thin it out")
    cloud.require_points(f"{path}")
    return cloud


def describe(path: Path) -> Description | None:
    """Return the contents of a recording; None for anything else."""
    return _child().call(Bound.of(path), str(path), recorded_scans.describe, path)


def recorded_motion(path: Path, options: ReadOptions, frame: str) -> tuple[SensorMotion, str] | None:
    """Return the motion of a coordinate frame in a recording, and the name of its origin; None without one."""
    return _child().call(Bound.of(path), str(path), recorded_scans.recorded_motion, path, options, frame)


class _Open:
    """An object kept in a child of its own: its methods are called there."""

    def __init__(self, path: Path, make: Any, *arguments: Any) -> None:  # noqa: ANN401
        self.path, self._child, self._bound = path, ChildProcess(keeps=True), Bound.of(path)
        self._number: int = self._child.call(self._bound, str(path), _kept, make, path, *arguments)

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:  # noqa: ANN401
        """Return the answer of a function of the object."""
        return self._child.call(self._bound, str(self.path), _call_kept, self._number, function, *arguments)

    def __getattr__(self, method: str) -> Callable[..., Any]:
        """Return a method."""
        return lambda *arguments: self.call(methodcaller(method, *arguments))

    def close(self) -> None:
        self._child.close()
        held = _held.pop(self._number, None)  # where there are no children, the object is kept in this process
        if held is not None:
            held.close()


def _kept(make: Any, *arguments: Any) -> int:  # noqa: ANN401
    number = next(_numbers)
    _held[number] = make(*arguments)
    return number


def _call_kept(number: int, function: Callable[..., Any], *arguments: Any) -> Any:  # noqa: ANN401
    if number not in _held:
        raise InputError("the process that read the recording has ended; nothing behind this scan can be read")
    return function(_held[number], *arguments)


def frames(path: Path, options: ReadOptions) -> Iterator[Frame]:
    """Yield the scans of a recording in time."""
    with closing(_Open(path, recorded_scans.frames, options)) as opened:
        while (frame := opened.call(next, None)) is not None:
            yield frame


def near_blocks(path: Path, places: np.ndarray, reach_m: float) -> Generator[Block]:
    """Yield the points of a map within `reach_m` of any of the places (P, 3), a block at a time."""
    with closing(_Open(path, NearBlocks, places, reach_m)) as opened:
        while (block := opened.following()) is not None:
            yield block


def confined_images(path: Path, names: Sequence[str]) -> ImagePlayback:
    """Return an ImagePlayback in the child."""
    return cast(ImagePlayback, _Open(path, ImagePlayback, names))


def confined_playback(path: Path, topic: str = "") -> Playback:
    """Return a Playback in the child."""
    return cast(Playback, _Open(path, Playback, topic))
