"""Sliced Wasserstein distance between the patches of two sets of images, per level of a Laplacian pyramid.

Karras et al. 2018 (arXiv:1710.10196), section 5, with the numbers of their published code: patches of 7 x 7, 128 of an
image and level, normalised per colour over the set; 4 repeats of 128 directions; times 1000. The TITAN-Net paper
(table 2): "both images are resized to 1024 x 1024", levels from "16 x 16, which is doubled until the desired
resolution is reached", and the average over the levels.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from typing import Self

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, interpolate, pad

from lidar2pano.metrics.accumulation import Array, FrameMetric, SetMetric, image_pair

LEVELS = (1024, 512, 256, 128, 64, 32, 16)  # pixels of a side; the last is the low-pass rest
PATCH, PATCHES = 7, 128
REPEATS, DIRECTIONS = 4, 128
REACH = PATCH // 2
SIZE = 3 * PATCH * PATCH
LINE = torch.tensor([1.0, 4.0, 6.0, 4.0, 1.0]) / 16
BLUR, MARGIN = torch.outer(LINE, LINE).expand(3, 1, 5, 5), (2, 2, 2, 2)
SCALE = 1e3


class SlicedWasserstein(SetMetric):
    """SWD x 1000 between predicted and target images: per level, and their mean.

    As published, patches are drawn for each image on its own, so two equal sets are not at zero but at a floor that
    falls with their number. Places and directions follow from the seed and the names alone. Of an image 0.5 MB are
    kept, so a set takes 1.1 GB of disk at most.
    """

    MOST = 2048  # images of a side

    def __init__(self, *, seed: int = 0) -> None:
        self.seed, self.repeats = seed, REPEATS
        super().__init__()

    def update(self, predicted: Array, target: Array, name: str) -> None:
        """Count the frame `name`: two images (H, W, 3) uint8 of one size; ValueError otherwise."""
        pair = image_pair(predicted, target)
        if self._makes_room(name):
            places = (draw_places(self.seed, name, side) for side in ("predicted", "target"))
            self._keep(name, *map(descriptors, map(pyramid, pair), places))

    def values(self) -> dict[str, float]:
        """SWD x 1000: "mean" over the levels, then "1024" to "16"; NaN without images."""
        if not len(self):
            return dict.fromkeys(("mean", *map(str, LEVELS)), float("nan"))
        levels = {}
        for number, level in enumerate(LEVELS):
            first, second = (normalised(self.stacked(side, number).reshape(-1, SIZE)) for side in (0, 1))
            levels[str(level)] = SCALE * self._distance(first, second, level)
        return {"mean": float(np.mean(list(levels.values()))), **levels}

    def without(self, names: Collection[str]) -> Self:
        """See SetMetric; of one repeat."""
        metric = super().without(names)
        metric.repeats = 1
        return metric

    def _distance(self, first: np.ndarray, second: np.ndarray, level: int) -> float:
        directions = (draw_directions(self.seed, level, repeat) for repeat in range(self.repeats))
        return float(np.mean([np.mean(sliced_distances(first, second, matrix)) for matrix in directions]))


# --- images to descriptors ----------------------------------------------------------------------------------------


def pyramid(image: Tensor, border: str = "reflect") -> list[Tensor]:
    """Return the Gaussian pyramid of an image (3, H, W): (3, L, L) float32 for every L of LEVELS, in [0, 255].

    The image is resized to the largest bilinearly with antialiasing, as Pillow does; the paper names no method. Each
    level is blurred, with its `border` as in torch's `pad` (mirrored about the outermost pixels), and every other pixel
    kept.
    """
    size = (LEVELS[0], LEVELS[0])
    levels = [interpolate(image[None].float().contiguous(), size, mode="bilinear", antialias=True)]
    for _ in LEVELS[1:]:
        levels.append(conv2d(pad(levels[-1], MARGIN, mode=border), BLUR, stride=2, groups=3))
    return [level[0] for level in levels]


def descriptors(levels: list[Tensor], places: np.ndarray) -> np.ndarray:
    """Cut patches of the Laplacian pyramid: (levels, PATCHES, SIZE) float32; colour, row, column of a patch.

    levels  a Gaussian pyramid (`pyramid`).
    places  (levels, PATCHES, 2) int64: row and column of each patch's centre.
    A level of the Laplacian pyramid is the Gaussian one minus the upsampled next one (Burt and Adelson 1983).
    """
    corners = torch.from_numpy(places - REACH)
    patches = []
    for number, level in enumerate(levels):
        band = level if number + 1 == len(levels) else level - _upsampled(levels[number + 1])
        patches.append(_cut(band, corners[number, :, 0], corners[number, :, 1]).flatten(1))
    return torch.stack(patches).numpy()


def _cut(level: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Return patches (P, 3, PATCH, PATCH) of a level (3, n, n), with their first rows and columns (P,)."""
    row, column = (first[:, None] + torch.arange(PATCH) for first in (rows, columns))
    return level[:, row[:, :, None], column[:, None, :]].movedim(1, 0)


def _upsampled(x: Tensor) -> Tensor:
    """Put zeros between the pixels of (3, n, n), mirrored about the outermost ones, and blur: (3, 2n, 2n)."""
    wide = x.new_zeros(1, 3, 2 * x.shape[1], 2 * x.shape[2])
    wide[0, :, ::2, ::2] = x
    return conv2d(pad(wide, MARGIN, mode="reflect"), 4 * BLUR, groups=3)[0]


