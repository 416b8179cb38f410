"""Sliced Wasserstein distance between the patches of two sets of pictures, per level of a Laplacian pyramid.

Karras et al. 2018 (arXiv:1710.10196), section 5, with the numbers of their published code: patches of 7 x 7, 128 of a
picture and level, normalised per colour over the set; 4 repeats of 128 directions; times 1000. The TITAN-Net paper
(table 2): "both images are resized to 1024 x 1024", levels from "16 x 16, which is doubled until the desired
resolution is reached", and the average over the levels.
"""

from __future__ import annotations

import hashlib
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np
import torch
from torch import Tensor

from lidar2pano.metrics.inputs import Array, picture, pictures
from lidar2pano.metrics.samples import SIDES, TwoSets

LEVELS = (1024, 512, 256, 128, 64, 32, 16)  # pixels of a side; the last is the low-pass rest
PATCH, PATCHES = 7, 128
REPEATS, DIRECTIONS = 4, 128
REACH = PATCH // 2
SIZE = 3 * PATCH * PATCH
SEEN = PATCH // 2 + 3  # pixels of the next level that 7 successive pixels are grown from
SCALE = 1e3


class SlicedWasserstein(TwoSets):
    """SWD x 1000 of predicted pictures from true ones: per level, and their mean.

    As published, each picture's patches are drawn for themselves, so two sets of the very same pictures are not at
    zero but at a floor that falls with their number. With `same_places` both pictures of a frame are cut at the same
    places: identical pictures are at zero, but figures are no longer those of the paper.
    Places and directions follow from the seed and the names alone. Memory: 0.5 MB a picture.
    """

    def __init__(self, *, seed: int = 0, same_places: bool = False) -> None:
        self.seed, self.same_places = seed, same_places
        super().__init__()

    def update(self, predicted: Array, target: Array, name: str) -> None:
        """Take in the frame `name`: two pictures (H, W, 3) uint8 of one size; ValueError otherwise."""
        pictures(predicted, target)
        self.take(predicted, name, "predicted")
        self.take(target, name, "target")

    def take(self, image: Array, name: str, side: str) -> None:
        """Take in one picture (H, W, 3) uint8 of the "predicted" or the "target"; the sets may differ in size."""
        self._check_new(name, side)
        places = draw_places(self.seed, name, "both" if self.same_places else side)
        self.kept[side][name] = descriptors(pyramid(picture(image)), places)

    def figures(self) -> dict[str, float]:
        """SWD x 1000: "mean" over the levels, then "1024" to "16"; NaN when a side has no picture."""
        if not all(self.kept.values()):
            return dict.fromkeys(("mean", *map(str, LEVELS)), float("nan"))
        levels = {}
        for number, level in enumerate(LEVELS):
            first, second = (normalised(self._patches(side, number)) for side in SIDES)
            levels[str(level)] = SCALE * self._distance(first, second, level)
        return {"mean": float(np.mean(list(levels.values()))), **levels}

    def _patches(self, side: str, number: int) -> np.ndarray:
        """All descriptors (N, SIZE) of a side and level, in the order of the pictures' names."""
        kept = self.kept[side]
        return np.concatenate([kept[name][number] for name in sorted(kept)])

    def _distance(self, first: np.ndarray, second: np.ndarray, level: int) -> float:
        repeats = []
        for repeat in range(REPEATS):
            directions = draw_directions(self.seed, level, repeat)
            repeats.append(np.mean(sliced_distances(first, second, directions)))
        return float(np.mean(repeats))

    def _counted(self) -> tuple:
        return (*super()._counted(), self.seed, self.same_places)


# --- pictures to descriptors ----------------------------------------------------------------------------------------


