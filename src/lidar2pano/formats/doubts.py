"""Doubts: implausible properties of points, a sentence each."""

from __future__ import annotations

import numpy as np

from lidar2pano.formats.ground_plane import fit_ground
from lidar2pano.formats.sensor_placement import OTHER_AXES

SWEEP_POINTS = 500  # usable ones; the sparsest LiDAR gives thousands
ENOUGH_POINTS = 10_000  # without a ground among so many, something is wrong
MOST_ODD = 0.02  # of the coordinates are no lengths
MOST_UNUSABLE = 0.1  # of the points in a file without rows of an image, which has no marks of missing returns
SMALLEST, LARGEST = 1e-12, 1e7  # of a nonzero coordinate, in any unit: others are bytes of something else


def doubts_about(xyz: np.ndarray, returns: np.ndarray, *, rows: bool) -> list[str]:
    """Return doubts about points (N, 3) as the file holds them, whose usable ones are `returns` (N,) bool.

    rows  whether the file is nothing but rows of numbers.
    """
    doubts = []
    usable = int(np.count_nonzero(returns))
    if usable < SWEEP_POINTS:
        doubts.append(f"only {usable} of its points can be used, which is no sweep of a LiDAR; name a whole scan")
    with np.errstate(invalid="ignore", over="ignore"):  # float16 is compared, too
        size = np.abs(xyz)
        odd = float(np.mean((size > LARGEST) | ((size > 0) & (size < SMALLEST)))) if len(xyz) else 0.0
    unusable = 1 - usable / max(len(xyz), 1)
    if odd > MOST_ODD or (rows and unusable >= MOST_UNUSABLE):
        share = max(odd, unusable)
        doubts.append(
            f"{share:.0%} of its numbers are no coordinates; is it float64 or big-endian, or has other columns?"
        )
    return doubts


def doubts_about_ground(sample: np.ndarray) -> list[str]:
    """Return doubts about points (N, 3), metres, without a ground below the origin."""
    sample = sample[np.isfinite(sample).all(1)].astype(np.float64)
    if len(sample) < ENOUGH_POINTS:
        return []
    for cause, turn in OTHER_AXES.items():
        turned = fit_ground(sample @ turn.T)
        if turned and turned.height_m < 0:
            return [f"no ground was found, and {cause}; write x forward, y left, z up"]
    return ["no ground was found below the sensor; is it in metres, z up, and a scan from a vehicle?"]