# --- descriptors to distances ---------------------------------------------------------------------------------------


def normalised(patches: np.ndarray) -> np.ndarray:
    """Return descriptors (N, SIZE) with mean 0 and deviation 1 of each colour over all; a constant colour becomes 0.

    Returns float32, computed in float64.
    """
    colours = patches.reshape(-1, 3, PATCH * PATCH).astype(np.float64)
    colours -= colours.mean((0, 2), keepdims=True)
    deviation = np.sqrt(np.square(colours).mean((0, 2), keepdims=True))
    colours /= np.where(deviation > 0, deviation, 1)
    return colours.reshape(-1, SIZE).astype(np.float32)


def sliced_distances(first: np.ndarray, second: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the Wasserstein-1 distance of two sets (N, D) along each of K directions (K, D): (K,) float64.

    Rabin et al. 2012: along a line it is the mean distance of the sorted values.
    """
    first, second = (_sorted_lines(part, directions) for part in (first, second))
    return np.abs(first - second).mean(1, dtype=np.float64)


def _sorted_lines(part: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return projections of the points (N, D) on each direction (K, D), sorted: (K, N)."""
    lines = (torch.from_numpy(directions) @ torch.from_numpy(part).T).numpy()
    threads = torch.get_num_threads()
    with ThreadPoolExecutor(threads) as pool:  # numpy sorts much faster than torch, but on one thread
        list(pool.map(lambda piece: piece.sort(axis=1), np.array_split(lines, threads)))
    return lines


# --- draws ----------------------------------------------------------------------------------------------------------


def draw_places(seed: int, name: str, side: str) -> np.ndarray:
    """Draw centres of an image's patches, uniformly inside: (levels, PATCHES, 2) int64 row and column."""
    generator = stream(seed, "places", side, name)
    return np.stack([generator.integers(REACH, level - REACH, size=(PATCHES, 2)) for level in LEVELS])


def draw_directions(seed: int, level: int, repeat: int) -> np.ndarray:
    """Draw directions, uniformly over the sphere: (DIRECTIONS, SIZE) float32 of length 1."""
    directions = stream(seed, "directions", str(level), str(repeat)).standard_normal((DIRECTIONS, SIZE))
    return (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)


def stream(seed: int, *names: str) -> np.random.Generator:
    """Return the generator of a seed and a path of names."""
    path = "/".join(("swd", str(seed), *names))
    return np.random.default_rng(np.frombuffer(hashlib.sha256(os.fsencode(path)).digest(), dtype=np.uint32))


# --- pairs of images --------------------------------------------------------------------------------------------------


class PairwiseSlicedWasserstein(FrameMetric):
    """SWD of image pairs: the mean over the levels, then each level; means over frames. TITAN-Net's paper prints it.

    Its numbers, 1.4 to 4.8 "x 10^3", are those of https://github.com/koshian2/swd-pytorch (MIT), of one generated image
    and its real one at a time; ours is 1/1000 of them. That version differs from Karras et al. (`SlicedWasserstein`):
      - it divides a random direction by the standard deviation of its 147 numbers, not by its length, which makes
        distances 147 ** 0.5 = 12.1 times as large, and multiplies by 1000;
      - it cuts patches at the same random places of both images; pads with zeros; doubles pixels before it blurs.
    Two unrelated photographs of KITTI are at 2.6, the paper's systems at 1.8 to 2.9: it says little about images.
    """

    def __init__(self, *, seed: int = 0) -> None:
        self.seed = seed
        super().__init__(*map(str, LEVELS), "frames")

    def update(self, predicted: Array, target: Array, name: str) -> None:
        """Count the frame `name`: two images (H, W, 3) uint8 of one size; ValueError otherwise."""
        self._keep(name, *pair_distances(*image_pair(predicted, target), self.seed, name), 1.0)

    def values_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """Return means from sums (..., 8)."""
        levels = sums[..., :-1] / sums[..., -1:]
        return {"mean": levels.mean(-1)} | {str(level): levels[..., number] for number, level in enumerate(LEVELS)}


def pair_distances(predicted: Tensor, target: Tensor, seed: int, name: str) -> list[float]:
    """Return the distance of two images (3, H, W) uint8 at every level of LEVELS."""
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
    """Return (3, L, L) float32 for every L of LEVELS: differences, and the low-pass rest. Image (3, H, W) uint8."""
    blurred = pyramid(image, "constant")
    doubled = [conv2d(interpolate(level[None], scale_factor=2), BLUR, padding=2, groups=3)[0] for level in blurred[1:]]
    return [*(a - b for a, b in zip(blurred, doubled, strict=False)), blurred[-1]]


def _patches(level: Tensor, places: Tensor, across: int) -> Tensor:
    """Return patches (P, SIZE) with upper left pixels of numbers `places`; mean 0 and deviation 1 of each colour."""
    cut = _cut(level, places // across, places % across)
    deviation, mean = torch.std_mean(cut, dim=(0, 2, 3), keepdim=True)
    return ((cut - mean) / (deviation + 1e-8)).reshape(len(places), -1)
