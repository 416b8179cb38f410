"""Placement of a cloud: its unit, the sensor's place in it, its upward direction and its forward axis."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.beams import CLEARLY, horizontal_centre, sharpest_origin, sharpness
from lidar2pano.formats.field_names import METRES
from lidar2pano.formats.ground_plane import (
    BELOW_M,
    HEIGHTS_M,
    LEVEL_DEG,
    SURE_SHARE,
    Ground,
    best_ground,
    blind_radii,
    fit_ground,
    stands,
)

# The sensor's place and axes.
SENSOR_HEIGHT_M = 1.73  # above the road, of the training data's sensor (KITTI's HDL-64E)
FORWARD = {"x": (1, 0), "y": (0, 1), "-x": (-1, 0), "-y": (0, -1)}  # (cos, sin) of the forward axis
ASSUMED = "assumed"  # the first word of a reason for a viewpoint without evidence in the scan
LEVELLED = "levelled by the ground"
CLOUD_ORIGIN, BY_VIEWPOINT = "the cloud's origin", "the file's VIEWPOINT"
LOWEST_SENSOR_M = 0.4  # above the ground; no sensor is lower
OTHER_AXIS_DEG = 45.0  # a turn by more is to another axis
FAR_M = 1000.0  # beyond this no LiDAR of a vehicle measures: coordinates are millimetres, or have an offset
SMALL_UNITS = (1e-3, 1e-2, 1e-6, 1e-4, 1e-5)  # metres, the usual ones first
VEHICLE_GROUND_M = 0.65  # the ground is so near to z = 0 in a vehicle's frame (Argoverse 2: rear axle, 0.35 m above it)
VEHICLE_DOWN_DEG = -9.0  # and no point lies far below the origin's horizon, as points do below a sensor
# Beams from beside the origin: 195 real scans have sharper ones from up to 0.5 m aside, 1.6 times as sharp ones (two of
# several sensors) from 1.3 m; scans of five sensors, moved by 1.2 m, 2.4 to 15 times.
BESIDE_M, FAR_SHARPER, BEAM_SAMPLE = 0.5, 2.4, 15_000
STANDING_M = 0.3  # above the ground; lower points are ground
NEARER = 3  # times as near to the point amid all points as the origin is: a sensor stands there
NEAREST_M = 0.05  # a shorter way to the sensor's claimed place is none
# Other axes, and the rotation of such points into ours.
OTHER_AXES = {
    "z seems to point down": np.diag([1.0, -1.0, -1.0]),
    "the axes seem to be a camera's (z forward, y down)": np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
    "y seems to point up": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "x seems to point up": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "x seems to point down": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
}
Turn = tuple[tuple[float, float, float], ...]
WHICH_END = "nothing shows which end is ahead, name it with --forward"
UPRIGHT: Turn = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

# Maps: median over 99th percentile of ranges; beyond, points do not thin out with distance as a sweep's do.
FLAT_SHARE, FLAT_FROM_M = 0.45, 30.0
DENSE, FEWEST_DENSE = 4, 300  # points of a direction (1 x 1 degree), and such directions, to decide by
MAP_SPREAD = 0.12  # standard deviation of the logarithm of ranges within a direction: sweeps 0.02 to 0.06 if flat

# The forward axis. Evidence in natural logarithms: 174 real scans with x forward have -0.1 to 3, 18 with y forward -3
# to -0.7.
SHOWS, SHOWS_AGAINST = 0.2, 0.4  # where a form has no convention, and against one
CAR_HEIGHT_M = (1.4, 2.6)  # sensors stand so high on cars
ROADSIDE_M = (0.5, 5.0)  # above the ground
REACH_M = 50.0  # of what stands along the road
NEAR_M = 3.0
WALL_M, SMOOTH = 0.25, 17  # bins of a histogram, and of the smoothed one it is compared with
FEWEST_ROADSIDE = 500  # standing points


@dataclass(frozen=True, kw_only=True)
class Placement:
    """The placement of a cloud, shared by all scans of a stream.

    unit_m               length of one unit of the coordinates.
    viewpoint_m          the point of the cloud, in metres and its own axes, chosen as the sensor's origin.
    viewpoint_by         the reason.
    turn, turn_by        rotation from the cloud's axes to those with z up, and the reason, "" without any.
    forward, forward_by  the forward axis among the latter, and the reason.
    ground_m             height of the sensor's origin above the ground, None if none was found; tilt_deg of it.
    assumed_height_m     the same for an assumed origin, None for a found or named one.
    """

    unit_m: float = 1.0
    viewpoint_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    viewpoint_by: str = CLOUD_ORIGIN
    turn: Turn = UPRIGHT
    turn_by: str = ""
    forward: str = "x"
    forward_by: str = "convention"
    ground_m: float | None = None
    tilt_deg: float | None = None
    assumed_height_m: float | None = None

    @property
    def rotation(self) -> np.ndarray:
        """The rotation (3, 3) float64 from the cloud's axes to the scan's: x forward, z up."""
        cosine, sine = FORWARD[self.forward]
        return np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ np.array(self.turn)

    @property
    def uses_viewpoint(self) -> bool:
        """True if the file's own pose of the sensor holds."""
        return self.viewpoint_by == BY_VIEWPOINT or BY_VIEWPOINT in self.turn_by

    def moved(self, xyz: np.ndarray, returns: np.ndarray) -> np.ndarray:
        """Return points (N, 3) in metres, from the viewpoint, x forward, z up, no returns NaN; or just `xyz`."""
        if self.unit_m == 1 and not any(self.viewpoint_m) and self.forward == "x" and self.turn == UPRIGHT:
            return xyz
        moved = xyz.astype(np.float64) * self.unit_m - self.viewpoint_m
        moved[~returns] = np.nan
        return moved @ self.rotation.T


