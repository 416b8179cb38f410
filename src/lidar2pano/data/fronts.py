"""Samples of TITAN-Net's own setting: the front range view in, the camera's perspective segments out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from lidar2pano.data.augment import drop_points, mirror
from lidar2pano.data.ranges import labelled
from lidar2pano.data.sequences import Draw, frames
from lidar2pano.geometry.images import Normalisation
from lidar2pano.geometry.projection import project
from lidar2pano.labels import TABLES
from lidar2pano.scan import Scan
from lidar2pano.sensors import View

CAMERA_TO_COMMON14 = np.zeros(256, dtype=np.uint8)  # unsure pixels and the sky are unlabeled, as in the paper
CAMERA_TO_COMMON14[:19] = TABLES["cityscapes", "common-14"]


class FrontSample(NamedTuple):
    """One training pair; after collation every tensor gains a leading B.

    lidar     (5, H, W) float32, normalised.
    segments  (H, W) int64 ids of SEMANTIC_KITTI, 0 where empty.
    camera    (h, w) int64 ids of COMMON14, resized to the network's image.
    name      "seq/frame".
    """

    lidar: Tensor
    segments: Tensor
    camera: Tensor
    name: str


class FrontSamples:
    """Scan/camera pairs of some splits in the paper's setting.

    view  the front view; size (rows, columns) of the image the network writes.
    """

    def __init__(self, root: Path, splits: tuple[str, ...], view: View, size: tuple[int, int]) -> None:
        self.frames = [frame for split in splits for frame in frames(root, split)]
        self.view, self.size = view, size
        self.normalise = Normalisation()
        self._held: dict[int, tuple[Scan, Tensor]] = {}

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.frames)

    def pair(self, index: int) -> tuple[Scan, Tensor]:
        """Read a frame, once: its labelled scan and the camera's ids (h, w) uint8 of COMMON14, resized."""
        if index not in self._held:
            frame = self.frames[index]
            ids = torch.from_numpy(CAMERA_TO_COMMON14[frame.camera_labels()])[None, None]
            self._held[index] = labelled(frame), interpolate(ids, size=self.size, mode="nearest-exact")[0, 0]
        return self._held[index]

    def predict(self, label_points: Callable[[Scan], Tensor]) -> None:
        """Put a segmenter's labels in the place of the data's."""
        for index in range(len(self)):
            scan, camera = self.pair(index)
            self._held[index] = replace(scan, label=label_points(scan).cpu().numpy()), camera

    def __getitem__(self, draw: Draw | int) -> FrontSample:
        """Sample: with the paper's flip and point drop (each p = 0.5) by a Draw's seed, or plain for an int."""
        if isinstance(draw, int):
            return self._sample(*self.pair(draw), self.frames[draw].name)
        generator = np.random.default_rng(draw.seed)
        scan, camera = self.pair(draw.index)
        if generator.random() < 0.5:
            scan, camera = mirror(scan), camera.flip(1)
        if generator.random() < 0.5:
            scan = drop_points(scan, generator, generator.uniform(0, 0.5))
        return self._sample(scan, camera, self.frames[draw.index].name)

    def _sample(self, scan: Scan, camera: Tensor, name: str) -> FrontSample:
        image = project(scan, self.view)
        assert scan.label is not None
        return FrontSample(self.normalise(image), image.spread(torch.from_numpy(scan.label)), camera.long(), name)
