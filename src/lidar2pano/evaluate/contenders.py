"""A system under evaluation, asked frame by frame, and what has been counted of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lidar2pano.data.truths import Truth
from lidar2pano.evaluate.questions import Question, Seen, System
from lidar2pano.evaluate.rasters import Carried, carried
from lidar2pano.evaluate.tallies import Moved, Tally
from lidar2pano.evaluate.worst import Worst, sheet
from lidar2pano.geometry.flow import Flow
from lidar2pano.scan import Scan

ROLL = 5 / 16  # of a turn: a whole number of columns of every raster that the networks know


@dataclass(frozen=True, slots=True, kw_only=True)
class Flows:
    """How a frame follows the one before: not at all, or with the flow of each sector as far as it is known."""

    following: bool
    camera: Flow | None = None
    panorama: Flow | None = None


@dataclass(slots=True, kw_only=True)
class Contender:
    """A system under evaluation and what has been counted of it.

    past, before, around  what the last frame left: the system's memory, its picture, its panorama.
    milliseconds          per stage, one entry per frame.
    """

    system: System
    tally: Tally
    worst: Worst
    past: Any = None
    before: np.ndarray | None = None
    around: Carried | None = None
    milliseconds: dict[str, list[float]] = field(default_factory=dict)

    def take(self, truth: Truth, question: Question, flows: Flows) -> None:
        """Ask about a frame and count the answer."""
        if not flows.following:
            self.past = self.before = self.around = None
        told = question if self.system.told else replace(question, ids=None)
        self.past, seen = self.system.see(told, self.past)
        for stage, value in seen.milliseconds.items():
            self.milliseconds.setdefault(stage, []).append(value)
        around = None
        if seen.panorama is not None and truth.panorama is not None:
            around = carried(seen.panorama, truth.panorama.view)
        self.tally.points(truth, seen)
        self.tally.camera(truth, seen, _moved(self.before, flows.camera))
        if around is not None and truth.panorama is not None and seen.panorama is not None:
            before = None if self.around is None else self.around.colour
            self.tally.panorama(truth, around, seen.painted, _moved(before, flows.panorama))
            if seen.painted:
                self.tally.seam(seen.panorama.colour, truth.name)
            if "roll" in self.tally.measures.kinds:
                self._roll(truth, question, flows, seen)
        self.before, self.around = seen.colour, around
        judged = self.tally.of_frame(truth.name) if self.worst.number else None
        if judged is not None and self.worst.wanted(judged):
            self.worst.take(truth.name, judged, sheet(truth, seen, around))

    def _roll(self, truth: Truth, question: Question, flows: Flows, seen: Seen) -> None:
        """Ask about the scan turned about the sensor's axis; both answers begin a stream."""
        if question.origin is None or seen.panorama is None:
            return
        straight, width = seen.panorama, seen.panorama.view.columns
        columns = round(ROLL * width)
        if flows.following:
            straight = self.system.see(replace(question, calibration=None))[1].panorama
        scan, R = turned(question.scan, columns, width)
        x, y, z = (R @ np.array(question.origin)).tolist()
        other = self.system.see(replace(question, scan=scan, calibration=None, origin=(x, y, z)))[1].panorama
        if straight is not None and other is not None:
            pair = [Carried(one.colour, one.segments, one.depth_m) for one in (straight, other)]
            self.tally.roll(pair[0], pair[1], columns, truth.name)

    def mean_milliseconds(self) -> dict[str, float]:
        """Mean per stage; the first frame, which warms up, is left out where there are several."""
        return {
            stage: sum(warm) / len(warm) for stage, times in self.milliseconds.items() if (warm := times[1:] or times)
        }

    def merge(self, other: Contender) -> None:
        """Take in another part of the split; ValueError where it is another system or has a frame of ours."""
        if self.system.origin.name != other.system.origin.name:
            raise ValueError(f"{self.system.origin.name!r} and {other.system.origin.name!r} are not one system")
        self.tally.merge(other.tally)
        for stage, times in other.milliseconds.items():
            self.milliseconds.setdefault(stage, []).extend(times)
        for bad in other.worst.held:
            self.worst.take(bad.name, (bad.figure, -bad.badness), bad.sheet)


def turned(scan: Scan, columns: int, of: int) -> tuple[Scan, np.ndarray]:
    """The scan turned about the sensor's axis so that panoramas of `of` columns move by `columns` to the right.

    Also the turn itself, (3, 3) float64.
    """
    angle = -columns * math.tau / of
    R = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    return replace(scan, xyz=(scan.xyz.astype(np.float64) @ R.T).astype(np.float32)), R


def _moved(before: np.ndarray | None, flow: Flow | None) -> Moved | None:
    return None if before is None or flow is None else Moved(before=before, flow=flow)
