"""Scans paired with the camera's perspective image, stretched to a network's size.

FrontViewDataset has the front range view (TITAN-Net), CameraProjectionDataset the scan projected into the camera
(SC-UNET).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from lidar2pano.calibration import Calibration
from lidar2pano.data.cache import LruCache, PredictedLabels
from lidar2pano.data.frames import Frame, SampleIndex
from lidar2pano.data.layouts import frames_of
from lidar2pano.geometry.camera import project_to_camera
from lidar2pano.geometry.projection import Normalisation, project
from lidar2pano.geometry.rasters import in_unit
from lidar2pano.labels import TABLES
from lidar2pano.scan import Scan, drop_points, mirror
from lidar2pano.views import View

CITYSCAPES_TO_COMMON14 = np.zeros(256, dtype=np.uint8)  # unknown pixels and the sky are unlabeled, as in the paper
CITYSCAPES_TO_COMMON14[:19] = TABLES["cityscapes", "common-14"]


class FrontViewSample(NamedTuple):
    """One training pair; after collation every tensor gains a leading B. Parts not requested are empty.

    lidar          (5, H, W) float32, normalised range image.
    segments       (H, W) int64 ids of SEMANTIC_KITTI, 0 if empty.
    camera_labels  (h, w) int64 ids of COMMON14, stretched to the network's image.
    image          (3, h, w) float32 in [-1, 1]: the camera's image, stretched likewise.
    depth_m        (h, w) float32: distance of the whole scan's points from the camera, metres; zero if none.
    name           "seq/frame".
    """

    lidar: Tensor
    segments: Tensor
    camera_labels: Tensor
    image: Tensor
    depth_m: Tensor
    name: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleParts:
    """Parts of samples beside the range view: labels on both sides, the camera's image, depths in the camera."""

    labels: bool = True
    image: bool = False
    depth: bool = False


class FrontViewPair(NamedTuple):
    """A frame, stretched to the network's image; parts not requested are empty.

    scan           with its point labels, if labels are wanted.
    camera_labels  (h, w) uint8 ids of COMMON14;  image (3, h, w) uint8;  depth_m (h, w) float32.
    """

    scan: Scan
    camera_labels: Tensor
    image: Tensor
    depth_m: Tensor


class FrontViewDataset:
    """Scan/camera pairs of some splits in the paper's setting.

    view   the front view;  size (rows, columns) of the network's image.
    parts  of samples; files of other parts are not read and need not be there.
    """

    def __init__(
        self,
        root: Path,
        splits: tuple[str, ...],
        view: View,
        size: tuple[int, int],
        parts: SampleParts | None = None,
    ) -> None:
        self.frames = frames_of(root, splits)
        self.view, self.size, self.parts = view, size, parts or SampleParts()
        self.normalise = Normalisation()
        self.predicted: PredictedLabels | None = None
        self._labels: Callable[[Frame], np.ndarray] | None = None
        self._cache = LruCache()

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.frames)

    def pair(self, index: int) -> FrontViewPair:
        """Return a frame; InputError if a requested part is missing or damaged."""
        return self._cache.get(index, lambda: self._read(self.frames[index]))

    def predict(self, label_points: Callable[[Scan], Tensor], weights: str | Path) -> None:
        """Use a segmenter's labels of the scans instead of the data's.

        weights  the segmenter's file: predictions are made once and kept on disk (PredictedLabels).
        """
        self.predicted = PredictedLabels(label_points, weights)
        self.use(self.predicted.of)

    def use(self, labels: Callable[[Frame], np.ndarray]) -> None:
        """Use these labels of the scans instead of the data's; labels: frame -> (N,) int64 ids of SEMANTIC_KITTI."""
        self._labels, self._cache = labels, LruCache()

    def __getitem__(self, index: SampleIndex | int) -> FrontViewSample:
        """Return a sample: with the paper's flip and point drop (each p = 0.5) by a seed, or plain for an int."""
        if isinstance(index, int):
            return self._sample(self.pair(index), self.frames[index].name)
        generator = np.random.default_rng(index.seed)
        pair = self.pair(index.index)
        if generator.random() < 0.5:
            pair = mirrored(pair)
        if generator.random() < 0.5:
            pair = pair._replace(scan=drop_points(pair.scan, generator, generator.uniform(0, 0.5)))
        return self._sample(pair, self.frames[index.index].name)

    def _sample(self, pair: FrontViewPair, name: str) -> FrontViewSample:
        range_image = project(pair.scan, self.view)
        segments = torch.zeros(0, 0, dtype=torch.int64)
        if pair.scan.label is not None:
            segments = range_image.spread(torch.from_numpy(pair.scan.label))
        return FrontViewSample(
            lidar=self.normalise(range_image),
            segments=segments,
            camera_labels=pair.camera_labels.long(),
            image=in_unit(pair.image) if self.parts.image else torch.zeros(3, 0, 0),
            depth_m=pair.depth_m,
            name=name,
        )

    def _read(self, frame: Frame) -> FrontViewPair:
        scan, camera_labels = frame.scan, torch.zeros(0, 0, dtype=torch.uint8)
        image, depth_m = torch.zeros(3, 0, 0, dtype=torch.uint8), torch.zeros(0, 0)
        if self.parts.labels:
            scan = frame.labelled_scan() if self._labels is None else replace(scan, label=self._labels(frame))
            ids = torch.from_numpy(CITYSCAPES_TO_COMMON14[frame.require("camera_labels")[0]])[None, None]
            camera_labels = interpolate(ids, size=self.size, mode="nearest-exact")[0, 0]
        if self.parts.image:
            image = stretched(frame.require("image")[0], self.size)
        if self.parts.depth:
            (calibration,) = frame.require("calibration")
            depth_m = project_to_camera(scan, calibration, self.size)[1]
        return FrontViewPair(scan=scan, camera_labels=camera_labels, image=image, depth_m=depth_m)


