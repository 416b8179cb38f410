"""Plausibility: implausible properties of points, contradictions with the first scan of a stream, empty sectors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.ground_plane import BELOW_M, LEVEL_DEG, SURE_SHARE, Ground, best_ground, fit_ground
from lidar2pano.formats.sensor_placement import (
    OTHER_AXES,
    Placement,
    evidence_of_x,
    find_other_axes,
    find_unit,
    is_offset,
)
from lidar2pano.formats.unnamed_columns import share_between

SWEEP_POINTS = 500  # usable ones; the sparsest LiDAR gives thousands
ENOUGH_POINTS = 10_000  # without a ground among so many, something is wrong
MOST_ODD = 0.02  # of the coordinates are no lengths
MOST_UNUSABLE = 0.1  # of the points in a file without rows of an image, which has no marks of missing returns
SMALLEST, LARGEST = 1e-12, 1e9  # of a nonzero coordinate, in any unit: others are bytes of something else
SAMPLE = 10_000  # points to find a repeated one among
REPEATED, FEWEST_REPEATS = 0.01, 100  # of the points at exactly one place are no echoes
SAME_RANGE, IN_PLANE = 1e-4, 2e-3  # ranges so nearly alike, as a share, are one; rays of a plane's ring, radians
PROJECTION = np.array([1.0, np.sqrt(2), np.sqrt(3)])  # brings equal points together when sorted
GAP_DEG = 15.0  # a sector of so many degrees without any point is out of the field of view
SLIVER_DEG = 2.0  # a few stray points between two gaps
NARROWEST_DEG = 60.0  # in view; less is no sweep

# Of a path: steps from point to point, as a share of the cloud's extent (99 of 100 are below: 84 real scans have 0.25
# and more, drives .01 to .03); and how often it comes by a place: rows of a scan do so line by line.
PATH_STEP, MOST_VISITS = 0.05, 2
FEWEST_OF_PATH = 100
FEWEST_TURNS = 3  # around the sensor, one a beam: no sensor has fewer than four

MOST_TILT_DEG = 2 * LEVEL_DEG  # against the first scan's ground: a sensor does not turn, and ramps are no steeper
OPPOSED = 0.7  # evidence against the first scan's forward axis; scans at crossings have 0.1
RING_SHARE = 0.25  # of the elevations' variance is between rings; chance gives none, a tilted sensor's half of it
FEWEST_RINGS = 8  # lines of fewer lasers (Livox) are no elevations


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
        odd = (
            float(np.mean((np.isfinite(size) & (size > LARGEST)) | ((size > 0) & (size < SMALLEST))))
            if len(xyz)
            else 0.0
        )
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


def repeated_range(sample: np.ndarray) -> tuple[float, float] | None:
    """Return the interval of ranges at which so many points (N, 3) lie as only a mark of missing returns has.

    Drivers and simulators write a sensor's farthest range, or 65.535 m, where nothing came back. A ring of even ground
    lies at one range, too, but in a plane. None without any.
    """
    sample = sample[:: max(1, len(sample) // SAMPLE)]
    range_m = np.linalg.norm(sample, axis=1)
    far = range_m >= np.median(range_m) if len(sample) else np.zeros(0, bool)
    if np.count_nonzero(far) < FEWEST_REPEATS:
        return None
    steps = np.floor(np.log(range_m[far]) / SAME_RANGE).astype(np.int64)
    values, counts = np.unique(steps, return_counts=True)
    middle = float(np.median(range_m[far][steps == values[counts.argmax()]]))
    low, high = middle * (1 - SAME_RANGE), middle * (1 + SAME_RANGE)
    same = (range_m >= low) & (range_m <= high)
    if np.count_nonzero(same) < max(FEWEST_REPEATS, REPEATED * len(sample)):
        return None
    return None if _mostly_in_a_plane(sample[same] / range_m[same, None]) else (low, high)


def _mostly_in_a_plane(rays: np.ndarray) -> bool:
    """Return whether more than half of the rays (N, 3) end in one plane (least trimmed squares, Rousseeuw 1984)."""
    kept = np.ones(len(rays), bool)
    away = np.zeros(len(rays))
    for _ in range(5):
        middle = rays[kept].mean(0)
        away = np.abs((rays - middle) @ np.linalg.svd(rays[kept] - middle, full_matrices=False)[2][-1])
        kept = away <= np.median(away)
    return float(np.median(away)) < IN_PLANE


def is_path(sample: np.ndarray) -> bool:
    """Return whether points (N, 3), in the file's order, follow each other along a line, as a vehicle's places do.

    A sweep jumps from beam to beam and from one thing to what is behind it, or goes round the sensor again and again.
    """
    sample = sample.astype(np.float64)
    if len(sample) < FEWEST_OF_PATH:
        return False
    extent = float(np.percentile(np.linalg.norm(sample - np.median(sample, axis=0), axis=1), 90))
    step = float(np.percentile(np.linalg.norm(np.diff(sample, axis=0), axis=1), 99))
    if not 0 < step < PATH_STEP * extent:
        return False
    turns = np.diff(np.unwrap(np.arctan2(sample[:, 1], sample[:, 0]))).sum() / (2 * np.pi)
    if abs(turns) >= FEWEST_TURNS:
        return False
    cell = np.unique(np.floor((sample - sample.min(axis=0)) / (4 * step)), axis=0, return_inverse=True)[1].ravel()
    arrivals = cell[np.flatnonzero(np.diff(cell, prepend=-1))]
    return float(np.median(np.unique(arrivals, return_counts=True)[1])) <= MOST_VISITS


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
    if not invent and (narrow := narrow_view(gaps)):
        raise InputError(narrow)
    return tuple(gaps)


def narrow_view(gaps: Sequence[tuple[float, float]]) -> str:
    """Return the sentence about a field of view, all around but for the gaps, that is no sweep's; "" for a sweep's."""
    view_deg = 360 - sum(left - right for left, right in gaps)
    if view_deg >= NARROWEST_DEG:
        return ""
    return f"is no sweep all around: only {view_deg:.0f} of 360 degrees hold points; --invent paints the rest anyway"


def contradictions(sample: np.ndarray, first: Placement) -> list[str]:
    """Return contradictions of a sample (N, 3) float64 of a scan's points with the placement of its stream's first."""
    if is_offset(sample):
        return []
    if find_unit(sample) != first.unit_m:
        return ["its unit is not the first scan's; it is read by itself"]
    if first.ground_m is None:
        return []
    moved = first.moved(sample, np.ones(len(sample), bool))
    ground = best_ground(moved)
    if ground and ground.share >= SURE_SHARE and ground.height_m < BELOW_M:
        return _of_ground(moved, ground)
    axes = find_other_axes(moved)
    return [f"{axes[0]}, unlike in the first scan; it is read by itself"] if axes else []


def _of_ground(moved: np.ndarray, ground: Ground) -> list[str]:
    if ground.tilt_deg > MOST_TILT_DEG:
        tilt = f"its ground is tilted by {ground.tilt_deg:.0f} degrees against the first scan's"
        return [f"{tilt}; it is read by itself"]
    if evidence_of_x(moved, ground) < -OPPOSED:
        return ["its forward axis is not the first scan's; it is read by itself"]
    return []


def follows_elevation(ring: np.ndarray, xyz: np.ndarray, placement: Placement) -> bool:
    """Return whether rings (N,) are beams: points (N, 3) of one ring have elevations near to each other.

    xyz  as the file holds them, with coordinates; elevations are about the cloud's own z, and about the scan's.
    """
    local = xyz.astype(np.float64) * placement.unit_m - placement.viewpoint_m
    return any(share_between(ring, _elevation(turned)) > RING_SHARE for turned in (local, local @ placement.rotation.T))


def _elevation(xyz: np.ndarray) -> np.ndarray:
    return np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
