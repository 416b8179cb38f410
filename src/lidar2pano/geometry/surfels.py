"""Surfels: points without order as small flat ellipses, and the first ones met by rays: hidden points drop out.

A surfel lies in the plane of its point's nearest neighbours, by their covariance (Pauly, Gross, Kobbelt: Efficient
simplification of point-sampled surfaces, 2002, section 2), and is as large as they lie apart. A ray ends at
the nearest surfel it meets, averaged with those right behind, the nearer to the ray the more: the two passes,
visibility and blending, of surface splatting (Zwicker, Pfister, van Baar, Gross: Surface splatting, 2001; Botsch,
Hornung, Zwicker, Kobbelt: High-quality surface splatting on today's GPUs, 2005, section 3).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lidar2pano.errors import require_extra

if TYPE_CHECKING:
    from scipy.spatial import KDTree  # pyright: ignore[reportMissingTypeStubs]

NEIGHBOURS = 16  # of a point; a surfel covers the area of half of them: chance leaves exp(-8) of a surface uncovered
FLAT_DISC = 4.0  # the variance of a disc along an axis is a fourth of its squared radius
OUTLIER = 2.0  # times as far as its neighbours' neighbours lie a point's own: it belongs to no surface
LINE = 0.1  # of the variance across the longest axis; points on a disc have half of it at least
SAMPLE, DOUBLINGS = 2000, 6
CHUNK, PAIRS = 1 << 16, 1 << 21  # points, and surfels with rays, worked on at a time


class Surfels(NamedTuple):
    """N ellipses around the viewpoint, metres.

    centre  (N, 3) float64;  normal: (N, 3) of length 1.
    major, minor  (N, 3) half axes over their squared lengths: the product with an offset is 1 at the border.
    reach_m  (N,) length of the longer half axis;  value: (N,) float32, e.g. the mean remission.
    """

    centre: np.ndarray
    normal: np.ndarray
    major: np.ndarray
    minor: np.ndarray
    reach_m: np.ndarray
    value: np.ndarray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rays:
    """The directions of a spinning sensor: B beams x F firings.

    elevation  (B,) radians, falling;  azimuth: (B,) radians to the left of the head's direction.
    firings    F: columns from +180 degrees at the left down to -180.
    """

    elevation: np.ndarray
    azimuth: np.ndarray
    firings: int

    @property
    def step(self) -> float:
        """Azimuth between two firings, radians."""
        return 2 * np.pi / self.firings

    def directions(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Return unit vectors (N, 3) of beams and firings (N,)."""
        azimuth = np.pi - (column + 0.5) * self.step + self.azimuth[row]
        level, up = np.cos(self.elevation[row]), np.sin(self.elevation[row])
        return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up], axis=1)


def thin(xyz: np.ndarray, cell_m: float) -> np.ndarray:
    """Return the indices of the first of the points (N, 3) in each cube of `cell_m`."""
    return first_of_each(np.floor(xyz / cell_m).astype(np.int64))


def thin_by_range(xyz: np.ndarray, step: float) -> np.ndarray:
    """Return the indices of the first of the points (N, 3) in each cell of `step` radians, and as deep as wide."""
    level = np.hypot(xyz[:, 0], xyz[:, 1])
    cells = (np.arctan2(xyz[:, 1], xyz[:, 0]), np.arctan2(xyz[:, 2], level), np.log(np.hypot(level, xyz[:, 2])))
    return first_of_each(np.floor(np.stack(cells, axis=1) / step).astype(np.int64))


def first_of_each(cells: np.ndarray) -> np.ndarray:
    """Return the indices of the first row of each value, in order, of integers (N, 3) within +-2**20."""
    i, j, k = cells.T
    return np.sort(np.unique(((i << 42) + (j << 21)) + k, return_index=True)[1])


