"""Samples of TITAN-Net's own setting: the front range view in, the camera's perspective image out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from lidar2pano.data.augment import drop_points, mirror
from lidar2pano.data.camera_rasters import camera_raster, in_unit, stretched
from lidar2pano.data.ranges import labelled
from lidar2pano.data.sequences import Frame, SampleIndex, frames_of
from lidar2pano.geometry.images import Normalisation
from lidar2pano.geometry.projection import project
from lidar2pano.labels import TABLES
from lidar2pano.scan import Scan
from lidar2pano.views import View

CAMERA_TO_COMMON14 = np.zeros(256, dtype=np.uint8)  # unsure pixels and the sky are unlabeled, as in the paper
CAMERA_TO_COMMON14[:19] = TABLES["cityscapes", "common-14"]


class FrontSample(NamedTuple):
    """One training pair; after collation every tensor gains a leading B. What was not asked for is empty.

    lidar     (5, H, W) float32, normalised.
    segments  (H, W) int64 ids of SEMANTIC_KITTI, 0 where empty.
    camera    (h, w) int64 ids of COMMON14, stretched to the network's image.
    colour    (3, h, w) float32 in [-1, 1]: the camera's picture, stretched likewise.
    depth_m   (h, w) float32: distance of the whole scan's points from the camera, metres; zero where none.
    name      "seq/frame".
    """

    lidar: Tensor
    segments: Tensor
    camera: Tensor
    colour: Tensor
    depth_m: Tensor
    name: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """What samples carry beside the range view: classes on both sides, the camera's colours, depths in its image."""

    classes: bool = True
    colour: bool = False
    depth: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrontMoment:
    """A frame as it is held in memory; what is not wanted is empty.

    scan    with its point labels, if classes are wanted.
    camera  (h, w) uint8 ids of COMMON14;  colour (3, h, w) uint8;  depth_m (h, w) float32.
    """

    scan: Scan
    camera: Tensor
    colour: Tensor
    depth_m: Tensor


class FrontSamples:
    """Scan/camera pairs of some splits in the paper's setting.

    view    the front view; size (rows, columns) of the image the network writes.
    wanted  what samples carry; files that hold nothing of it are not read and need not be there.
    """

    def __init__(
        self,
        root: Path,
        splits: tuple[str, ...],
        view: View,
        size: tuple[int, int],
        wanted: Wanted | None = None,
    ) -> None:
        self.frames = frames_of(root, splits)
        self.view, self.size, self.wanted = view, size, wanted or Wanted()
        self.normalise = Normalisation()
        self._held: dict[int, FrontMoment] = {}

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.frames)

    def moment(self, index: int) -> FrontMoment:
        """Read a frame, once."""
        if index not in self._held:
            self._held[index] = read_front(self.frames[index], self.size, self.wanted)
        return self._held[index]

    def predict(self, label_points: Callable[[Scan], Tensor]) -> None:
        """Put a segmenter's labels in the place of the data's."""
        for index in range(len(self)):
            moment = self.moment(index)
            label = label_points(moment.scan).cpu().numpy()
            self._held[index] = replace(moment, scan=replace(moment.scan, label=label))

    def __getitem__(self, draw: SampleIndex | int) -> FrontSample:
        """Sample: with the paper's flip and point drop (each p = 0.5) by a SampleIndex's seed, or plain for an int."""
        if isinstance(draw, int):
            return self._sample(self.moment(draw), self.frames[draw].name)
        generator = np.random.default_rng(draw.seed)
        moment = self.moment(draw.index)
        if generator.random() < 0.5:
            moment = mirrored(moment)
        if generator.random() < 0.5:
            moment = replace(moment, scan=drop_points(moment.scan, generator, generator.uniform(0, 0.5)))
        return self._sample(moment, self.frames[draw.index].name)

    def _sample(self, moment: FrontMoment, name: str) -> FrontSample:
        image = project(moment.scan, self.view)
        segments = torch.zeros(0, 0, dtype=torch.int64)
        if self.wanted.classes:
            assert moment.scan.label is not None
            segments = image.spread(torch.from_numpy(moment.scan.label))
        return FrontSample(
            lidar=self.normalise(image),
            segments=segments,
            camera=moment.camera.long(),
            colour=in_unit(moment.colour),
            depth_m=moment.depth_m,
            name=name,
        )


def read_front(frame: Frame, size: tuple[int, int], wanted: Wanted) -> FrontMoment:
    """Read what is wanted of a frame, the camera's part stretched to `size` (rows, columns).

    Raises InputError where a file is missing or damaged.
    """
    camera, colour = torch.zeros(0, 0, dtype=torch.uint8), torch.zeros(3, 0, 0, dtype=torch.uint8)
    depth_m, image_size = torch.zeros(0, 0), (0, 0)
    scan = labelled(frame) if wanted.classes else frame.scan()
    if wanted.classes:
        ids = frame.camera_labels()
        image_size = (ids.shape[1], ids.shape[0])
        found = torch.from_numpy(CAMERA_TO_COMMON14[ids])[None, None]
        camera = interpolate(found, size=size, mode="nearest-exact")[0, 0]
    if wanted.colour or (wanted.depth and not wanted.classes):
        picture = frame.image()
        image_size = (picture.shape[1], picture.shape[0])
        colour = stretched(picture, size) if wanted.colour else colour
    if wanted.depth:
        depth_m = camera_raster(scan, frame.calibration(image_size), size)[1]
    return FrontMoment(scan=scan, camera=camera, colour=colour, depth_m=depth_m)


def mirrored(moment: FrontMoment) -> FrontMoment:
    """The moment with left and right swapped, on both sides."""
    flipped = {name: getattr(moment, name).flip(-1) for name in ("camera", "colour", "depth_m")}
    return FrontMoment(scan=mirror(moment.scan), **flipped)
