"""The ground below a sensor: a plane, level or tilted, through most of a scan's lowest points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

GROUND_NEAR_M, GROUND_FAR_M = 2.5, 25.0  # of the points used
CELL_M = 1.0
FEWEST_CELLS, CELL_POINTS = 30, 3  # to fit a plane; points of a cell
LOWEST_M, HIGHEST_M, STEP_M = -6.0, 6.0, 0.1  # of candidate heights
INSIDE_M = 0.3  # cells so near to a plane belong to it
LEAST_SHARE = 0.12  # of the cells must belong to it
SURE_SHARE = 0.5  # of the cells belong to a plane beyond doubt: most of them
LEVEL_DEG = 4.5  # roads bend by less within GROUND_FAR_M (200 real scans: 3.1 at most); more is the sensor's own tilt
STEEPEST_DEG = 30.0  # of tilted planes
BELOW_M = -0.4  # no sensor is nearer to the ground
DRAWS = 400  # of three cells: one of them finds a plane of a quarter of the cells in 499 of 500 cases
SIDE_DEG = 20.0  # half of the sector in each direction
OWN_M, BLIND_M = 1.2, 15.0  # nearer echoes are the vehicle's; farther ground is hidden by something else
HEIGHTS_M = (1.0, 4.0)  # above the ground, of sensors on vehicles


@dataclass(frozen=True, kw_only=True)
class Ground:
    """The plane z = height_m + slope[0] x + slope[1] y, metres; share: of the cells near to it."""

    height_m: float
    slope: tuple[float, float]
    share: float = 1.0

    @property
    def tilt_deg(self) -> float:
        """Angle between the plane and z = 0."""
        return float(np.degrees(np.arctan(np.hypot(*self.slope))))

    @property
    def level(self) -> bool:
        """True for a plane of most cells with the slope of a road."""
        return self.share >= SURE_SHARE and self.tilt_deg < LEVEL_DEG

    @property
    def level_turn(self) -> np.ndarray:
        """The rotation (3, 3) about a horizontal axis from the plane's normal to z."""
        normal = np.array([-self.slope[0], -self.slope[1], 1.0])
        x, y, z = normal / np.linalg.norm(normal)
        across = -x * y / (1 + z)
        return np.array([[1 - x * x / (1 + z), across, -x], [across, 1 - y * y / (1 + z), -y], [x, y, z]])

    def height_of(self, xyz: np.ndarray) -> np.ndarray:
        """Return heights (N,) of points (N, 3) above the plane."""
        return xyz[:, 2] - self.height_m - xyz[:, :2] @ np.asarray(self.slope)


def fit_ground(xyz: np.ndarray) -> Ground | None:
    """Return the ground plane of points (N, 3), metres, z up; None if there is none.

    The lowest point of each cell of a grid; the height of most of them; a plane through those by least squares.
    """
    lowest, centre = _lowest_points(xyz)
    if len(lowest) < FEWEST_CELLS:
        return None
    z = lowest[:, 2]
    histogram = np.histogram(z, np.arange(LOWEST_M, HIGHEST_M, STEP_M))[0]
    votes = np.convolve(histogram, np.ones(3), "same")
    if votes.max() < LEAST_SHARE * len(z):
        return None
    start = np.array([LOWEST_M + (votes.argmax() + 0.5) * STEP_M, 0, 0])
    return _refined(np.column_stack([centre, z]), start)