@dataclass(frozen=True, kw_only=True)
class Claims:
    """The file's claims about its geometry, which hold unless the scan contradicts them, and the user's, which hold.

    viewpoint    (4, 4) float64 T of the sensor in the cloud's frame, or None.
    forward      the forward axis of files of its form, "" if the form does not say;  forward_by: the form's name.
    sure         the form needs no evidence of the axis.
    named_forward   the user's forward axis, "" without one;  named_height_m: likewise the height above the ground.
    """

    viewpoint: np.ndarray | None = None
    forward: str = ""
    forward_by: str = ""
    sure: bool = False
    named_forward: str = ""
    named_height_m: float | None = None


class Stance(NamedTuple):
    """A sensor's origin (3,) in the cloud, the rotation (3, 3) from its axes to those with z up, and the reasons."""

    origin: np.ndarray
    turn: np.ndarray
    origin_by: str = ""
    turn_by: str = ""

    def moved(self, xyz: np.ndarray) -> np.ndarray:
        """Return points (N, 3) from the origin, z up; `xyz` if nothing moves."""
        xyz = xyz - self.origin if self.origin.any() else xyz
        return xyz if (self.turn == np.eye(3)).all() else xyz @ self.turn.T


def place(sample: np.ndarray, claims: Claims) -> tuple[Placement, list[str]]:
    """Return the placement of a cloud by a sample (N, 3) float64 of its points, and doubts about it.

    Raises InputError for anything but a sweep.
    """
    away = is_offset(sample)
    unit_m = 1.0 if away else find_unit(sample)
    sample = sample * unit_m if unit_m != 1 else sample
    stance, unused, undecided = Stance(np.zeros(3), np.eye(3)), "", list[str]()
    if claims.viewpoint is not None:
        stance, unused, unclear = by_viewpoint(sample, claims.viewpoint, unit_m)
        heading_deg = float(np.degrees(np.arctan2(claims.viewpoint[1, 0], claims.viewpoint[0, 0])))
        if unclear and abs(heading_deg) > OTHER_AXIS_DEG and not claims.named_forward:
            undecided = [f"the file's VIEWPOINT turns it by {heading_deg:.0f} degrees, and is not used; {WHICH_END}"]
    if away and not stance.origin.any():
        stance = stance._replace(origin=horizontal_centre(sample))
    away = away and not stance.origin_by
    if is_map(stance.moved(sample), away):
        raise InputError(
            "is no sweep of a LiDAR (its points do not thin out with distance: a map, an airborne scan"
            " or an object); name a single scan from the sensor's place"
        )
    stance, ground, doubts = _upright(sample, stance)
    sample = stance.moved(sample)
    viewpoint, why = _viewpoint(sample, ground, claims.named_height_m, away)
    sample = sample - viewpoint
    placement = Placement(unit_m=unit_m, assumed_height_m=SENSOR_HEIGHT_M if why.startswith(ASSUMED) else None)
    if ground:
        height_m = float(viewpoint[2]) - ground.height_m
        ground = replace(ground, height_m=-height_m)
        placement = replace(placement, ground_m=round(height_m, 2), tilt_deg=round(ground.tilt_deg, 1))
    forward, forward_by, unsure = _forward(sample, ground, claims, bool(doubts))
    beside = _of_origin(sample, ground) if why == CLOUD_ORIGIN and not doubts else []
    x, y, z = (round(float(value), 3) for value in stance.origin + stance.turn.T @ viewpoint)
    if why == CLOUD_ORIGIN:
        why = stance.origin_by or why + unused
    turn = UPRIGHT if (stance.turn == np.eye(3)).all() else tuple(map(tuple, stance.turn.tolist()))
    return replace(
        placement,
        viewpoint_m=(x, y, z),
        viewpoint_by=why,
        turn=turn,
        turn_by=stance.turn_by,
        forward=forward,
        forward_by=forward_by,
    ), undecided + doubts + (unsure or _of_a_map(away, claims)) + _of_feet(sample, ground, claims) + beside


