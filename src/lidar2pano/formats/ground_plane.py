"""The ground below a LiDAR: its plane, and how much of it the vehicle hides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

NEAR_M, FAR_M = 2.5, 25.0  # of the points used
CELL_M = 1.0
FEWEST_CELLS, FEWEST_POINTS = 30, 3  # to fit a plane; points of a cell
LOWEST_M, HIGHEST_M, STEP_M = -6.0, 6.0, 0.1  # of candidate heights
INSIDE_M = 0.3  # cells so near to a plane belong to it
LEAST_SHARE = 0.12  # of the cells must belong to it
SIDE_DEG = 20.0  # half of the sector in each direction
OWN_M, BLIND_M = 1.2, 15.0  # nearer echoes are the vehicle's; farther ground is hidden by something else


@dataclass(frozen=True, kw_only=True)
class Ground:
    """The plane z = height_m + slope[0] x + slope[1] y, metres; tilt_deg: its angle to the horizontal."""

    height_m: float
    slope: tuple[float, float]

    @property
    def tilt_deg(self) -> float:
        """Angle between the plane and z = 0."""
        return float(np.degrees(np.arctan(np.hypot(*self.slope))))


def fit_ground(xyz: np.ndarray) -> Ground | None:
    """Return the ground plane of points (N, 3), metres, z up; None if there is none.

    The lowest point of each cell of a grid; the height of most of them; a plane through those by least squares.
    """
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    near = xyz[(distance > NEAR_M) & (distance < FAR_M)]
    if len(near) < FEWEST_CELLS * FEWEST_POINTS:
        return None
    side = int(2 * FAR_M / CELL_M) + 2
    column = np.floor((near[:, :2] + FAR_M) / CELL_M).astype(np.int64)
    cell = column[:, 0] * side + column[:, 1]
    order = np.argsort(cell, kind="stable")
    start = np.flatnonzero(np.diff(cell[order], prepend=-1))
    counts = np.diff(np.append(start, len(cell)))
    lowest = np.minimum.reduceat(near[order, 2], start)[counts >= FEWEST_POINTS]
    place = cell[order][start][counts >= FEWEST_POINTS]
    centre = (np.stack([place // side, place % side], 1) + 0.5) * CELL_M - FAR_M
    if len(lowest) < FEWEST_CELLS:
        return None
    histogram = np.histogram(lowest, np.arange(LOWEST_M, HIGHEST_M, STEP_M))[0]
    votes = np.convolve(histogram, np.ones(3), "same")
    if votes.max() < LEAST_SHARE * len(lowest):
        return None
    plane = np.array([LOWEST_M + (votes.argmax() + 0.5) * STEP_M, 0, 0])
    terms = np.column_stack([np.ones(len(centre)), centre])
    for _ in range(3):
        inside = np.abs(lowest - terms @ plane) < INSIDE_M
        if np.count_nonzero(inside) < FEWEST_CELLS // 2:
            break
        plane = np.linalg.lstsq(terms[inside], lowest[inside], rcond=None)[0]
    return Ground(height_m=float(plane[0]), slope=(float(plane[1]), float(plane[2])))


def blind_radii(
    xyz: np.ndarray, ground: Ground
) -> tuple[tuple[float | None, float | None], tuple[float | None, float | None]]:
    """Return distances of the first visible ground: (along x, along -x), (along y, along -y); None for no ground."""
    x, y, z = xyz.T
    distance = np.hypot(x, y)
    flat = np.abs(z - ground.height_m - ground.slope[0] * x - ground.slope[1] * y) < INSIDE_M
    flat &= (distance > OWN_M) & (distance < BLIND_M)
    azimuth, distance = np.degrees(np.arctan2(y[flat], x[flat])), distance[flat]
    radii: list[float | None] = []
    for middle in (0, 180, 90, -90):
        inside = distance[np.abs((azimuth - middle + 180) % 360 - 180) < SIDE_DEG]
        radii.append(float(np.percentile(inside, 1)) if len(inside) > FEWEST_CELLS else None)
    return (radii[0], radii[1]), (radii[2], radii[3])
