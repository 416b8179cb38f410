"""Samples in panorama coordinates: the scan on the cylinder around the camera, and what the camera saw of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidar2pano.calibration import Calibration
from lidar2pano.data.augment import drop_points, drop_rings, mirror_azimuth
from lidar2pano.data.ranges import labelled
from lidar2pano.data.sequences import UNSURE, Draw, Frame, frames
from lidar2pano.geometry.camera import at_camera, camera_in_panorama
from lidar2pano.geometry.projection import pixels, project
from lidar2pano.labels import TABLES
from lidar2pano.scan import Scan
from lidar2pano.sensors import View

CAMERA_TO_COMMON15 = np.full(256, UNSURE, dtype=np.uint8)
CAMERA_TO_COMMON15[:19] = TABLES["cityscapes", "common-15"]


class PanoramaSample(NamedTuple):
    """A sector of the panorama around the camera's; after collation every tensor gains a leading B.

    image     (5, H, W) float32: a RangeImage's channels, metres; zero where empty.
    segments  (H, W) int64 ids of SEMANTIC_KITTI of the points that own the pixels; 0 where empty.
    camera    (H, W) int64 ids of COMMON15, UNSURE where the camera does not look or nobody knows.
    depth_m   (H, W) float32: distance of the full scan's points from the camera, metres; zero where none.
    colour    (3, 2H, 2W) float32 in [-1, 1]: the camera's picture on the raster twice as fine; empty unless asked for.
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moment:
    """A frame as it is held in memory, in a window of the raster that is a little wider than the crops.

    scan     with its point labels;  view: the window, seen from the camera's optical centre.
    camera   (H, W) uint8 as in PanoramaSample;  depth_m (H, W) float32.
    colour   (3, 2H, 2W) uint8, seen (2H, 2W) bool; both empty unless asked for.
    """

    scan: Scan
    view: View
    camera: Tensor
    depth_m: Tensor
    colour: Tensor
    seen: Tensor


class PanoramaSamples:
    """Scan/camera pairs of some splits on `view`, cropped to `columns` around the camera's sector.

    view     the raster of the translator (its origin is replaced by the camera's centre, frame by frame).
    columns  width of the crop, a multiple of 16; jitter: how far left or right of the middle it may begin.
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
        self.frames = [frame for split in splits for frame in frames(root, split)]
        self.view, self.columns, self.colour, self.jitter = view, columns, colour, jitter
        self.predicted: dict[int, np.ndarray] = {}
        self._held: dict[int, Moment] = {}

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.frames)

    def moment(self, index: int) -> Moment:
        """Read a pair, once."""
        if index not in self._held:
            self._held[index] = read_moment(self.frames[index], self.view, self.columns + 2 * self.jitter, self.colour)
        return self._held[index]

    def predict(self, label_points: Callable[[Scan], Tensor]) -> None:
        """Hold a segmenter's labels of every scan: half of the draws take them, and plain samples always do."""
        for index in range(len(self)):
            self.predicted[index] = label_points(self.moment(index).scan).cpu().numpy()

    def __getitem__(self, draw: Draw | int) -> PanoramaSample:
        """Sample: augmented by a Draw's seed (points, labels, crop, mirror), or plain for an int."""
        if isinstance(draw, int):
            moment = self.moment(draw)
            label = self.predicted.get(draw, moment.scan.label)
            return self._sample(moment, replace(moment.scan, label=label), self.frames[draw].name, self.jitter)
        generator = np.random.default_rng(draw.seed)
        moment = self.moment(draw.index)
        scan = self._relabelled(moment.scan, draw.index, generator)
        if generator.random() < 0.5:
            scan = drop_points(scan, generator, generator.uniform(0, 0.5))
        if generator.random() < 0.3:
            scan = drop_rings(scan, generator, 0.8, generator.uniform(0, 0.5))
        sample = self._sample(moment, scan, self.frames[draw.index].name, int(generator.integers(2 * self.jitter + 1)))
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


def read_moment(frame: Frame, view: View, columns: int, colour: bool) -> Moment:
    """Read a frame and carry what its camera saw onto a window of `view`, `columns` wide, around the camera's sector.

    Raises InputError where scan, labels, camera labels, image or calibration are missing or do not fit together.
    """
    ids = frame.camera_labels()
    calibration = frame.calibration((ids.shape[1], ids.shape[0]))
    scan = labelled(frame)
    window = around_camera(at_camera(view, calibration), calibration, columns)
    camera = camera_in_panorama(window, calibration).nearest(torch.from_numpy(CAMERA_TO_COMMON15[ids]), UNSURE)
    picture, seen = torch.zeros(3, 0, 0, dtype=torch.uint8), torch.zeros(0, 0, dtype=torch.bool)
    if colour:
        lookup = camera_in_panorama(window.scaled(2), calibration)
        picture = lookup.linear(torch.from_numpy(frame.image()).movedim(2, 0).float()).round().to(torch.uint8)
        seen = lookup.valid
    return Moment(
        scan=scan,
        view=window,
        camera=camera,
        depth_m=project(scan, window).channels[0],
        colour=picture,
        seen=seen,
    )


def around_camera(view: View, calibration: Calibration, columns: int) -> View:
    """The window of the raster, `columns` wide, in whose middle the camera looks."""
    ahead = np.linalg.inv(calibration.K @ calibration.T_camera_lidar[:3, :3]) @ np.array(
        [(calibration.size[0] - 1) / 2, (calibration.size[1] - 1) / 2, 1.0]
    )
    x, y, z = torch.from_numpy(ahead).unbind()
    _, column = pixels(x, y, z, view)
    start = min(max(round(float(column)) - columns // 2, 0), view.columns - columns)
    return view.window(start, columns)


def mirrored(sample: PanoramaSample) -> PanoramaSample:
    """The sample with left and right swapped, its points' y included."""
    flipped = {field: mirror_azimuth(getattr(sample, field)) for field in sample._fields if field != "name"}
    flipped["image"] = flipped["image"] * torch.tensor([1.0, 1, -1, 1, 1])[:, None, None]
    return sample._replace(**flipped)
