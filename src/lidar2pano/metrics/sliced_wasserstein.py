"""Sliced Wasserstein distance between the patches of two sets of images, per level of a Laplacian pyramid.

Karras et al. 2018 (arXiv:1710.10196), section 5, with the numbers of their published code: patches of 7 x 7, 128 of an
image and level, normalised per colour over the set; 4 repeats of 128 directions; times 1000. The TITAN-Net paper
(table 2): "both images are resized to 1024 x 1024", levels from "16 x 16, which is doubled until the desired
resolution is reached", and the average over the levels.
"""

from __future__ import annotations

import hashlib
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Self

import numpy as np
import torch
from torch import Tensor

from lidar2pano.metrics.accumulation import SIDES, SetMetric
from lidar2pano.metrics.input_checks import Array, image_pair, image_tensor

LEVELS = (1024, 512, 256, 128, 64, 32, 16)  # pixels of a side; the last is the low-pass rest
PATCH, PATCHES = 7, 128
REPEATS, DIRECTIONS = 4, 128
REACH = PATCH // 2
SIZE = 3 * PATCH * PATCH
SUPPORT = PATCH // 2 + 3  # pixels of the next level that 7 successive upsampled pixels depend on
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
        image_pair(predicted, target)
        self.take(predicted, name, "predicted")
        self.take(target, name, "target")

    def take(self, image: Array, name: str, side: str) -> None:
        """Count one image (H, W, 3) uint8 of the "predicted" or the "target"; the sets may differ in size."""
        if self._makes_room(name, side):
            places = draw_places(self.seed, name, side)
            self.kept[side][name] = descriptors(pyramid(image_tensor(image)), places)

    def values(self) -> dict[str, float]:
        """SWD x 1000: "mean" over the levels, then "1024" to "16"; NaN when a side has no image."""
        if not all(map(len, self.kept.values())):
            return dict.fromkeys(("mean", *map(str, LEVELS)), float("nan"))
        levels = {}
        for number, level in enumerate(LEVELS):
            first, second = (normalised(self.kept[side].stacked(number).reshape(-1, SIZE)) for side in SIDES)
            levels[str(level)] = SCALE * self._distance(first, second, level)
        return {"mean": float(np.mean(list(levels.values()))), **levels}

    def thinned(self) -> Self:
        """See SetMetric."""
        metric = super().thinned()
        metric.repeats = 1
        return metric

    def _distance(self, first: np.ndarray, second: np.ndarray, level: int) -> float:
        directions = (draw_directions(self.seed, level, repeat) for repeat in range(self.repeats))
        return float(np.mean([np.mean(sliced_distances(first, second, each)) for each in directions]))


# --- images to descriptors ----------------------------------------------------------------------------------------


def pyramid(image: Tensor) -> list[Tensor]:
    """The Gaussian pyramid of an image (3, H, W): (3, L, L) float32 for every L of LEVELS, in [0, 255].

    The image is resized to the largest bilinearly with antialiasing, as Pillow does; the paper names no method.
    """
    size = (LEVELS[0], LEVELS[0])
    wide = torch.nn.functional.interpolate(image[None].float().contiguous(), size, mode="bilinear", antialias=True)[0]
    levels = [wide]
    for _ in LEVELS[1:]:
        levels.append(_halved(_halved(levels[-1], 1), 2))
    return levels


def descriptors(levels: list[Tensor], places: np.ndarray) -> np.ndarray:
    """Patches of the Laplacian pyramid: (levels, PATCHES, SIZE) float32; colour, row, column within a patch.

    levels  a Gaussian pyramid (`pyramid`).
    places  (levels, PATCHES, 2) int64: row and column of each patch's centre.
    A level of the Laplacian pyramid is that of the Gaussian one minus the upsampled next one (Burt and Adelson 1983).
    It is computed only where there are patches.
    """
    cut = []
    for number, level in enumerate(levels):
        first = torch.from_numpy(places[number]) - REACH
        row, column = (first[:, axis, None] + torch.arange(PATCH) for axis in (0, 1))  # (PATCHES, 7) each
        patches = level[:, row[:, :, None], column[:, None, :]]  # (3, PATCHES, 7, 7)
        if number + 1 < len(levels):
            patches -= _upsampled(levels[number + 1], row, column)
        cut.append(patches.movedim(0, 1).reshape(len(first), -1))
    return torch.stack(cut).numpy()


