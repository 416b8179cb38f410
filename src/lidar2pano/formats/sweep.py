"""Tests of whether points are a sweep: an offset of the coordinates, a map's density, sectors without points."""

from __future__ import annotations

import numpy as np

from lidar2pano.errors import InputError

# Median over 99th percentile of ranges; beyond, points do not thin out with distance as a sweep's do.
FLAT_SHARE, FLAT_FROM_M = 0.45, 30.0
DENSE, FEWEST_DENSE = 4, 300  # points of a direction (1 x 1 degree), and such directions, to decide by
MAP_SPREAD = 0.12  # standard deviation of the logarithm of ranges within a direction: sweeps 0.02 to 0.06 if flat
SAMPLE = 10_000  # points to find a repeated one among
REPEATED, FEWEST_REPEATS = 0.01, 100  # of the points at exactly one place are no echoes
PROJECTION = np.array([1.0, np.sqrt(2), np.sqrt(3)])  # brings equal points together when sorted
GAP_DEG = 15.0  # a sector of so many degrees without any point is out of the field of view
SLIVER_DEG = 2.0  # a few stray points between two gaps
NARROWEST_DEG = 60.0  # in view; less is no sweep


def is_offset(sample: np.ndarray) -> bool:
    """Return whether the points lie together and all far from the origin, as in UTM coordinates."""
    centre = np.median(sample, axis=0)
    spread = np.percentile(np.abs(sample - centre), 90)
    return float(np.abs(centre).max()) > 5 * spread


def is_map(sample: np.ndarray, away: bool) -> bool:
    """Return whether points do not thin out with distance, and lie behind each other, as no sweep's do.

    away  whether they had an offset, as a survey's do: then the former alone is enough.
    """
    range_m = np.sqrt(np.einsum("ij,ij->i", sample, sample))
    middle, most = np.percentile(range_m, (50, 99))
    if most < FLAT_FROM_M or middle < FLAT_SHARE * most or away:
        return bool(most >= FLAT_FROM_M and middle >= FLAT_SHARE * most)
    azimuth = np.arctan2(sample[:, 1], sample[:, 0])
    elevation = np.arcsin(np.clip(sample[:, 2] / np.maximum(range_m, 1e-9), -1, 1))
    cell = np.floor(np.degrees(azimuth) + 180) * 181 + np.floor(np.degrees(elevation) + 90)
    _, cell, counts = np.unique(cell, return_inverse=True, return_counts=True)
    mean = np.bincount(cell, np.log(range_m)) / counts
    spread = np.bincount(cell, (np.log(range_m) - mean[cell]) ** 2)
    dense = counts >= DENSE
    if np.count_nonzero(dense) < FEWEST_DENSE:
        return False
    return bool(np.sqrt(spread[dense].sum() / counts[dense].sum()) > MAP_SPREAD)


def repeated_point(sample: np.ndarray) -> np.ndarray | None:
    """Return the place (3,) of so many of the points (N, 3) as only a mark of missing returns has; None without one."""
    sample = sample[:: max(1, len(sample) // SAMPLE)]
    if len(sample) < FEWEST_REPEATS:
        return None
    order = np.argsort(sample @ PROJECTION, kind="stable")
    start = np.flatnonzero(np.r_[True, (np.diff(sample[order], axis=0) != 0).any(1)])
    counts = np.diff(np.append(start, len(sample)))
    longest = int(np.argmax(counts))
    enough = max(FEWEST_REPEATS, REPEATED * len(sample))
    return sample[order[start[longest]]] if counts[longest] >= enough else None


def find_gaps(xyz: np.ndarray, invent: bool) -> tuple[tuple[float, float], ...]:
    """Return sectors (left, right) of azimuth, degrees, without any point: left in (-180, 180], right below it.

    Raises InputError if little else is left, unless the panorama is to `invent` it.
    """
    bins = 1440
    turn = np.floor((np.arctan2(xyz[:, 1], xyz[:, 0]) / np.pi + 1) * (bins / 2)).astype(np.int64) % bins
    empty = np.bincount(turn, minlength=bins) == 0
    if not empty.any():
        return ()
    begin = int(np.argmin(empty))  # a bin with points
    runs = np.flatnonzero(np.diff(np.r_[False, np.roll(empty, -begin), False].astype(np.int8)))
    gaps: list[tuple[float, float]] = []
    for first, end in zip(runs[::2], runs[1::2], strict=True):
        right, left = ((edge + begin) * 360 / bins - 180 for edge in (first, end))
        if gaps and right - gaps[-1][0] < SLIVER_DEG and min(left - right, gaps[-1][0] - gaps[-1][1]) >= SLIVER_DEG:
            right = gaps.pop()[1]
        gaps.append((float(left), float(right)))
    gaps = [(left - 360 * (left > 180), right - 360 * (left > 180)) for left, right in gaps if left - right >= GAP_DEG]
    view_deg = 360 - sum(left - right for left, right in gaps)
    if view_deg < NARROWEST_DEG and not invent:
        raise InputError(
            f"is no sweep all around: only {view_deg:.0f} of 360 degrees hold points; --invent paints the rest anyway"
        )
    return tuple(gaps)