def pyramid(image: Tensor) -> list[Tensor]:
    """The Gaussian pyramid of a picture (3, H, W): (3, L, L) float32 for every L of LEVELS, in [0, 255].

    The picture is resized to the largest bilinearly (with the wider triangle where it shrinks, as Pillow does); the
    paper names no method.
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
    places  (levels, PATCHES, 2) int64: row and column of each patch's middle.
    A level of the Laplacian pyramid is that of the Gaussian one less the next, grown (Burt and Adelson 1983). It is
    worked out only where there are patches.
    """
    cut = []
    for number, level in enumerate(levels):
        first = torch.from_numpy(places[number]) - REACH
        row, column = (first[:, axis, None] + torch.arange(PATCH) for axis in (0, 1))  # (PATCHES, 7) each
        patches = level[:, row[:, :, None], column[:, None, :]]  # (3, PATCHES, 7, 7)
        if number + 1 < len(levels):
            patches -= _grown(levels[number + 1], row, column)
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


def _grown(x: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """What `x` (3, n, n), grown to 2n, has at 7 successive rows and columns (P, 7) each: (3, P, 7, 7)."""
    n = x.shape[1]
    matrix = _growing(n)
    windows, weights = [], []
    for place in (row, column):
        first = ((place[:, :1] + 1) // 2 - 1).clamp(0, n - SEEN)
        windows.append(first + torch.arange(SEEN))
        weights.append(matrix[place[:, :, None], windows[-1][:, None, :]])  # (P, 7, SEEN)
    seen = x[:, windows[0][:, :, None], windows[1][:, None, :]]
    return weights[0] @ seen @ weights[1].mT


@cache
def _growing(n: int) -> Tensor:
    """The matrix (2n, n) that puts zeros between n pixels and blurs with (1, 4, 6, 4, 1) / 8, mirrored as `_halved`."""
    matrix = torch.zeros(2 * n, n)
    for to in range(2 * n):
        for offset, weight in zip(range(-2, 3), (1, 4, 6, 4, 1), strict=True):
            place = abs(to + offset)
            place = min(place, 2 * (2 * n - 1) - place)
            if place % 2 == 0:  # what has a pixel of n; the others are zeros
                matrix[to, place // 2] += weight / 8
    return matrix


# --- descriptors to distances ---------------------------------------------------------------------------------------


def normalised(patches: np.ndarray) -> np.ndarray:
    """Descriptors (N, SIZE) with mean 0 and deviation 1 of each colour over all of them; a colour that never varies: 0.

    float32, worked out in float64.
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
    # of different sizes: both quantile functions are constant between the edges of either
    n, m = len(first), len(second)
    edges = np.union1d(np.arange(n) * m, np.arange(m) * n)  # in units of 1 / (n m)
    width = np.diff(edges, append=n * m) / (n * m)
    return np.abs(lines[0][:, edges // m] - lines[1][:, edges // n]) @ width


def _sorted_lines(part: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Where the points (N, D) lie along each direction (K, D), sorted: (K, N)."""
    lines = (torch.from_numpy(directions) @ torch.from_numpy(part).T).numpy()
    threads = torch.get_num_threads()
    with ThreadPoolExecutor(threads) as pool:  # numpy sorts much faster than torch, but on one thread
        list(pool.map(lambda piece: piece.sort(axis=1), np.array_split(lines, threads)))
    return lines


# --- draws ----------------------------------------------------------------------------------------------------------


def draw_places(seed: int, name: str, side: str) -> np.ndarray:
    """Where the patches of a picture are cut, any place where they fit: (levels, PATCHES, 2) int64 row and column."""
    generator = _stream(seed, "places", side, name)
    return np.stack([generator.integers(REACH, level - REACH, size=(PATCHES, 2)) for level in LEVELS])


def draw_directions(seed: int, level: int, repeat: int) -> np.ndarray:
    """Directions, evenly over the sphere: (DIRECTIONS, SIZE) float32 of length 1."""
    directions = _stream(seed, "directions", str(level), str(repeat)).standard_normal((DIRECTIONS, SIZE))
    return (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)


def _stream(seed: int, *names: str) -> np.random.Generator:
    """The generator that belongs to a seed and a path of names."""
    path = "/".join(("swd", str(seed), *names))
    return np.random.default_rng(np.frombuffer(hashlib.sha256(path.encode()).digest(), dtype=np.uint32))