def _halved(x: Tensor, dim: int) -> Tensor:
    """Blur with (1, 4, 6, 4, 1) / 16, mirrored about the outermost pixels, and keep every other: 2n -> n along dim."""
    half = x.shape[dim] // 2
    even, odd = (x[:, first::2] if dim == 1 else x[..., first::2] for first in (0, 1))
    out = even * 0.375
    out.add_(odd, alpha=0.25)

    def add(to: int, of: Tensor, begin: int, length: int, weight: float) -> None:
        out.narrow(dim, to, length).add_(of.narrow(dim, begin, length), alpha=weight)

    add(1, odd, 0, half - 1, 0.25)
    add(0, odd, 0, 1, 0.25)
    add(1, even, 0, half - 1, 0.0625)
    add(0, even, 1, 1, 0.0625)
    add(0, even, 1, half - 1, 0.0625)
    add(half - 1, even, half - 1, 1, 0.0625)
    return out


def _upsampled(x: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """Patches (3, P, 7, 7) of `x` (3, n, n), upsampled to 2n, at 7 successive rows and columns (P, 7) each."""
    n = x.shape[1]
    matrix = _upsampling_matrix(n)
    windows, weights = [], []
    for place in (row, column):
        first = ((place[:, :1] + 1) // 2 - 1).clamp(0, n - SUPPORT)
        windows.append(first + torch.arange(SUPPORT))
        weights.append(matrix[place[:, :, None], windows[-1][:, None, :]])  # (P, 7, SUPPORT)
    window = x[:, windows[0][:, :, None], windows[1][:, None, :]]
    return weights[0] @ window @ weights[1].mT


@cache
def _upsampling_matrix(n: int) -> Tensor:
    """The matrix (2n, n) that puts zeros between n pixels and blurs with (1, 4, 6, 4, 1) / 8, mirrored as `_halved`."""
    matrix = torch.zeros(2 * n, n)
    for to in range(2 * n):
        for offset, weight in zip(range(-2, 3), (1, 4, 6, 4, 1), strict=True):
            place = abs(to + offset)
            place = min(place, 2 * (2 * n - 1) - place)
            if place % 2 == 0:  # this place has a pixel of n; the others are zeros
                matrix[to, place // 2] += weight / 8
    return matrix


# --- descriptors to distances ---------------------------------------------------------------------------------------


def normalised(patches: np.ndarray) -> np.ndarray:
    """Descriptors (N, SIZE) with mean 0 and deviation 1 of each colour over all of them; a constant colour becomes 0.

    Returns float32, computed in float64.
    """
    colours = patches.reshape(-1, 3, PATCH * PATCH).astype(np.float64)
    colours -= colours.mean((0, 2), keepdims=True)
    deviation = np.sqrt(np.square(colours).mean((0, 2), keepdims=True))
    colours /= np.where(deviation > 0, deviation, 1)
    return colours.reshape(-1, SIZE).astype(np.float32)


def sliced_distances(first: np.ndarray, second: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Wasserstein-1 distance of two sets (N, D) and (M, D) along each of K directions (K, D): (K,) float64.

    Rabin et al. 2012: along a line it is the mean distance of the sorted values.
    """
    lines = [_sorted_lines(part, directions) for part in (first, second)]
    if len(first) == len(second):
        return np.abs(lines[0] - lines[1]).mean(1, dtype=np.float64)
    # different sizes: both quantile functions are constant between the edges of either
    n, m = len(first), len(second)
    edges = np.union1d(np.arange(n) * m, np.arange(m) * n)  # in units of 1 / (n m)
    width = np.diff(edges, append=n * m) / (n * m)
    return np.abs(lines[0][:, edges // m] - lines[1][:, edges // n]) @ width


def _sorted_lines(part: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Projections of the points (N, D) on each direction (K, D), sorted: (K, N)."""
    lines = (torch.from_numpy(directions) @ torch.from_numpy(part).T).numpy()
    threads = torch.get_num_threads()
    with ThreadPoolExecutor(threads) as pool:  # numpy sorts much faster than torch, but on one thread
        list(pool.map(lambda piece: piece.sort(axis=1), np.array_split(lines, threads)))
    return lines


# --- draws ----------------------------------------------------------------------------------------------------------


def draw_places(seed: int, name: str, side: str) -> np.ndarray:
    """Centres of an image's patches, uniform where they fit: (levels, PATCHES, 2) int64 row and column."""
    generator = stream(seed, "places", side, name)
    return np.stack([generator.integers(REACH, level - REACH, size=(PATCHES, 2)) for level in LEVELS])


def draw_directions(seed: int, level: int, repeat: int) -> np.ndarray:
    """Directions, uniform over the sphere: (DIRECTIONS, SIZE) float32 of length 1."""
    directions = stream(seed, "directions", str(level), str(repeat)).standard_normal((DIRECTIONS, SIZE))
    return (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)


def stream(seed: int, *names: str) -> np.random.Generator:
    """The generator that belongs to a seed and a path of names."""
    path = "/".join(("swd", str(seed), *names))
    return np.random.default_rng(np.frombuffer(hashlib.sha256(path.encode()).digest(), dtype=np.uint32))
