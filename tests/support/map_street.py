"""A made-up map of a street: points on rectangles, whose ranges from anywhere are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np

# corner, and two sides: the road; facades left and right, 10 m high; a wall behind the left one and its yard; a lorry
# 20 m ahead
RECTANGLES = np.array(
    [
        [(-60, -8, 0), (120, 0, 0), (0, 16, 0)],
        [(-60, -8, 0), (120, 0, 0), (0, 0, 10)],
        [(-60, 8, 0), (120, 0, 0), (0, 0, 10)],
        [(-60, 20, 0), (120, 0, 0), (0, 0, 14)],
        [(-60, 8, 0), (120, 0, 0), (0, 12, 0)],
        [(20, -3, 0), (0, 6, 0), (0, 0, 4)],
        [(26, -3, 0), (0, 6, 0), (0, 0, 4)],
        [(20, -3, 0), (6, 0, 0), (0, 0, 4)],
        [(20, 3, 0), (6, 0, 0), (0, 0, 4)],
        [(20, -3, 4), (6, 0, 0), (0, 6, 0)],
    ],
    float,
)


def street_points(spacing_m: float, noise_m: float = 0.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, 3) float64 that fall anywhere on the rectangles, and the number of each one's rectangle."""
    generator = np.random.default_rng(seed)
    areas = np.linalg.norm(np.cross(RECTANGLES[:, 1], RECTANGLES[:, 2]), axis=1)
    number = generator.choice(len(areas), int(areas.sum() / spacing_m**2), p=areas / areas.sum())
    corner, first, second = RECTANGLES[number].transpose(1, 0, 2)
    share = generator.random((len(number), 2, 1))
    xyz = corner + share[:, 0] * first + share[:, 1] * second
    return xyz + generator.normal(0, noise_m, xyz.shape), number


def true_ranges(eye: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return how far rays (N, 3) go from a place to the first rectangle, inf without any: by each one's plane."""
    nearest = np.full(len(directions), np.inf)
    for corner, first, second in RECTANGLES:
        normal = np.cross(first, second)
        with np.errstate(divide="ignore", invalid="ignore"):
            range_m = (corner - eye) @ normal / (directions @ normal)
            offset = eye + directions * range_m[:, None] - corner
            inside = [(offset @ side / (side @ side) >= 0) & (offset @ side <= side @ side) for side in (first, second)]
        nearest = np.where((range_m > 0) & inside[0] & inside[1], np.minimum(nearest, range_m), nearest)
    return nearest


def write_las(path: Path, xyz: np.ndarray) -> None:
    """Write points (N, 3) as LAS, or LAZ, to a millimetre."""
    import laspy

    header = laspy.LasHeader(point_format=1, version="1.2")
    header.offsets, header.scales = xyz.min(0), [1e-3] * 3
    data = laspy.LasData(header)
    data.x, data.y, data.z = xyz.T
    data.write(str(path))
