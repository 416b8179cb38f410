"""Interpretation of a cloud: remission, axes, units, height of the ground, no returns, field of view, doubts."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.beams import horizontal_centre, sharpest_origin
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.scan import Scan

NO_RETURN = 0.01  # nearer to the origin, in the cloud's unit, there was no echo
FEWEST = 1000  # usable points; fewer decide nothing: they are taken as they are
SENSOR_HEIGHT_M = 1.73  # above the road, of the training data's sensor (KITTI's HDL-64E)
ASSUMED = "assumed"  # the first word of a reason for a viewpoint without evidence in the scan
LOWEST_SENSOR_M = 0.4  # above the ground; no sensor is lower
STAND_IN = 0.25  # remission of all points if there is none: costs least, see runs/remission_stand_in.py
SCALES = (1.0, 255.0, 65535.0)
FULL_SHARE = 1 / 16  # the 99th percentile of 16 bit remissions is not below this share of the scale
FORWARD = {"x": (1, 0), "y": (0, 1), "-x": (-1, 0), "-y": (0, -1)}  # (cos, sin) of the forward axis
NUSCENES_FORMAT = "float32 rows, nuScenes"
GAP_DEG = 15.0  # a sector of so many degrees without any point is out of the field of view
NARROWEST_DEG = 60.0  # in view; less is no sweep
FAR_M = 1000.0  # beyond this no LiDAR of a vehicle measures: coordinates are millimetres, or have an offset
# Median over 99th percentile of ranges; beyond, points do not thin out with distance as a sweep's do.
FLAT_SHARE, FLAT_FROM_M = 0.45, 30.0
DENSE, FEWEST_DENSE = 4, 300  # points of a direction (1 x 1 degree), and such directions, to decide by
MAP_SPREAD = 0.12  # standard deviation of the logarithm of ranges within a direction: sweeps 0.02 to 0.06 if flat
VEHICLE_GROUND_M = 0.65  # the ground is so near to z = 0 in a vehicle's frame (Argoverse 2: rear axle, 0.35 m above it)
VEHICLE_DOWN_DEG = -9.0  # and no point lies far below the origin's horizon, as points do below a sensor
STANDING_M = 0.3  # above the ground; lower points are ground
ALIKE_DEG, ALIKE_POINTS = 2.0, 1.5  # between scans of one sensor: lowest beam, factor of counts
SLIVER_DEG = 2.0  # a few stray points between two gaps
SAMPLE = 40_000  # points for finding the geometry
FORWARD_RATIO, FORWARD_RATIO_OF_THREE = 1.2, 1.5  # of the ground hidden by a car at its ends to that at its sides
CAR_BLIND_M, CAR_HEIGHT_M = 3.7, (1.4, 2.6)  # it hides so much of the ground; sensors stand so high on cars
# Of the ground.
GROUND_NEAR_M, GROUND_FAR_M = 2.5, 25.0  # of the points used
CELL_M = 1.0
FEWEST_CELLS, CELL_POINTS = 30, 3  # to fit a plane; points of a cell
LOWEST_M, HIGHEST_M, STEP_M = -6.0, 6.0, 0.1  # of candidate heights
INSIDE_M = 0.3  # cells so near to a plane belong to it
LEAST_SHARE = 0.12  # of the cells must belong to it
SIDE_DEG = 20.0  # half of the sector in each direction
OWN_M, BLIND_M = 1.2, 15.0  # nearer echoes are the vehicle's; farther ground is hidden by something else
# Of doubts.
SWEEP_POINTS = 500  # usable ones; the sparsest LiDAR gives thousands
ENOUGH_POINTS = 10_000  # without a ground among so many, something is wrong
MOST_ODD = 0.02  # of the coordinates are no lengths
MOST_UNUSABLE = 0.1  # of the points in a file without rows of an image, which has no marks of missing returns
MOST_FULL = 0.5  # of the remissions are full
SMALLEST, LARGEST = 1e-12, 1e7  # of a nonzero coordinate, in any unit: others are bytes of something else
# Other axes, and the rotation of such points into ours.
OTHER_AXES = {
    "z seems to point down": np.diag([1.0, -1.0, -1.0]),
    "the axes seem to be a camera's (z forward, y down)": np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
    "y seems to point up": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
}
# Fields of an Interpretation, shared by all scans of a stream.
GEOMETRY = (
    "unit_m",
    "viewpoint_m",
    "viewpoint_by",
    "forward",
    "forward_by",
    "ground_m",
    "tilt_deg",
    "assumed_height_m",
)


@dataclass(frozen=True, kw_only=True)
class Overrides:
    """The user's knowledge, in place of findings from the scan itself.

    sensor_height_m  height of the viewpoint above the ground: the cloud is lowered or lifted so; None: found out.
    forward          the forward axis: "x", "y", "-x", "-y"; "": found out.
    remission        value of full remission: "1", "255", "65535", or "none"; "": found out.
    invent           whether the panorama also claims the sectors outside the field of view.
    """

    sensor_height_m: float | None = None
    forward: str = ""
    remission: str = ""
    invent: bool = False

    def __post_init__(self) -> None:
        """Refuse invalid values (InputError)."""
        if self.forward not in ("", *FORWARD):
            raise InputError(f"--forward {self.forward!r} is no axis; there is {', '.join(FORWARD)}")
        if self.remission not in ("", "1", "255", "65535", "none"):
            raise InputError(f"--remission {self.remission!r} is no scale; there is 1, 255, 65535 and none")
        if self.sensor_height_m is not None and not 0 <= self.sensor_height_m <= 100:
            raise InputError(f"--sensor-height {self.sensor_height_m} is no height above the ground in metres")


@dataclass(frozen=True, kw_only=True)
class Interpretation:
    """The reading of a cloud.

    points, no_returns   how many there are, and how many of them are at the origin, NaN or Inf.
    unit_m               length of one unit of the coordinates.
    viewpoint_m          the point of the cloud, in metres and its own axes, chosen as the sensor's origin.
    viewpoint_by         the reason.
    forward, forward_by  the forward axis, and the reason.
    ground_m             height of the sensor's origin above the ground, None if none was found; tilt_deg of it.
    assumed_height_m     the same for an assumed origin, None for a found or named one.
    remission            how it was scaled: "0-1", "0-255", "0-65535", "min-max" or "none"; remission_full: the value
                         of full remission, None if all points have the stand-in.
    gaps_deg             sectors (left, right) of azimuth out of the field of view, counter-clockwise from forward.
    invented             whether the panorama claims the gaps.
    lowest_deg           elevation below 99 of 100 points, from the cloud's origin.
    doubts               properties of the cloud that no LiDAR gives, a sentence each.
    """

    format: str
    fields: tuple[str, ...]
    frame: str
    stamp_s: float | None
    points: int
    no_returns: int
    unit_m: float = 1.0
    viewpoint_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    viewpoint_by: str = "the cloud's origin"
    forward: str = "x"
    forward_by: str = "convention"
    ground_m: float | None = None
    tilt_deg: float | None = None
    assumed_height_m: float | None = None
    remission: str = "0-1"
    remission_full: float | None = 1.0
    gaps_deg: tuple[tuple[float, float], ...] = ()
    invented: bool = False
    lowest_deg: float | None = None
    doubts: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)


def interpret(
    cloud: PointCloud, overrides: Overrides | None = None, like: Interpretation | None = None
) -> tuple[Scan, Interpretation]:
    """Return the scan in the sensor's frame (x forward, metres, remission in [0, 1]), and its interpretation.

    like  interpretation of the same stream's first cloud: unit, axes, height and remission are taken from it, unless
          the two are of different sensors.
    Numbers stay exact if nothing must change. Raises InputError for a cloud that is no sweep.
    """
    overrides = overrides or Overrides()
    xyz = cloud.xyz
    squared = np.einsum("ij,ij->i", xyz, xyz)
    returns = np.isfinite(squared) & (squared > NO_RETURN**2)
    result = Interpretation(
        format=cloud.format,
        fields=cloud.fields,
        frame=cloud.frame,
        stamp_s=cloud.stamp_s,
        points=len(cloud),
        no_returns=len(cloud) - int(np.count_nonzero(returns)),
        invented=overrides.invent,
    )
    step = max(1, len(xyz) // SAMPLE)
    sample = xyz[::step][returns[::step]].astype(np.float64)
    result = replace(result, lowest_deg=_lowest(sample))
    like = like if like and _alike(result, like) else None
    remission, result = _remission(cloud, overrides, like, result)
    doubts = doubts_about(xyz, returns, remission, rows=cloud.format.startswith("float32 rows"))
    if len(cloud) - result.no_returns >= FEWEST:
        try:
            result = _geometry(sample, cloud, overrides, like, result)
            xyz = _moved(xyz, returns, result)
            result = replace(result, gaps_deg=_gaps(xyz[returns], overrides))
        except InputError as error:
            raise InputError("; ".join([str(error), *doubts])) from None
        if not doubts and (result.ground_m is None or result.ground_m < 0):
            doubts = doubts_about_ground(xyz[:: max(1, len(xyz) // SAMPLE)])
    elif overrides.forward:
        result = replace(result, forward=overrides.forward, forward_by="--forward")
        xyz = _moved(xyz, returns, result)
    result = replace(result, doubts=tuple(doubts))
    scan = Scan(
        xyz=np.array(xyz, np.float32, order="C"),  # a copy: the cloud's may be a view of a file, or of the caller's
        remission=remission,
        label=cloud.label,
        name=cloud.name,
        ring=cloud.ring,
        time_s=cloud.time_s,
        gaps_deg=() if overrides.invent else result.gaps_deg,
    )
    return scan, result


def _lowest(sample: np.ndarray) -> float | None:
    elevation = np.arctan2(sample[:, 2], np.hypot(sample[:, 0], sample[:, 1]))
    return round(float(np.degrees(np.percentile(elevation, 1))), 2) if len(sample) else None


def _alike(result: Interpretation, like: Interpretation) -> bool:
    """Return whether two clouds are of one sensor: form, fields, lowest beam, and about as many points."""
    if (result.format, result.fields) != (like.format, like.fields) or None in (result.lowest_deg, like.lowest_deg):
        return False
    few, many = sorted((result.points - result.no_returns, like.points - like.no_returns))
    return abs((result.lowest_deg or 0) - (like.lowest_deg or 0)) < ALIKE_DEG and many < ALIKE_POINTS * few


def _remission(
    cloud: PointCloud, overrides: Overrides, like: Interpretation | None, result: Interpretation
) -> tuple[np.ndarray, Interpretation]:
    values = cloud.intensity
    none = replace(result, remission="none", remission_full=None)
    if values is None or overrides.remission == "none" or (like and like.remission == "none"):
        return np.full(len(cloud), STAND_IN, np.float32), none
    with np.errstate(invalid="ignore"):
        low, high = (float(edge) for edge in (np.fmin.reduce(values), np.fmax.reduce(values)))
    if overrides.remission:
        full, how = float(overrides.remission), f"0-{overrides.remission}"
    elif like:
        full, how = like.remission_full or 1.0, like.remission
    elif not low < high and len(cloud) >= FEWEST:
        return np.full(len(cloud), STAND_IN, np.float32), none
    else:
        full, how = _scale(values, low, high)
    if how == "min-max":
        return ((values.astype(np.float64) - low) / full).astype(np.float32), replace(
            result, remission=how, remission_full=full
        )
    scaled = values.astype(np.float32)
    if full != 1:
        scaled = np.minimum(scaled / np.float32(full), 1)
    return scaled, replace(result, remission=how, remission_full=full)


def _scale(values: np.ndarray, low: float, high: float) -> tuple[float, str]:
    """Return the value of full remission, and the name of the scale."""
    if low < 0:
        return high - low, "min-max"
    integers = values.dtype.kind in "iu"
    for full in SCALES[1 if integers else 0 :]:
        if high <= full:
            if full == SCALES[-1] and (most := float(np.nanpercentile(values, 99))) < full * FULL_SHARE:
                return max(most, 255.0), "0-99th percentile"  # photon counts, or 12 bit
            return full, f"0-{full:.0f}"
    return float(np.nanpercentile(values, 99)), "0-99th percentile"


def _geometry(
    sample: np.ndarray, cloud: PointCloud, overrides: Overrides, like: Interpretation | None, result: Interpretation
) -> Interpretation:
    """Unit, viewpoint, ground and forward axis of a cloud, by (N, 3) float64 of its points."""
    away = _is_offset(sample)
    if like and not away and overrides.sensor_height_m is None:
        return replace(result, **{name: getattr(like, name) for name in GEOMETRY})
    most = float(np.percentile(np.linalg.norm(sample, axis=1), 99))
    if not away and FAR_M < most < 1000 * FAR_M:
        result = replace(result, unit_m=1e-3)
        sample = sample * 1e-3
    centre = horizontal_centre(sample) if away else np.zeros(3)
    sample = sample - centre
    if _is_map(sample, away):
        raise InputError(
            "is no sweep of a LiDAR (its points do not thin out with distance: a map, an airborne scan"
            " or an object); name a single scan from the sensor's place"
        )
    ground = fit_ground(sample)
    viewpoint, why = _viewpoint(sample, ground, overrides, away)
    result = replace(result, assumed_height_m=SENSOR_HEIGHT_M if why.startswith(ASSUMED) else None)
    sample = sample - viewpoint
    if ground:
        height_m = float(viewpoint[2]) - ground.height_m
        ground = replace(ground, height_m=-height_m)
        result = replace(result, ground_m=round(height_m, 2), tilt_deg=round(ground.tilt_deg, 1))
    forward, forward_by = _forward(sample, cloud, ground, overrides)
    x, y, z = (round(float(value), 3) for value in centre + viewpoint)
    return replace(result, viewpoint_m=(x, y, z), viewpoint_by=why, forward=forward, forward_by=forward_by)


def _is_offset(sample: np.ndarray) -> bool:
    """Return whether the points lie together and all far from the origin, as in UTM coordinates."""
    centre = np.median(sample, axis=0)
    spread = np.percentile(np.abs(sample - centre), 90)
    return float(np.abs(centre).max()) > 5 * spread


def _is_map(sample: np.ndarray, away: bool) -> bool:
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


def _viewpoint(sample: np.ndarray, ground: Ground | None, overrides: Overrides, away: bool) -> tuple[np.ndarray, str]:
    """Return the sensor's origin, and the reason; (0, 0, 0) if it is the cloud's already."""
    floor_m = ground.height_m if ground else 0.0
    if overrides.sensor_height_m is not None:
        return np.array([0, 0, floor_m + overrides.sensor_height_m]), "--sensor-height"
    if not away:
        if ground is None or abs(floor_m) > VEHICLE_GROUND_M:
            return np.zeros(3), "the cloud's origin"
        down = np.degrees(np.arctan2(sample[:, 2], np.hypot(sample[:, 0], sample[:, 1])))
        if np.percentile(down, 1) < VEHICLE_DOWN_DEG:
            return np.zeros(3), "the cloud's origin"
    why = "coordinates have an offset" if away else "the ground is at z = 0: a vehicle's frame"
    start = np.array([0, 0, floor_m + SENSOR_HEIGHT_M])
    standing = sample[np.abs(sample[:, 2] - floor_m) > STANDING_M]  # from the ground itself, the ground is a sharp line
    origin = sharpest_origin(standing, start)
    if (origin == start).all() or origin[2] - floor_m < LOWEST_SENSOR_M:
        return start, f"{ASSUMED} {SENSOR_HEIGHT_M} m above the ground, since {why}"
    return origin, f"found by the beams, since {why}"


def _forward(sample: np.ndarray, cloud: PointCloud, ground: Ground | None, overrides: Overrides) -> tuple[str, str]:
    """Return the forward axis, and the reason: a car hides more ground before and behind it than beside it."""
    if overrides.forward:
        return overrides.forward, "--forward"
    if cloud.format == NUSCENES_FORMAT:
        return "y", "nuScenes' convention"
    if ground and CAR_HEIGHT_M[0] <= -ground.height_m <= CAR_HEIGHT_M[1]:
        along, across = blind_radii(sample, ground)
        radii = [radius for radius in across if radius is not None]
        if radii and None not in along:
            ratio = FORWARD_RATIO if len(radii) == 2 else FORWARD_RATIO_OF_THREE
            if min(radii) > max(CAR_BLIND_M, ratio * max(radius or 0 for radius in along)):
                return "y", "the vehicle hides more of the ground along y than along x"
    return "x", "convention"


def _moved(xyz: np.ndarray, returns: np.ndarray, result: Interpretation) -> np.ndarray:
    """Return the points in metres, from the viewpoint, x forward, no returns NaN; `xyz` itself if nothing moves."""
    if result.unit_m == 1 and not any(result.viewpoint_m) and result.forward == "x":
        return xyz
    moved = xyz.astype(np.float64) * result.unit_m - result.viewpoint_m
    moved[~returns] = np.nan
    cosine, sine = FORWARD[result.forward]
    x, y = moved[:, 0].copy(), moved[:, 1].copy()
    moved[:, 0], moved[:, 1] = cosine * x + sine * y, cosine * y - sine * x
    return moved


def _gaps(xyz: np.ndarray, overrides: Overrides) -> tuple[tuple[float, float], ...]:
    """Return sectors (left, right) of azimuth, degrees, without any point: left in (-180, 180], right below it.

    Raises InputError if little else is left.
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
    if view_deg < NARROWEST_DEG and not overrides.invent:
        raise InputError(
            f"is no sweep all around: only {view_deg:.0f} of 360 degrees hold points; --invent paints the rest anyway"
        )
    return tuple(gaps)


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
    near = xyz[(distance > GROUND_NEAR_M) & (distance < GROUND_FAR_M)]
    if len(near) < FEWEST_CELLS * CELL_POINTS:
        return None
    side = int(2 * GROUND_FAR_M / CELL_M) + 2
    column = np.floor((near[:, :2] + GROUND_FAR_M) / CELL_M).astype(np.int64)
    cell = column[:, 0] * side + column[:, 1]
    order = np.argsort(cell, kind="stable")
    start = np.flatnonzero(np.diff(cell[order], prepend=-1))
    counts = np.diff(np.append(start, len(cell)))
    lowest = np.minimum.reduceat(near[order, 2], start)[counts >= CELL_POINTS]
    place = cell[order][start][counts >= CELL_POINTS]
    centre = (np.stack([place // side, place % side], 1) + 0.5) * CELL_M - GROUND_FAR_M
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


def doubts_about(xyz: np.ndarray, returns: np.ndarray, remission: np.ndarray, *, rows: bool) -> list[str]:
    """Return doubts about points (N, 3) as the file holds them, whose usable ones are `returns` (N,) bool.

    remission  (N,) in [0, 1] as it was scaled;  rows: whether the file is nothing but rows of numbers.
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
    if usable and float(np.mean(remission[returns] >= 1)) > MOST_FULL:
        doubts.append("most of its points have full remission; name the scale with --remission")
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