def fit_tilted_ground(xyz: np.ndarray) -> Ground | None:
    """Return the plane through most cells' lowest points, below the origin and up to STEEPEST_DEG steep.

    None if fewer than SURE_SHARE do. Planes through three random cells are compared (RANSAC, Fischler and Bolles 1981).
    """
    lowest, _ = _lowest_points(xyz)
    if len(lowest) < FEWEST_CELLS:
        return None
    corners = lowest[np.random.default_rng(0).integers(0, len(lowest), (DRAWS, 3))]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    corner = corners[np.abs(normal[:, 2]) > 1e-6, 0]
    normal = normal[np.abs(normal[:, 2]) > 1e-6]
    slope = -normal[:, :2] / normal[:, 2:]
    height = corner[:, 2] - (slope * corner[:, :2]).sum(1)
    usable = (np.hypot(*slope.T) < np.tan(np.radians(STEEPEST_DEG))) & (height < BELOW_M) & (height > LOWEST_M)
    if not usable.any():
        return None
    planes = np.column_stack([height, slope])[usable]
    terms = np.column_stack([np.ones(len(lowest)), lowest[:, :2]])
    counts = (np.abs(lowest[:, 2] - planes @ terms.T) < INSIDE_M).sum(1)
    ground = _refined(lowest, planes[counts.argmax()])
    return ground if ground.share >= SURE_SHARE and ground.height_m < BELOW_M else None


def _lowest_points(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest points (M, 3) of cells, and the cells' centres (M, 2)."""
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    near = xyz[(distance > GROUND_NEAR_M) & (distance < GROUND_FAR_M)]
    if len(near) < FEWEST_CELLS * CELL_POINTS:
        return np.empty((0, 3)), np.empty((0, 2))
    side = int(2 * GROUND_FAR_M / CELL_M) + 2
    column = np.floor((near[:, :2] + GROUND_FAR_M) / CELL_M).astype(np.int64)
    cell = column[:, 0] * side + column[:, 1]
    order = np.argsort(near[:, 2])
    order = order[np.argsort(cell[order].astype(np.int16), kind="stable")]  # small integers are sorted in linear time
    start = np.flatnonzero(np.diff(cell[order], prepend=-1))
    start = start[np.diff(np.append(start, len(cell))) >= CELL_POINTS]
    place = cell[order][start]
    return near[order[start]], (np.stack([place // side, place % side], 1) + 0.5) * CELL_M - GROUND_FAR_M


def _refined(points: np.ndarray, plane: np.ndarray) -> Ground:
    """Return the plane through the points (M, 3) near to a first one, by least squares."""
    terms = np.column_stack([np.ones(len(points)), points[:, :2]])
    for _ in range(3):
        inside = np.abs(points[:, 2] - terms @ plane) < INSIDE_M
        if np.count_nonzero(inside) < FEWEST_CELLS // 2:
            break
        plane = np.linalg.lstsq(terms[inside], points[inside, 2], rcond=None)[0]
    share = float(np.mean(np.abs(points[:, 2] - terms @ plane) < INSIDE_M))
    return Ground(height_m=float(plane[0]), slope=(float(plane[1]), float(plane[2])), share=share)


def best_ground(sample: np.ndarray) -> Ground | None:
    """Return the level ground, or the tilted plane of more cells."""
    ground = fit_ground(sample)
    if ground and ground.level:
        return ground
    tilted = fit_tilted_ground(sample)
    return tilted if tilted and (ground is None or tilted.share > ground.share) else ground


def stands(ground: Ground | None, *, level: bool = False) -> bool:
    """Return whether a sensor stands on the ground as on a vehicle: most cells belong to it, at a vehicle's height.

    level  and it is no steeper than a road.
    """
    if ground is None or (level and not ground.level):
        return False
    return ground.share >= SURE_SHARE and HEIGHTS_M[0] <= -ground.height_m <= HEIGHTS_M[1]


def blind_radii(xyz: np.ndarray, ground: Ground) -> tuple[list[float], list[float]]:
    """Return distances of the first visible ground: along x and -x, along y and -y; without those of no ground."""
    x, y, _ = xyz.T
    distance = np.hypot(x, y)
    flat = np.abs(ground.height_of(xyz)) < INSIDE_M
    flat &= (distance > OWN_M) & (distance < BLIND_M)
    azimuth, distance = np.degrees(np.arctan2(y[flat], x[flat])), distance[flat]
    radii: tuple[list[float], list[float]] = [], []
    for axis, middle in enumerate((0, 90, 180, -90)):
        inside = distance[np.abs((azimuth - middle + 180) % 360 - 180) < SIDE_DEG]
        radii[axis % 2].extend(np.percentile(inside, [1]).tolist() if len(inside) > FEWEST_CELLS else [])
    return radii