def mirrored(pair: FrontViewPair) -> FrontViewPair:
    """Return the pair with left and right swapped, on both sides."""
    scan, *rest = pair
    return FrontViewPair(mirror(scan), *(part.flip(-1) for part in rest))


class CameraProjectionSample(NamedTuple):
    """A scan in the camera and the camera's image; after collation every tensor gains a leading B.

    lidar   (2, h, w) float32: remission in [0, 1] and range from the optical centre, metres; zero if no point fell.
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
        """Return the number of pairs."""
        return len(self.frames)

    def pair(self, index: int) -> tuple[Scan, Calibration, Tensor]:
        """Return a frame's scan, camera, and image (3, h, w) uint8, stretched."""
        return self._cache.get(index, lambda: self._read(self.frames[index]))

    def _read(self, frame: Frame) -> tuple[Scan, Calibration, Tensor]:
        scan, calibration, image = frame.require("scan", "calibration", "image")
        return scan, calibration, stretched(image, self.size)

    def __getitem__(self, key: SampleIndex | int) -> CameraProjectionSample:
        """Return a sample: with the paper's flip and point drop (each p = 0.5) by a seed, or plain for an int."""
        index = key if isinstance(key, int) else key.index
        scan, calibration, pixels = self.pair(index)
        flip = False
        if not isinstance(key, int):
            generator = np.random.default_rng(key.seed)
            flip = generator.random() < 0.5
            if generator.random() < 0.5:
                scan = drop_points(scan, generator, generator.uniform(0, 0.5))
        lidar, image = project_to_camera(scan, calibration, self.size), in_unit(pixels)
        if flip:  # the projection and the image: a mirrored scan would need a mirrored camera
            lidar, image = lidar.flip(-1), image.flip(-1)
        return CameraProjectionSample(lidar, image, self.frames[index].name)


def stretched(image: np.ndarray, size: tuple[int, int]) -> Tensor:
    """Return an image (h, w, 3) uint8, resized to `size` (rows, columns): (3, rows, columns) uint8."""
    pixels = torch.from_numpy(image).movedim(2, 0)
    if pixels.shape[-2:] == size:
        return pixels.contiguous()
    # bilinear over the area of a new pixel, as viewers make images smaller
    resized = interpolate(pixels[None].float(), size=size, mode="bilinear", antialias=True)[0]
    return resized.round().clamp(0, 255).to(torch.uint8)
