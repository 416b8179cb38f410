"""Where a spinning LiDAR stood: the point from which its returns lie on sharp cones, one for each beam."""

from __future__ import annotations

import numpy as np

BIN_DEG, SMOOTH = 0.05, 31  # of the histogram of elevations, and of the smoothed one it is compared with
MOST_DEG = 35.0
SAMPLE = 15_000
START_M, LAST_M = 0.5, 0.03  # steps of the search
REACH_M = 3.0  # it goes no farther from where it begins
CLEARLY = 1.1  # times as sharp as where it begins
NEAR_M, FAR_M = 5.0, 80.0  # of points that are looked at: nearer ones blur with the beam's own offsets
DIRECTIONS = 12  # along which the points are halved


def sharpness(xyz: np.ndarray, origin: np.ndarray) -> float:
    """How much elevations of points (N, 3) from `origin` gather at few values; 1 where they do not at all."""
    x, y, z = (xyz - origin).T
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    counts = np.histogram(elevation, np.arange(-MOST_DEG, MOST_DEG, BIN_DEG))[0].astype(np.float64)
    smooth = np.convolve(counts, np.ones(SMOOTH) / SMOOTH, "same")
    return float((counts @ counts) / max(counts @ smooth, 1.0))


def sharpest_origin(xyz: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The sharpest origin (3,) near `start`, by a pattern search; `start` itself where none is clearly sharper."""
    distance = np.linalg.norm(xyz - start, axis=1)
    sample = xyz[(distance > NEAR_M) & (distance < FAR_M)]
    sample = sample[:: max(1, len(sample) // SAMPLE)]
    steps = np.arange(-REACH_M / 2, REACH_M / 2 + 0.01, START_M / 2)
    first = sharpness(sample, start)
    best, score = max(
        ((start + (x, 0, z), sharpness(sample, start + (x, 0, z))) for x in steps for z in steps[::2]),
        key=lambda found: found[1],
    )
    step = START_M / 2
    while step >= LAST_M:
        tried = [best + step * np.eye(3)[axis] * sign for axis in range(3) for sign in (-1, 1)]
        scores = [sharpness(sample, origin) for origin in tried]
        if max(scores) > score:
            best, score = tried[int(np.argmax(scores))], max(scores)
        else:
            step /= 2
    return best if score > CLEARLY * first and np.abs(best - start).max() <= REACH_M else start


def horizontal_centre(xyz: np.ndarray) -> np.ndarray:
    """The point (3,) that halves the points (N, 3) along every direction, at the height of the lower ones.

    A LiDAR takes as many points on one side of any line through it as on the other: it stands about there.
    """
    azimuth = np.linspace(0, np.pi, DIRECTIONS, endpoint=False)
    across = np.column_stack([np.cos(azimuth), np.sin(azimuth)])
    middle = np.median(xyz, axis=0)
    local = xyz[:, :2] - middle[:2]
    medians = [np.median(local @ direction) for direction in across]
    centre = np.linalg.lstsq(across, np.array(medians), rcond=None)[0]
    return np.array([*(middle[:2] + centre), np.percentile(xyz[:, 2], 10)])
