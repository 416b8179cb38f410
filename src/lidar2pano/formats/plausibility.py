"""Doubts: statistics of a cloud that no LiDAR on a vehicle gives, each as a line that says what was probably meant."""

from __future__ import annotations

import numpy as np

from lidar2pano.formats.ground_plane import fit_ground

FEWEST_POINTS = 500  # usable ones; the sparsest LiDAR gives thousands
ENOUGH_POINTS = 10_000  # without a ground among so many, something is wrong
MOST_ODD = 0.02  # of the coordinates that are no lengths
MOST_UNUSABLE = 0.1  # of the points in a file without rows of an image, where nothing marks what did not return
MOST_FULL = 0.5  # of the remissions that are full
SMALLEST, LARGEST = 1e-12, 1e7  # of a coordinate that is not zero, in any unit: others are bytes of something else
# What the axes may be instead, and how such points are turned into ours.
OTHER_AXES = {
    "z seems to point down": np.diag([1.0, -1.0, -1.0]),
    "the axes seem to be a camera's (z forward, y down)": np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
    "y seems to point up": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
}


def doubts_about(xyz: np.ndarray, returns: np.ndarray, remission: np.ndarray, *, rows: bool) -> list[str]:
    """What is strange about points (N, 3) as the file holds them, of which `returns` (N,) bool are usable.

    remission  (N,) in [0, 1] as it was scaled;  rows: whether the file is nothing but rows of numbers.
    """
    found = []
    usable = int(np.count_nonzero(returns))
    if usable < FEWEST_POINTS:
        found.append(f"only {usable} of its points can be used, which is no sweep of a LiDAR; name a whole scan")
    with np.errstate(invalid="ignore", over="ignore"):  # float16 is compared, too
        size = np.abs(xyz)
        odd = float(np.mean((size > LARGEST) | ((size > 0) & (size < SMALLEST)))) if len(xyz) else 0.0
    unusable = 1 - usable / max(len(xyz), 1)
    if odd > MOST_ODD or (rows and unusable >= MOST_UNUSABLE):
        share = max(odd, unusable)
        found.append(
            f"{share:.0%} of its numbers are no coordinates; is it float64 or big-endian, or has other columns?"
        )
    if usable and float(np.mean(remission[returns] >= 1)) > MOST_FULL:
        found.append("most of its points have full remission; name the scale with --remission")
    return found


def doubts_about_ground(sample: np.ndarray) -> list[str]:
    """What may be wrong with points (N, 3), metres, below whose origin no ground was found."""
    sample = sample[np.isfinite(sample).all(1)].astype(np.float64)
    if len(sample) < ENOUGH_POINTS:
        return []
    for cause, turn in OTHER_AXES.items():
        turned = fit_ground(sample @ turn.T)
        if turned and turned.height_m < 0:
            return [f"no ground was found, and {cause}; write x forward, y left, z up"]
    return ["no ground was found below the sensor; is it in metres, z up, and a scan from a vehicle?"]