def _of_feet(sample: np.ndarray, ground: Ground | None, claims: Claims) -> list[str]:
    """Return the doubt about points (N, 3) that a vehicle's sensor would see if their unit were feet."""
    if ground is None or -ground.height_m <= HEIGHTS_M[1] or claims.named_height_m is not None:
        return []
    if not stands(best_ground(sample * METRES["ft"])):
        return []
    return [f"the ground is {-ground.height_m:.1f} below it, too far for a vehicle; if its unit is feet, write metres"]


def _of_origin(sample: np.ndarray, ground: Ground | None) -> list[str]:
    """Return the doubt about points (N, 3) whose beams come from a place beside the origin, such as drivers leave it.

    Points in the frame of the vehicle's middle or axle are moved so; the ground's height does not show it.
    """
    standing = sample[np.abs(ground.height_of(sample)) > STANDING_M] if ground else sample
    standing = standing[:: max(1, len(standing) // BEAM_SAMPLE)]
    x, y, z = origin = sharpest_origin(standing, np.zeros(3))
    sharper = sharpness(standing, origin) >= FAR_SHARPER * sharpness(standing, np.zeros(3))
    if np.hypot(x, y) < BESIDE_M or not sharper:
        return []
    place = f"({x:.1f}, {y:.1f}, {z:.1f}) m"
    return [f"its beams are far sharper from {place}: its sensor is there, or tilted; move its points to the sensor"]


def _of_a_map(away: bool, claims: Claims) -> list[str]:
    """Return the doubt about the axes of coordinates with an offset: a map's say nothing of the sensor's."""
    if not away or claims.named_forward:
        return []
    return [f"its coordinates are a map's, far from their origin, and so are its axes; {WHICH_END}"]


def find_unit(sample: np.ndarray) -> float:
    """Return the length of one unit of coordinates around the origin, in metres.

    Beyond FAR_M they are of the first of SMALL_UNITS that gives a sensor's height above the ground, else millimetres or
    micrometres.
    """
    most = float(np.percentile(np.linalg.norm(sample, axis=1), 99))
    if not most > FAR_M:
        return 1.0
    units = [unit for unit in SMALL_UNITS if most * unit < FAR_M]
    return next((unit for unit in units if stands(best_ground(sample * unit))), units[0] if units else 1.0)


def find_other_axes(xyz: np.ndarray) -> tuple[str, np.ndarray, Ground] | None:
    """Return the first of OTHER_AXES with which a sensor stands on the ground, its rotation and the ground."""
    grounds = ((cause, turn, best_ground(xyz @ turn.T)) for cause, turn in OTHER_AXES.items())
    return next(((cause, turn, ground) for cause, turn, ground in grounds if ground and stands(ground)), None)


def by_viewpoint(sample: np.ndarray, viewpoint: np.ndarray, unit_m: float) -> tuple[Stance, str, bool]:
    """Return the stance by the pose (4, 4) in a file if the scan is plausible with it, else the plain one and why.

    And whether nothing in the scan tells which of both is right.

    Programs differ in whether the points are the sensor's or were moved by the pose, and in the direction of the turn.
    A place is believed if the beams are sharper from there, a little so if it is amid the points, which is enough for
    points that lie all together far away; a turn, if only with it the ground lies below.
    """
    plain = Stance(np.zeros(3), np.eye(3))
    origin, turn = viewpoint[:3, 3] * unit_m, viewpoint[:3, :3]
    turns = [turn.T, turn] if not np.allclose(turn, np.eye(3)) else []
    upright = stands(best_ground(sample), level=True)
    candidates = [Stance(plain.origin, rotation, turn_by=BY_VIEWPOINT) for rotation in turns]
    if np.linalg.norm(origin) > NEAREST_M:
        moved = [Stance(origin, turn.T, BY_VIEWPOINT, BY_VIEWPOINT), Stance(origin, np.eye(3), BY_VIEWPOINT)]
        standing, centre = _standing(sample, moved[0]), horizontal_centre(sample)[:2]
        nearer = NEARER * np.linalg.norm(centre - origin[:2]) < np.linalg.norm(centre)
        least = (1 if nearer else CLEARLY) * _sharpest(standing, [plain, *candidates])
        if nearer if is_offset(sample) else _sharpest(standing, moved) > least:
            candidates, upright = moved, False
        elif not upright and not np.any(np.abs(origin[:2]) > NEAREST_M):
            candidates += moved
    if upright:
        seen = [stance.moved(sample) for stance in (plain, *candidates)]
        evidence, *shown = (evidence_of_x(xyz, best_ground(xyz)) for xyz in seen)
        if not shown or max(shown) < max(evidence, 0.0) + SHOWS_AGAINST:
            unused = "; the file's VIEWPOINT is not used: the scan is plausible without it"
            return plain, unused, bool(shown) and max(shown) > evidence - SHOWS_AGAINST
        best = next(stance for stance, value in zip(candidates, shown, strict=True) if value > max(shown) - SHOWS)
        return best, "", False
    for candidate in candidates:
        if stands(best_ground(candidate.moved(sample)), level=True):
            return candidate, "", False
    return plain, "; the file's VIEWPOINT is not used: it does not make the scan plausible", False


def _sharpest(sample: np.ndarray, stances: list[Stance]) -> float:
    """Return how sharp the beams are from the best of the stances."""
    return max(sharpness(stance.moved(sample), np.zeros(3)) for stance in stances)


def _standing(sample: np.ndarray, stance: Stance) -> np.ndarray:
    """Return the points above the ground: the ground itself is a sharp line from there."""
    moved = stance.moved(sample)
    ground = best_ground(moved)
    return sample[np.abs(ground.height_of(moved)) > STANDING_M] if ground else sample


def _upright(sample: np.ndarray, stance: Stance) -> tuple[Stance, Ground | None, list[str]]:
    """Return the stance with z up by the ground, the ground in it, and doubts about what the file had."""
    moved = stance.moved(sample)
    ground = best_ground(moved)
    if ground and (ground.height_m < BELOW_M or abs(ground.height_m) < VEHICLE_GROUND_M):
        return _levelled(sample, stance, ground)
    if (axes := find_other_axes(moved)) is None:
        return stance, ground, []
    cause, turn, turned = axes
    stance, turned, doubts = _levelled(sample, _turned(stance, turn, cause), turned)
    named = cause.startswith(("z", "the axes"))  # where ahead is too
    guess = "" if named else f"; {WHICH_END}, and a left-handed frame stays mirrored"
    return stance, turned, [f"{cause}; its points were turned to have z up{guess}", *doubts]


def _levelled(sample: np.ndarray, stance: Stance, ground: Ground) -> tuple[Stance, Ground, list[str]]:
    """Return the stance levelled by a tilted ground below."""
    if ground.tilt_deg < LEVEL_DEG or ground.share < SURE_SHARE or ground.height_m > BELOW_M:
        return stance, ground, []
    tilt = f"the sensor is tilted by {ground.tilt_deg:.0f} degrees"
    stance = _turned(stance, ground.level_turn, LEVELLED)
    return stance, fit_ground(stance.moved(sample)) or ground, [f"{tilt}; its points were levelled by the ground"]


def _turned(stance: Stance, turn: np.ndarray, why: str) -> Stance:
    return stance._replace(turn=turn @ stance.turn, turn_by=f"{stance.turn_by}, {why}".removeprefix(", "))


def _viewpoint(sample: np.ndarray, ground: Ground | None, height_m: float | None, away: bool) -> tuple[np.ndarray, str]:
    """Return the sensor's origin, and the reason; (0, 0, 0) if it is the cloud's already."""
    floor_m = ground.height_m if ground else 0.0
    if height_m is not None:
        return np.array([0, 0, floor_m + height_m]), "--sensor-height"
    if not away:
        if ground is None or abs(floor_m) > VEHICLE_GROUND_M:
            return np.zeros(3), CLOUD_ORIGIN
        down = np.degrees(np.arctan2(sample[:, 2], np.hypot(sample[:, 0], sample[:, 1])))
        if np.percentile(down, 1) < VEHICLE_DOWN_DEG:
            return np.zeros(3), CLOUD_ORIGIN
    why = "coordinates have an offset" if away else "the ground is at z = 0: a vehicle's frame"
    start = np.array([0, 0, floor_m + SENSOR_HEIGHT_M])
    standing = sample[np.abs(sample[:, 2] - floor_m) > STANDING_M]
    origin = sharpest_origin(standing, start)
    if (origin == start).all() or origin[2] - floor_m < LOWEST_SENSOR_M:
        return start, f"{ASSUMED} {SENSOR_HEIGHT_M} m above the ground, since {why}"
    return origin, f"found by the beams, since {why}"


def _forward(sample: np.ndarray, ground: Ground | None, claims: Claims, turned: bool) -> tuple[str, str, list[str]]:
    """Return the forward axis, the reason, and doubts; the evidence of the scan comes before a claim.

    turned  z is the scan's own finding, so there is no convention to follow.
    """
    if claims.named_forward:
        return claims.named_forward, "--forward", []
    evidence = evidence_of_x(sample, ground)
    why = "the ground that the vehicle hides and the road's direction show it"
    if not claims.forward:
        if evidence >= -(SHOWS if turned else SHOWS_AGAINST):
            return "x", "convention", []
        return "y", why, [] if turned else [f"y, not x, is along the road; {WHICH_END}"]
    if evidence > SHOWS:
        return "x", why, [f"x is along the road, not {claims.forward} as by {claims.forward_by}; {WHICH_END}"]
    if evidence < -SHOWS or claims.sure:
        return claims.forward, claims.forward_by, []
    return (
        claims.forward,
        claims.forward_by,
        [f"nothing in it shows the forward axis; {claims.forward} is by {claims.forward_by}, name it with --forward"],
    )


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


def evidence_of_x(xyz: np.ndarray, ground: Ground | None) -> float:
    """Return the evidence for x and against y as the axis along the road; 0 for a sensor not on a car.

    xyz  (N, 3) float64 metres, z up.
    The sum of two logarithms of ratios: a car hides the ground farther before and behind it than beside it; what
    stands along a road (walls, kerbs, hedges, rows of cars) is gathered at few places across it.
    """
    if ground is None or not CAR_HEIGHT_M[0] <= -ground.height_m <= CAR_HEIGHT_M[1]:
        return 0.0
    along, across = blind_radii(xyz, ground)
    hidden = float(np.log(np.mean(along) / np.mean(across))) if along and across else 0.0
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    height = ground.height_of(xyz)
    standing = (height > ROADSIDE_M[0]) & (height < ROADSIDE_M[1]) & (distance > NEAR_M) & (distance < REACH_M)
    if np.count_nonzero(standing) < FEWEST_ROADSIDE:
        return hidden
    x, y, _ = xyz[standing].T
    return hidden + float(np.log(_gathered(y) / _gathered(x)))


def _gathered(values: np.ndarray) -> float:
    """Return how much values gather at few places; 1 for not at all."""
    counts = np.histogram(values, np.arange(-REACH_M, REACH_M, WALL_M))[0].astype(np.float64)
    return float((counts @ counts) / max(counts @ np.convolve(counts, np.ones(SMOOTH) / SMOOTH, "same"), 1.0))
