"""The frames that a system does worst, with pictures: truth beside answer."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidar2pano.data.truths import Truth
from lidar2pano.evaluate.questions import Seen
from lidar2pano.evaluate.rasters import Carried
from lidar2pano.formats.image_files import write_png, write_whole
from lidar2pano.labels import COMMON15


class Bad(NamedTuple):
    """A frame: what it was judged by, how far from good, and its sheet (H, W, 3) uint8: truth beside answer."""

    badness: float
    name: str
    figure: str
    sheet: np.ndarray | None


@dataclass(slots=True)
class Worst:
    """The `number` worst frames of a system so far; only their pictures are kept."""

    number: int
    held: list[Bad] = field(default_factory=list)

    def take(self, name: str, judged: tuple[str, float], sheet: np.ndarray | None) -> None:
        """Hold a frame if it is among the worst; of equals the one that came first in the alphabet."""
        figure, value = judged
        bad = Bad(-value, name, figure, sheet)
        self.held = heapq.nsmallest(self.number, [*self.held, bad], key=lambda one: (-one.badness, one.name))

    def wanted(self, judged: tuple[str, float]) -> bool:
        """Whether a frame of this value would be held."""
        return len(self.held) < self.number or -judged[1] >= min(bad.badness for bad in self.held)

    def rows(self) -> Iterator[tuple[str, str, float]]:
        """Name, figure and its value, the worst first."""
        return ((bad.name, bad.figure, -bad.badness) for bad in self.held)

    def write(self, folder: Path) -> list[Path | None]:
        """Write the sheets into `folder`, the worst first: RANK-seq-NNNNNN.png; InputError where that cannot be."""
        paths: list[Path | None] = []
        for rank, bad in enumerate(self.held, 1):
            path = folder / f"{rank:03d}-{bad.name.replace('/', '-')}.png"
            sheet = bad.sheet
            paths.append(write_whole(path, lambda to, s=sheet: write_png(to, s)) if sheet is not None else None)
        return paths


def sheet(truth: Truth, seen: Seen, around: Carried | None) -> np.ndarray | None:
    """Truth on the left (all around: above), the answer on the right (below): colours, then classes.

    (H, W, 3) uint8; None where nothing can be shown. What one side does not have is black.
    """
    pairs = [(truth.picture, seen.colour), (_painted(truth.camera_ids), _painted(seen.ids))]
    rows = [np.concatenate(both, 1) for pair in pairs if (both := _both(*pair))]
    true = truth.panorama
    if true is not None and around is not None:
        stacked = [(true.colour, around.colour), (_painted(true.ids), _painted(around.ids))]
        rows += [np.concatenate(both, 0) for pair in stacked if (both := _both(*pair))]
    if not rows:
        return None
    width = max(row.shape[1] for row in rows)
    return np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows])


def _painted(ids: np.ndarray | None) -> np.ndarray | None:
    return None if ids is None else COMMON15.paint(np.asarray(ids))


def _both(left: np.ndarray | None, right: np.ndarray | None) -> list[np.ndarray] | None:
    """Two pictures of one size, a missing one black; None where both are missing or of different sizes."""
    given = [one for one in (left, right) if one is not None]
    if not given or len({one.shape for one in given}) > 1:
        return None
    black = np.zeros_like(given[0])
    return [black if one is None else one for one in (left, right)]
