"""Samples for the LiDAR's segmenter: range images and the labels of the points that own their pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidar2pano.data.augment import drop_points, drop_rings, mirror, shift, turn, vary_remission
from lidar2pano.data.sequences import Frame, SampleIndex, frames_of
from lidar2pano.geometry.images import Normalisation
from lidar2pano.geometry.projection import project
from lidar2pano.scan import Scan
from lidar2pano.views import View

BEAM_DEG = 0.42  # between neighbours of an HDL-64E's 64 beams, which see 26.8 degrees


class RangeSample(NamedTuple):
    """One range image with its labels; after collation every tensor gains a leading B.

    lidar   (5, H, W) float32, normalised.
    labels  (H, W) int64 ids of SEMANTIC_KITTI, 0 where empty or unlabeled.
    name    "seq/frame".
    """

    lidar: Tensor
    labels: Tensor
    name: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Variation:
    """How scans are augmented.

    turn_deg  how far a scan is turned at most, either way.
    chance    probability of each of moving, turning and dropping points; half of the scans are mirrored.
    remission how much brighter or darker, as a share, all of a scan is made at most.
    rings     probability that up to three quarters of its beams are left out, as sensors of fewer beams do.
    """

    turn_deg: float = 180.0
    chance: float = 0.5
    remission: float = 0.0
    rings: float = 0.0


class RangeSamples:
    """Labelled scans of some splits, projected; augmented when drawn with a seed, plain when indexed.

    columns   width of the azimuth crop for training (all of the view where 0).
    vary      how samples are augmented.
    """

    def __init__(
        self, root: Path, splits: tuple[str, ...], view: View, columns: int = 0, vary: Variation | None = None
    ) -> None:
        self.frames = frames_of(root, splits)
        self.view = view
        self.columns = columns or view.columns
        self.vary = vary or Variation()
        self.normalise = Normalisation()
        self._held: dict[int, Scan] = {}

    def __len__(self) -> int:
        """Number of scans."""
        return len(self.frames)

    def scan(self, index: int) -> Scan:
        """Read the labelled scan of a frame, once."""
        if index not in self._held:
            self._held[index] = labelled(self.frames[index])
        return self._held[index]

    def __getitem__(self, draw: SampleIndex | int) -> RangeSample:
        """Sample: augmented by a SampleIndex's seed, or the plain whole image for an int."""
        if isinstance(draw, int):
            return self._sample(self.scan(draw), self.frames[draw].name)
        generator = np.random.default_rng(draw.seed)
        scan = augmented(self.scan(draw.index), generator, self.vary)
        sample = self._sample(scan, self.frames[draw.index].name)
        start = int(generator.integers(self.view.columns - self.columns + 1))
        window = (..., slice(start, start + self.columns))
        return sample._replace(lidar=sample.lidar[window], labels=sample.labels[window])

    def _sample(self, scan: Scan, name: str) -> RangeSample:
        image = project(scan, self.view)
        assert scan.label is not None
        return RangeSample(self.normalise(image), image.spread(torch.from_numpy(scan.label)), name)


def labelled(frame: Frame) -> Scan:
    """Read a frame's scan with its point labels."""
    scan = frame.scan()
    return replace(scan, label=frame.labels(len(scan)), name=frame.name)


def augmented(scan: Scan, generator: np.random.Generator, vary: Variation) -> Scan:
    """SalsaNext's augmentation: move, mirror, turn, drop up to half of the points; other remission, fewer beams."""
    if vary.rings and generator.random() < vary.rings:  # before it moves: beams are those of where it was taken
        scan = drop_rings(scan, generator, BEAM_DEG, generator.uniform(0, 0.75))
    if generator.random() < vary.chance:
        scan = shift(scan, generator, (5.0, 3.0, 0.5))
    if generator.random() < 0.5:
        scan = mirror(scan)
    if generator.random() < vary.chance:
        scan = turn(scan, np.radians(generator.uniform(-vary.turn_deg, vary.turn_deg)))
    if generator.random() < vary.chance:
        scan = drop_points(scan, generator, generator.uniform(0, 0.5))
    return vary_remission(scan, generator, vary.remission) if vary.remission else scan
