"""The frames on which a system scores worst, with images: ground truth beside prediction."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidar2pano.data.frames import CITYSCAPES_TO_COMMON15, Frame
from lidar2pano.evaluate.interface import Prediction
from lidar2pano.evaluate.resampling import Resampled
from lidar2pano.formats.image_files import write_png, write_whole
from lidar2pano.labels import COMMON15


class WorstFrame(NamedTuple):
    """A frame, the metric that it is ranked by and its value (more is better), and its sheet (H, W, 3) uint8."""

    name: str
    metric: str
    value: float
    sheet: np.ndarray | None


@dataclass(slots=True)
class WorstFrames:
    """The `number` worst frames of a system so far; only their sheets are kept."""

    number: int
    held: list[WorstFrame] = field(default_factory=list)

    def take(self, frame: WorstFrame) -> None:
        """Hold a frame if it is among the worst; of equal ones the first in the alphabet."""
        self.held = heapq.nsmallest(self.number, [*self.held, frame], key=lambda one: (one.value, one.name))

    def wanted(self, value: float) -> bool:
        """Whether a frame of this value would be held."""
        return len(self.held) < self.number or value <= max(one.value for one in self.held)

    def rows(self) -> Iterator[tuple[str, str, float]]:
        """Name, metric and its value, the worst first."""
        return ((one.name, one.metric, one.value) for one in self.held)

    def write(self, folder: Path) -> list[Path | None]:
        """Write the sheets into `folder`, the worst first: RANK-seq-NNNNNN.png; InputError where that fails."""
        paths: list[Path | None] = []
        for rank, one in enumerate(self.held, 1):
            path, sheet = folder / f"{rank:03d}-{one.name.replace('/', '-')}.png", one.sheet
            paths.append(write_whole(path, lambda to, s=sheet: write_png(to, s)) if sheet is not None else None)
        return paths


def sheet(frame: Frame, prediction: Prediction, panorama: Resampled | None) -> np.ndarray | None:
    """Ground truth on the left (of panoramas: above), prediction on the right (below): colours, then classes.

    (H, W, 3) uint8; None where there is nothing to show. What one side does not have is black.
    """
    labels = None if frame.camera_labels is None else CITYSCAPES_TO_COMMON15[frame.camera_labels]
    pairs = [(frame.image, prediction.image), (_painted(labels), _painted(prediction.camera_labels))]
    rows = [np.concatenate(both, 1) for pair in pairs if (both := _both(*pair))]
    true = frame.panorama
    if true is not None and panorama is not None:
        stacked = [(true.image, panorama.image), (_painted(true.labels), _painted(panorama.labels))]
        rows += [np.concatenate(both, 0) for pair in stacked if (both := _both(*pair))]
    if not rows:
        return None
    width = max(row.shape[1] for row in rows)
    return np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows])


def _painted(ids: np.ndarray | None) -> np.ndarray | None:
    return None if ids is None else COMMON15.paint(np.asarray(ids))


def _both(left: np.ndarray | None, right: np.ndarray | None) -> list[np.ndarray] | None:
    """Two images of one size, a missing one black; None where both are missing or of different sizes."""
    given = [one for one in (left, right) if one is not None]
    if not given or len({one.shape for one in given}) > 1:
        return None
    black = np.zeros_like(given[0])
    return [black if one is None else one for one in (left, right)]
