"""Samples in panorama coordinates: the scan on the cylinder around the camera, and what the camera saw of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidar2pano.data.augment import drop_points, drop_rings, mirror_azimuth
from lidar2pano.data.moments import Moment, read_moment
from lidar2pano.data.sequences import SampleIndex, frames_of
from lidar2pano.geometry.projection import project
from lidar2pano.scan import Scan
from lidar2pano.views import View


class PanoramaSample(NamedTuple):
    """A sector of the panorama around the camera's; after collation every tensor gains a leading B.

    image     (5, H, W) float32: a RangeImage's channels, metres; zero where empty.
    segments  (H, W) int64 ids of SEMANTIC_KITTI of the points that own the pixels; 0 where empty.
    camera    (H, W) int64 ids of COMMON15, UNSURE where the camera does not look or nobody knows.
    depth_m   (H, W) float32: distance from the camera of the full scan's points, or of all that is seen where the truth
              all around is known, metres; zero where none.
    colour    (3, 2H, 2W) float32 in [-1, 1]: the picture on the raster twice as fine; empty unless asked for.
    seen      (2H, 2W) bool: where `colour` is known.
    name      "seq/frame".
    """

    image: Tensor
    segments: Tensor
    camera: Tensor
    depth_m: Tensor
    colour: Tensor
    seen: Tensor
    name: str


class PanoramaSamples:
    """Scan/camera pairs of some splits on `view`, cropped to `columns` around the camera's sector.

    Frames with the truth all around are drawn from every direction.

    view     the raster of the translator (its origin is replaced by the camera's centre, frame by frame).
    columns  width of the crop, a multiple of 16; jitter: how far left or right of the camera's middle it may begin.
    colour   whether samples carry the camera's picture.
    """

    def __init__(
        self,
        root: Path,
        splits: tuple[str, ...],
        view: View,
        columns: int = 640,
        *,
        colour: bool = False,
        jitter: int = 24,
    ) -> None:
        self.frames = frames_of(root, splits)
        self.view, self.columns, self.colour, self.jitter = view, columns, colour, jitter
        self.predicted: dict[int, np.ndarray] = {}
        self._held: dict[int, Moment] = {}

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.frames)

    def moment(self, index: int) -> Moment:
        """Read a frame, once."""
        if index not in self._held:
            self._held[index] = read_moment(self.frames[index], self.view, self.columns + 2 * self.jitter, self.colour)
        return self._held[index]

    def predict(self, label_points: Callable[[Scan], Tensor]) -> None:
        """Hold a segmenter's labels of every scan: half of the draws take them, and plain samples always do."""
        for index in range(len(self)):
            self.predicted[index] = label_points(self.moment(index).scan).cpu().numpy()

    def __getitem__(self, draw: SampleIndex | int) -> PanoramaSample:
        """Sample: augmented by a SampleIndex's seed (points, labels, crop, mirror), or plain for an int."""
        if isinstance(draw, int):
            moment = self.moment(draw)
            label = self.predicted.get(draw, moment.scan.label)
            ahead = (moment.view.columns - self.columns) // 2
            return self._sample(moment, replace(moment.scan, label=label), self.frames[draw].name, ahead)
        generator = np.random.default_rng(draw.seed)
        moment = self.moment(draw.index)
        scan = self._relabelled(moment.scan, draw.index, generator)
        if generator.random() < 0.5:
            scan = drop_points(scan, generator, generator.uniform(0, 0.5))
        if generator.random() < 0.3:
            scan = drop_rings(scan, generator, 0.8, generator.uniform(0, 0.5))
        start = int(generator.integers(moment.view.columns - self.columns + 1))
        sample = self._sample(moment, scan, self.frames[draw.index].name, start)
        return mirrored(sample) if generator.random() < 0.5 else sample

    def _relabelled(self, scan: Scan, index: int, generator: np.random.Generator) -> Scan:
        """The scan with the teacher's labels or, where there are any, the segmenter's; now and then without."""
        if index in self.predicted and generator.random() < 0.5:
            scan = replace(scan, label=self.predicted[index])
        if scan.label is not None and generator.random() < 0.15:  # a sector unlabeled: geometry has to do
            azimuth = np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0])
            middle, half = generator.uniform(-0.8, 0.8), generator.uniform(0.05, 1.0)
            scan = replace(scan, label=scan.label * (np.abs(azimuth - middle) >= half))
        return scan

    def _sample(self, moment: Moment, scan: Scan, name: str, start: int) -> PanoramaSample:
        image = project(scan, moment.view.window(start, self.columns))
        assert scan.label is not None
        coarse, fine = slice(start, start + self.columns), slice(2 * start, 2 * (start + self.columns))
        return PanoramaSample(
            image=image.channels,
            segments=image.spread(torch.from_numpy(scan.label)),
            camera=moment.camera[:, coarse].long(),
            depth_m=moment.depth_m[:, coarse],
            colour=moment.colour[..., fine].float() / 127.5 - 1,
            seen=moment.seen[:, fine],
            name=name,
        )


def mirrored(sample: PanoramaSample) -> PanoramaSample:
    """The sample with left and right swapped, its points' y included."""
    flipped = {field: mirror_azimuth(getattr(sample, field)) for field in sample._fields if field != "name"}
    flipped["image"] = flipped["image"] * torch.tensor([1.0, 1, -1, 1, 1])[:, None, None]
    return sample._replace(**flipped)
