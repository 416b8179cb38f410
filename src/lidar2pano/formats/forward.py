"""The forward axis of a scan from a car, by what the car hides of the ground and by what stands along the road."""

from __future__ import annotations

import numpy as np

from lidar2pano.formats.ground_plane import Ground, blind_radii

# Evidence in natural logarithms. 174 real scans with x forward have -0.1 to 3, 18 with y forward -3 to -0.7.
SHOWS, SHOWS_AGAINST = 0.2, 0.4  # where a form has no convention, and against one
CAR_HEIGHT_M = (1.4, 2.6)  # sensors stand so high on cars
STANDING_M = (0.5, 5.0)  # above the ground
REACH_M = 50.0  # of what stands along the road
NEAR_M = 3.0
WALL_M, SMOOTH = 0.25, 17  # bins of a histogram, and of the smoothed one it is compared with
FEWEST = 500  # standing points


def evidence_of_x(xyz: np.ndarray, ground: Ground | None) -> float | None:
    """Return the evidence for x and against y as the axis along the road; None for a sensor not on a car.

    xyz  (N, 3) float64 metres, z up.
    The sum of two logarithms of ratios: a car hides the ground farther before and behind it than beside it; what
    stands along a road (walls, kerbs, hedges, rows of cars) is gathered at few places across it.
    """
    if ground is None or not CAR_HEIGHT_M[0] <= -ground.height_m <= CAR_HEIGHT_M[1]:
        return None
    along, across = ([radius for radius in radii if radius] for radii in blind_radii(xyz, ground))
    hidden = float(np.log(np.mean(along) / np.mean(across))) if along and across else 0.0
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    height = ground.height_of(xyz)
    standing = (height > STANDING_M[0]) & (height < STANDING_M[1]) & (distance > NEAR_M) & (distance < REACH_M)
    if np.count_nonzero(standing) < FEWEST:
        return hidden
    x, y, _ = xyz[standing].T
    return hidden + float(np.log(_gathered(y) / _gathered(x)))


def _gathered(values: np.ndarray) -> float:
    """Return how much values gather at few places; 1 for not at all."""
    counts = np.histogram(values, np.arange(-REACH_M, REACH_M, WALL_M))[0].astype(np.float64)
    return float((counts @ counts) / max(counts @ np.convolve(counts, np.ones(SMOOTH) / SMOOTH, "same"), 1.0))