def find_spacing(xyz: np.ndarray) -> float:
    """Return the distance of points (N, 3) on their surfaces, metres: far enough not to be mere lines.

    Scanners on vehicles leave lines of points, closer along them than across. The distance is doubled until half of
    the neighbourhoods are wider than LINE. The density of the nearest 16 points gives it.
    """
    chosen, spacing_m = xyz, 0.0
    for _ in range(DOUBLINGS):
        tree = _tree(chosen)
        sample = chosen[:: max(1, len(chosen) // SAMPLE)]
        distance, near = _nearest(tree, sample)
        spacing_m = max(spacing_m, float(np.median(distance[:, -1])) * np.sqrt(np.pi / near.shape[1]))
        variance = np.linalg.eigvalsh(_covariance(chosen[near])[1])
        if not spacing_m or np.median(variance[:, 1] / np.maximum(variance[:, 2], 1e-12)) >= LINE:
            break
        spacing_m *= 2
        chosen = xyz[thin(xyz, spacing_m)]
    return spacing_m


def fit_surfels(xyz: np.ndarray, values: np.ndarray, cell_m: np.ndarray) -> Surfels:
    """Return the surfels of points (N, 3) float64 with values (N,), metres from the viewpoint; without lone points.

    cell_m  (N,) width of the cells in which the points were thinned out; they are to their spacing where it is less.
    A surfel is as wide as this at least. Points in a line, of poles and wires, get one along it, facing the
    viewpoint.
    """
    spacing_m = find_spacing(xyz)
    dense = np.flatnonzero(cell_m < spacing_m)
    chosen = np.concatenate([dense[thin(xyz[dense], spacing_m)], np.flatnonzero(cell_m >= spacing_m)])
    xyz, values, cell_m = xyz[chosen], values[chosen], np.maximum(cell_m[chosen], spacing_m)
    tree, parts = _tree(xyz), list[Surfels]()
    chunks = [slice(start, start + CHUNK) for start in range(0, len(xyz), CHUNK)]
    queries = [_nearest(tree, xyz[chunk]) for chunk in chunks]
    reach = np.concatenate([distance[:, -1] for distance, _ in queries])
    for chunk, (distance, near) in zip(chunks, queries, strict=True):
        joined = distance[:, -1] <= OUTLIER * np.median(reach[near], axis=1)
        members = near[joined]
        parts.append(_ellipses(xyz[members], values[members].mean(axis=1), cell_m[chunk][joined] / 2))
    return Surfels(*map(np.concatenate, zip(*parts, strict=True)))


def _ellipses(near: np.ndarray, value: np.ndarray, least_m: np.ndarray) -> Surfels:
    """Return the surfels of neighbourhoods (N, K, 3), their half axes of `least_m` (N,) at least."""
    centre, covariance = _covariance(near)
    variance, axes = np.linalg.eigh(covariance)
    length = np.sqrt(np.maximum(variance[:, 1:], 0) * FLAT_DISC / 2)  # half of the disc's area
    length = np.maximum(length, least_m[:, None])
    normal, longest = axes[:, :, 0], axes[:, :, 2]
    line = variance[:, 1] < LINE * variance[:, 2]
    facing = centre - longest * np.einsum("ij,ij->i", centre, longest)[:, None]
    size = np.linalg.norm(facing, axis=1, keepdims=True)
    line &= size[:, 0] > 1e-9
    normal = np.where(line[:, None], facing / np.maximum(size, 1e-9), normal)
    across = np.cross(normal, longest)
    return Surfels(
        centre=centre,
        normal=normal,
        major=longest / length[:, 1:],
        minor=across / length[:, :1],
        reach_m=length[:, 1],
        value=value.astype(np.float32),
    )


def _tree(xyz: np.ndarray) -> KDTree:
    with require_extra("formats", "--at"):
        from scipy.spatial import KDTree  # pyright: ignore[reportMissingTypeStubs]
    return KDTree(xyz)


def _nearest(tree: KDTree, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distances (N, K) and indices of the nearest NEIGHBOURS points, itself among them."""
    distance, near = tree.query(xyz, k=min(NEIGHBOURS, tree.n))
    return np.reshape(distance, (len(xyz), -1)), np.reshape(near, (len(xyz), -1))


def _covariance(near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the means (N, 3) and covariances (N, 3, 3) of neighbourhoods (N, K, 3)."""
    mean = near.mean(axis=1)
    offset = near - mean[:, None]
    return mean, np.einsum("nki,nkj->nij", offset, offset) / near.shape[1]


def first_hits(surfels: Surfels, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """Return the ranges of the rays (B, F) float32, metres, inf where they meet nothing; and the surfels' values there.

    A surfel around the viewpoint itself is not met.
    """
    outside = np.linalg.norm(surfels.centre, axis=1) > surfels.reach_m
    surfels = Surfels(*(part[outside] for part in surfels))
    hits = [np.concatenate(part) for part in zip(*_hits(surfels, rays), strict=True)]
    count = len(rays.elevation) * rays.firings
    ranges, value = np.full(count, np.inf), np.zeros(count)
    if hits:
        ray, owner, range_m, weight = hits
        np.minimum.at(ranges, ray, range_m)
        front = range_m <= ranges[ray] + surfels.reach_m[owner]
        ray, owner, range_m, weight = (part[front] for part in (ray, owner, range_m, weight))
        total = np.bincount(ray, weight, count)
        met = total > 0
        ranges[met] = np.bincount(ray, weight * range_m, count)[met] / total[met]
        value[met] = np.bincount(ray, weight * surfels.value[owner], count)[met] / total[met]
    shape = len(rays.elevation), rays.firings
    return ranges.reshape(shape).astype(np.float32), value.reshape(shape).astype(np.float32)


def _hits(surfels: Surfels, rays: Rays) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Yield rays, the surfels they meet, ranges and weights; the surfels in the order of their number of rays."""
    for owner, row, column in _candidates(surfels, rays):
        direction = rays.directions(row, column)
        toward = np.einsum("ij,ij->i", surfels.normal[owner], direction)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            range_m = np.einsum("ij,ij->i", surfels.normal[owner], surfels.centre[owner]) / toward
            offset = direction * range_m[:, None] - surfels.centre[owner]
            square = np.einsum("ij,ij->i", offset, surfels.major[owner]) ** 2
            square += np.einsum("ij,ij->i", offset, surfels.minor[owner]) ** 2
            met = (range_m > 0) & (square <= 1)
        ray = row[met] * rays.firings + column[met]
        yield ray, owner[met], range_m[met], np.exp(-2 * square[met])


def _candidates(surfels: Surfels, rays: Rays) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield surfels with the rays (row, column) near them: in the box of angles around their sphere."""
    x, y, z = surfels.centre.T
    range_m = np.sqrt(x * x + y * y + z * z)
    azimuth, elevation = np.arctan2(y, x), np.arcsin(z / range_m)
    width = np.arcsin(np.minimum(surfels.reach_m / range_m, 1))
    rising = rays.elevation[::-1]
    first, end = np.searchsorted(rising, elevation - width), np.searchsorted(rising, elevation + width)
    lengths = np.sin(width) / np.maximum(np.cos(elevation), 1e-9)
    half = np.where(lengths < 1, np.arcsin(np.minimum(lengths, 1)), np.pi) / rays.step
    counts = (end - first) * (np.floor(2 * np.minimum(half, rays.firings / 2)).astype(np.int64) + 1)
    edges = np.searchsorted(np.cumsum(counts), np.arange(PAIRS, counts.sum() + PAIRS, PAIRS))
    for begin, stop in zip([0, *edges], [*edges, len(surfels.centre)], strict=True):
        chosen = np.arange(begin, stop)
        owner = np.repeat(chosen, (end - first)[begin:stop])
        row = len(rising) - 1 - (first[owner] + _places((end - first)[begin:stop]))
        middle = (np.pi + rays.azimuth[row] - azimuth[owner]) / rays.step - 0.5
        left = np.ceil(middle - half[owner]).astype(np.int64)
        columns = np.floor(middle + half[owner]).astype(np.int64) - left + 1
        columns = np.clip(columns, 0, rays.firings)
        column = np.repeat(left, columns) + _places(columns)
        yield np.repeat(owner, columns), np.repeat(row, columns), column % rays.firings


def _places(counts: np.ndarray) -> np.ndarray:
    """Return 0 .. n-1 for each of the counts, one after the other."""
    starts = np.cumsum(counts) - counts
    return np.arange(counts.sum()) - np.repeat(starts, counts)
