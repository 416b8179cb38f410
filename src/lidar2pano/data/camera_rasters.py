"""Scans projected into a camera: what SC-UNET reads, and the depths that a camera's picture is known to have."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from lidar2pano.calibration import Calibration
from lidar2pano.data.augment import drop_points
from lidar2pano.data.sequences import SampleIndex, frames_of
from lidar2pano.geometry.camera import points_in_camera
from lidar2pano.geometry.projection import NOBODY
from lidar2pano.scan import Scan


class CameraSample(NamedTuple):
    """A scan in the camera and the camera's picture; after collation every tensor gains a leading B.

    lidar   (2, h, w) float32: remission in [0, 1] and range from the optical centre, metres; zero where no point fell.
    colour  (3, h, w) float32 in [-1, 1].
    name    "seq/frame".
    """

    lidar: Tensor
    colour: Tensor
    name: str


class CameraSamples:
    """Scans of some splits, projected into their camera, with its pictures, stretched to `size` (rows, columns)."""

    def __init__(self, root: Path, splits: tuple[str, ...], size: tuple[int, int]) -> None:
        self.frames = frames_of(root, splits)
        self.size = size
        self._held: dict[int, tuple[Scan, Calibration, Tensor]] = {}

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.frames)

    def pair(self, index: int) -> tuple[Scan, Calibration, Tensor]:
        """Read a frame, once: scan, camera, and its picture (3, h, w) uint8, stretched."""
        if index not in self._held:
            frame = self.frames[index]
            picture = frame.image()
            calibration = frame.calibration((picture.shape[1], picture.shape[0]))
            self._held[index] = frame.scan(), calibration, stretched(picture, self.size)
        return self._held[index]

    def __getitem__(self, draw: SampleIndex | int) -> CameraSample:
        """Sample: with the paper's flip and point drop (each p = 0.5) by a SampleIndex's seed, or plain for an int."""
        index = draw if isinstance(draw, int) else draw.index
        scan, calibration, picture = self.pair(index)
        flip = False
        if not isinstance(draw, int):
            generator = np.random.default_rng(draw.seed)
            flip = generator.random() < 0.5
            if generator.random() < 0.5:
                scan = drop_points(scan, generator, generator.uniform(0, 0.5))
        lidar, colour = camera_raster(scan, calibration, self.size), in_unit(picture)
        if flip:  # the picture and what was seen in it: a mirrored scan would want a mirrored camera
            lidar, colour = lidar.flip(-1), colour.flip(-1)
        return CameraSample(lidar, colour, self.frames[index].name)


def camera_raster(scan: Scan, calibration: Calibration, size: tuple[int, int]) -> Tensor:
    """Project a scan into a camera whose image is stretched to `size` (rows, columns).

    Returns (2, rows, columns) float32: remission, and range from the optical centre in metres; zero where no point
    fell. The nearest point owns a pixel, at equal range the first in file order; what is out of view is dropped.
    """
    xyz, remission = torch.from_numpy(scan.xyz), torch.from_numpy(scan.remission)
    usable = torch.isfinite(xyz.sum(1) + remission) & xyz.any(1)  # the sensor's origin means: no echo
    xyz, remission = xyz[usable], remission[usable]
    u, v, _ = points_in_camera(xyz, calibration)  # NaN behind the camera, which is nowhere inside
    (rows, columns), (width, height) = size, calibration.size
    row, column = (((at + 0.5) * (to / of)).floor() for at, to, of in ((v, rows, height), (u, columns, width)))
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    cell = (row[inside] * columns + column[inside]).long()
    range_m = (xyz[inside] - xyz.new_tensor(calibration.centre)).norm(dim=1)
    # positive floats order like their bits; the point's number below them breaks ties
    key = (range_m.view(torch.int32).long() << 32) | torch.arange(len(range_m))
    least = torch.full((rows * columns,), NOBODY).scatter_reduce_(0, cell, key, "amin")
    taken = least != NOBODY
    owner = least[taken] & 0xFFFFFFFF
    raster = torch.zeros(2, rows * columns)
    raster[0, taken], raster[1, taken] = remission[inside][owner], range_m[owner]
    return raster.view(2, rows, columns)


def stretched(picture: np.ndarray, size: tuple[int, int]) -> Tensor:
    """A picture (h, w, 3) uint8, resized to `size` (rows, columns): (3, rows, columns) uint8."""
    colour = torch.from_numpy(picture).movedim(2, 0)
    if colour.shape[-2:] == size:
        return colour.contiguous()
    # bilinear over the area that a new pixel covers, like any viewer that makes a picture smaller
    resized = interpolate(colour[None].float(), size=size, mode="bilinear", antialias=True)[0]
    return resized.round().clamp(0, 255).to(torch.uint8)


def in_unit(colour: Tensor) -> Tensor:
    """Colours uint8 as float32 in [-1, 1]."""
    return colour.float() / 127.5 - 1
