"""Sliced Wasserstein distance of image pairs, the quantity and the scale that the TITAN-Net paper prints.

The paper names Karras et al. 2018 and prints 1.4 to 4.8 "x 10^3". Between the patches of two whole sets (their
definition, `sliced_wasserstein`) distances times 1000 are some 5 where images look alike and hundreds where they do
not. The paper's numbers are those of a public PyTorch version, https://github.com/koshian2/swd-pytorch (MIT), of one
generated image and its real one at a time, in thousands. That version
  - divides a random direction by the standard deviation of its 147 numbers, not by its length, which makes distances
    147 ** 0.5 = 12.1 times as large, and multiplies by 1000;
  - cuts patches at the same random places of both images; pads with zeros; doubles pixels before it blurs.
Two photographs of KITTI that have nothing to do with each other are at 2.2 at every level but the last and at 5.0
there, 2.6 on the mean; the paper's systems are at 1.8 to 2.9. So this distance says little about images.
Our number is that version's divided by 1000, averaged over frames.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, interpolate

from lidar2pano.metrics.accumulation import FrameMetric
from lidar2pano.metrics.input_checks import Array, image_pair
from lidar2pano.metrics.sliced_wasserstein import DIRECTIONS, LEVELS, PATCH, PATCHES, REPEATS, SIZE, stream

LINE = torch.tensor([1.0, 4.0, 6.0, 4.0, 1.0]) / 16
BLUR = torch.outer(LINE, LINE).expand(3, 1, 5, 5)


class PairwiseSlicedWasserstein(FrameMetric):
    """SWD of image pairs: the mean over the levels, then each level; means over frames. See the module."""

    def __init__(self, *, seed: int = 0) -> None:
        self.seed = seed
        super().__init__(*map(str, LEVELS), "frames")

    def update(self, predicted: Array, target: Array, name: str) -> None:
        """Count the frame `name`: two images (H, W, 3) uint8 of one size; ValueError otherwise."""
        self._keep(name, *pair_distances(*image_pair(predicted, target), self.seed, name), 1.0)

    def values_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """Means from sums (..., 8)."""
        levels = sums[..., :-1] / sums[..., -1:]
        return {"mean": levels.mean(-1)} | {str(level): levels[..., at] for at, level in enumerate(LEVELS)}


def pair_distances(predicted: Tensor, target: Tensor, seed: int, name: str) -> list[float]:
    """The distance of two images (3, H, W) uint8 at every level of LEVELS."""
    sides = [laplacian_pyramid(image) for image in (predicted, target)]
    distances = []
    for number, level in enumerate(LEVELS):
        generator = stream(seed, "pairs", name, str(level))
        across = level - PATCH + 1
        places = torch.from_numpy(generator.permutation(across * across)[:PATCHES])
        directions = torch.from_numpy(generator.standard_normal((SIZE, REPEATS * DIRECTIONS), dtype=np.float32))
        directions /= directions.std(0, keepdim=True)
        lines = [(_patches(side[number], places, across) @ directions).sort(0).values for side in sides]
        distances.append((lines[0] - lines[1]).abs().mean().item())
    return distances


def laplacian_pyramid(image: Tensor) -> list[Tensor]:
    """(3, L, L) float32 for every L of LEVELS: differences, and the low-pass rest. Image (3, H, W) uint8."""
    size = (LEVELS[0], LEVELS[0])
    blurred = [interpolate(image[None].float().contiguous(), size, mode="bilinear", antialias=True)]
    for _ in LEVELS[1:]:
        blurred.append(conv2d(blurred[-1], BLUR, stride=2, padding=2, groups=3))
    doubled = [conv2d(interpolate(level, scale_factor=2), BLUR, padding=2, groups=3) for level in blurred[1:]]
    return [*((a - b)[0] for a, b in zip(blurred, doubled, strict=False)), blurred[-1][0]]


def _patches(level: Tensor, places: Tensor, across: int) -> Tensor:
    """Patches (P, SIZE) whose upper left pixels have the numbers `places`; mean 0 and deviation 1 of each colour."""
    reach = torch.arange(PATCH)
    row, column = (first[:, None] + reach for first in (places // across, places % across))
    cut = level[:, row[:, :, None], column[:, None, :]].movedim(1, 0)  # (P, 3, 7, 7)
    deviation, mean = torch.std_mean(cut, dim=(0, 2, 3), keepdim=True)
    return ((cut - mean) / (deviation + 1e-8)).reshape(len(places), -1)
