"""CameraProjectionDataset, which SC-UNET trains on: scans projected into their camera, and the camera's images."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from lidar2pano.calibration import Calibration
from lidar2pano.data.augment import drop_points
from lidar2pano.data.cache import LruCache
from lidar2pano.data.frames import Frame, SampleIndex
from lidar2pano.data.layouts import frames_of
from lidar2pano.geometry.camera import project_to_camera
from lidar2pano.scan import Scan


class CameraProjectionSample(NamedTuple):
    """A scan in the camera and the camera's image; after collation every tensor gains a leading B.

    lidar   (2, h, w) float32: remission in [0, 1] and range from the optical centre, metres; zero where no point fell.
    image   (3, h, w) float32 in [-1, 1].
    name    "seq/frame".
    """

    lidar: Tensor
    image: Tensor
    name: str


class CameraProjectionDataset:
    """Scans of some splits, projected into their camera, with its images, stretched to `size` (rows, columns)."""

    def __init__(self, root: Path, splits: tuple[str, ...], size: tuple[int, int]) -> None:
        self.frames = frames_of(root, splits)
        self.size = size
        self._cache = LruCache()

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.frames)

    def pair(self, index: int) -> tuple[Scan, Calibration, Tensor]:
        """A frame's scan, camera, and image (3, h, w) uint8, stretched."""
        return self._cache.get(index, lambda: self._read(self.frames[index]))

    def _read(self, frame: Frame) -> tuple[Scan, Calibration, Tensor]:
        scan, calibration, image = frame.require("scan", "calibration", "image")
        return scan, calibration, stretched(image, self.size)

    def __getitem__(self, at: SampleIndex | int) -> CameraProjectionSample:
        """Sample: with the paper's flip and point drop (each p = 0.5) by a SampleIndex's seed, or plain for an int."""
        index = at if isinstance(at, int) else at.index
        scan, calibration, pixels = self.pair(index)
        flip = False
        if not isinstance(at, int):
            generator = np.random.default_rng(at.seed)
            flip = generator.random() < 0.5
            if generator.random() < 0.5:
                scan = drop_points(scan, generator, generator.uniform(0, 0.5))
        lidar, image = project_to_camera(scan, calibration, self.size), in_unit(pixels)
        if flip:  # the projection and the image: a mirrored scan would need a mirrored camera
            lidar, image = lidar.flip(-1), image.flip(-1)
        return CameraProjectionSample(lidar, image, self.frames[index].name)


def stretched(image: np.ndarray, size: tuple[int, int]) -> Tensor:
    """An image (h, w, 3) uint8, resized to `size` (rows, columns): (3, rows, columns) uint8."""
    pixels = torch.from_numpy(image).movedim(2, 0)
    if pixels.shape[-2:] == size:
        return pixels.contiguous()
    # bilinear over the area that a new pixel covers, like any viewer that makes an image smaller
    resized = interpolate(pixels[None].float(), size=size, mode="bilinear", antialias=True)[0]
    return resized.round().clamp(0, 255).to(torch.uint8)


def in_unit(pixels: Tensor) -> Tensor:
    """Pixels uint8 as float32 in [-1, 1]."""
    return pixels.float() / 127.5 - 1
