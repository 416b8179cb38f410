"""Interpretation of a cloud: placement, remission and its scale, rings, field of view, doubts; the resulting Scan."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.beams import MOST as MOST_BEAMS
from lidar2pano.formats.beams import find_beams
from lidar2pano.formats.plausibility import (
    FEWEST_RINGS,
    contradictions,
    doubts_about,
    doubts_about_ground,
    find_gaps,
    follows_elevation,
    is_path,
    repeated_point,
    repeated_range,
)
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.formats.sensor_placement import FORWARD, Claims, Placement, is_offset, place
from lidar2pano.scan import Scan

A_PATH = "its points follow each other along a line, as those of a trajectory or of poses do; name a scan"
NO_RETURN = 0.01  # nearer to the origin, in the cloud's unit, there was no echo
FEWEST = 1000  # usable points or remissions; fewer decide nothing: they are taken as they are
NUSCENES_FORMAT = "float32 rows, nuScenes"
NUSCENES_SENSOR = "Velodyne HDL-32E"
ALIKE_DEG, ALIKE_POINTS = 2.0, 1.5  # between scans of one sensor: lowest beam, factor of counts
SAMPLE = 40_000  # points for finding the geometry, remissions for finding their scale
STAND_IN = 0.25  # remission of all points if there is none: costs least, see runs/remission_stand_in.py
SCALES = (1.0, 255.0, 65535.0)
FULL_SHARE = 1 / 16  # the 99th percentile of 16 bit remissions is not below this share of the scale
# Tolerated shares of values beyond a scale. Of values up to 255 most are above 1; those of 16 bits have their
# 99th percentile to fall back on.
MOST_ABOVE_ONE, MOST_ABOVE = 0.25, 0.01
TAILS = (0.1, 99.9)  # percentiles; values without a difference between them are constant
EDGES = (0.5, 99.5)  # percentiles; they become 0 and 1 if many values are negative
MARKED = 0.99  # of the negative values are one and the same: it marks missing ones
MOST_FULL = 0.5  # of the remissions are full
LEAST_FILLED = 0.01  # of a scale from another source, by the values' 99th percentile
BELOW_ZERO = "its remissions reach below zero, and are scaled by percentiles; leave them out with --remission none"
NONE, MIN_MAX, PERCENTILE = "none", "min-max", "0-99th percentile"


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
class Interpretation(Placement):
    """The reading of a cloud.

    points, no_returns   how many there are, and how many of them are at the origin, NaN, Inf, or all at one place.
    remission            how it was scaled: "0-1", "0-255", "0-65535", "min-max" or "none"; remission_full: the value
                         of full remission, None if all points have the stand-in; remission_zero: of no remission;
                         remission_odd: how many were limited to these, or have the stand-in.
    gaps_deg             sectors (left, right) of azimuth out of the field of view, counter-clockwise from forward.
    invented             whether the panorama claims the gaps.
    lowest_deg           elevation below 99 of 100 points, from the cloud's origin.
    doubts               implausible properties of the cloud, a sentence each.
    """

    format: str
    fields: tuple[str, ...]
    frame: str
    stamp_s: float | None
    points: int
    no_returns: int
    remission: str = "0-1"
    remission_full: float | None = 1.0
    remission_zero: float = 0.0
    remission_odd: int = 0
    gaps_deg: tuple[tuple[float, float], ...] = ()
    invented: bool = False
    lowest_deg: float | None = None
    doubts: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)

    @property
    def scale(self) -> Scale:
        """The scale of remission."""
        return Scale(self.remission, self.remission_full, self.remission_zero)


def interpret(
    cloud: PointCloud, overrides: Overrides | None = None, like: Interpretation | None = None
) -> tuple[Scan, Interpretation]:
    """Return the scan in the sensor's frame (x forward, metres, remission in [0, 1]), and its interpretation.

    like  interpretation of the same stream's first cloud: unit, axes, height and remission are taken from it, unless
          the two are of different sensors, or the cloud contradicts them, with a doubt.
    Numbers stay exact if nothing must change. Raises InputError for anything but a sweep.
    """
    overrides = overrides or Overrides()
    xyz, returns, sample = _returns(cloud.xyz)
    usable = int(np.count_nonzero(returns))
    result = Interpretation(
        format=cloud.format,
        fields=cloud.fields,
        frame=cloud.frame,
        stamp_s=cloud.stamp_s if cloud.stamp_s is None or np.isfinite(cloud.stamp_s) else None,
        points=len(cloud),
        no_returns=len(cloud) - usable,
        invented=overrides.invent,
        lowest_deg=_lowest(sample),
    )
    first = like if like and (like.format, like.fields) == (cloud.format, cloud.fields) else None
    posed = first is not None and first.uses_viewpoint and cloud.viewpoint is not None  # each scan has its own place
    opposed = contradictions(sample, first) if first and usable >= FEWEST and not posed else []
    like = first if first and not opposed and _alike(result, first) else None
    remission = scale_remission(cloud.intensity, returns, overrides.remission, like.scale if like else None)
    if first and not remission.doubts and remission.scale.name != first.remission:
        opposed.append(f"its remissions are read as {remission.scale.name}, the first scan's as {first.remission}")
    name, full, zero = remission.scale
    result = replace(result, remission=name, remission_full=full, remission_zero=zero, remission_odd=remission.odd)
    doubts = [*doubts_about(xyz, returns, rows=" rows, " in cloud.format), *cloud.doubts, *remission.doubts, *opposed]
    if usable >= FEWEST:
        try:
            placement, unsure = _placement(sample, cloud, returns, overrides, None if posed else like)
            result = replace(result, **{field.name: getattr(placement, field.name) for field in fields(Placement)})
            xyz = result.moved(xyz, returns)
            result = replace(result, gaps_deg=find_gaps(xyz[returns], overrides.invent))
        except InputError as error:
            raise InputError("; ".join([str(error), *doubts])) from None
        doubts += unsure
        if not doubts and (result.ground_m is None or result.ground_m < 0):
            doubts = doubts_about_ground(xyz[:: max(1, len(xyz) // SAMPLE)])
    elif overrides.forward:
        result = replace(result, forward=overrides.forward, forward_by="--forward")
        xyz = result.moved(xyz, returns)
    ring, unsure = _rings(cloud, returns, result)
    with np.errstate(over="ignore"):  # no returns may be beyond float32
        xyz = np.array(xyz, np.float32, order="C")  # a copy: the cloud's may be a view of a file, or of the caller's
    scan = Scan(
        xyz=xyz,
        remission=remission.values,
        label=cloud.label,
        name=cloud.name,
        ring=ring,
        time_s=cloud.time_s,
        gaps_deg=() if overrides.invent else result.gaps_deg,
        near_infrared=_finite(cloud.near_infrared),
    )
    return scan, replace(result, doubts=(*doubts, *unsure))


def _finite(values: np.ndarray | None) -> np.ndarray | None:
    """Return values as float32, zero where they are not finite or beyond it."""
    if values is None:
        return None
    with np.errstate(over="ignore"):
        return np.nan_to_num(values.astype(np.float32), posinf=0, neginf=0)


def _returns(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points (N, 3), NaN at marks of missing returns; the mask (N,) of returns; a sample of these.

    Raises InputError for a path of places.
    """
    with np.errstate(over="ignore"):
        squared = np.einsum("ij,ij->i", xyz, xyz)
    returns = np.isfinite(squared) & (squared > NO_RETURN**2)
    step = max(1, len(xyz) // SAMPLE)
    sample = xyz[::step][returns[::step]].astype(np.float64)
    if (mark := repeated_point(sample)) is not None:
        returns &= (xyz != mark).any(1)
        sample = sample[(sample != mark).any(1)]
    if (edges := repeated_range(sample)) is not None:
        with np.errstate(invalid="ignore"):
            returns &= (squared < edges[0] ** 2) | (squared > edges[1] ** 2)
    if mark is not None or edges is not None:
        xyz = np.where(returns[:, None], xyz, np.nan)
        sample = xyz[::step][returns[::step]].astype(np.float64)
    if is_path(sample):
        raise InputError(A_PATH)
    return xyz, returns, sample


def _lowest(sample: np.ndarray) -> float | None:
    elevation = np.arctan2(sample[:, 2], np.hypot(sample[:, 0], sample[:, 1]))
    return round(float(np.degrees(np.percentile(elevation, 1))), 2) if len(sample) else None


def _alike(result: Interpretation, like: Interpretation) -> bool:
    """Return whether two clouds are of one form are of one sensor: by the lowest beam, and the number of points."""
    if None in (result.lowest_deg, like.lowest_deg):
        return False
    few, many = sorted((result.points - result.no_returns, like.points - like.no_returns))
    return abs((result.lowest_deg or 0) - (like.lowest_deg or 0)) < ALIKE_DEG and many < ALIKE_POINTS * few


def _placement(
    sample: np.ndarray, cloud: PointCloud, returns: np.ndarray, overrides: Overrides, like: Interpretation | None
) -> tuple[Placement, list[str]]:
    """Return the first scan's placement, or the cloud's own, and doubts; `sample`: (N, 3) float64 of its points."""
    if like and overrides.sensor_height_m is None and not is_offset(sample):
        return like, []
    claims = Claims(
        viewpoint=cloud.viewpoint, named_forward=overrides.forward, named_height_m=overrides.sensor_height_m
    )
    if cloud.format == NUSCENES_FORMAT and cloud.ring is not None:
        beams = find_beams(cloud.xyz[returns], cloud.ring[returns])
        sure = beams is not None and NUSCENES_SENSOR in beams.sensor()
        claims = replace(claims, forward="y", forward_by="nuScenes' convention", sure=sure)
    return place(sample, claims)


def _rings(cloud: PointCloud, returns: np.ndarray, placement: Placement) -> tuple[np.ndarray | None, list[str]]:
    """Return the numbers of the beams if elevations do not contradict them, and doubts."""
    if cloud.ring is None or np.count_nonzero(returns) < FEWEST:
        return cloud.ring, []
    step = max(1, len(cloud) // SAMPLE)
    ring = cloud.ring[::step][returns[::step]]
    count = len(np.unique(ring))
    if count < MOST_BEAMS and follows_elevation(ring, cloud.xyz[::step][returns[::step]], placement):
        return cloud.ring, []
    doubt = "its rings do not follow the elevations of its points; they are not used"
    return None, [doubt] if count >= FEWEST_RINGS else []


class Scale(NamedTuple):
    """The scale of remission: its name, the value of full remission (None if there is none), and the value of zero."""

    name: str
    full: float | None = None
    zero: float = 0.0


class Remission(NamedTuple):
    """Remission (N,) float32 in [0, 1]; its scale; how many values were limited or replaced; doubts."""

    values: np.ndarray
    scale: Scale
    odd: int
    doubts: list[str]


def scale_remission(intensity: np.ndarray | None, returns: np.ndarray, named: str, first: Scale | None) -> Remission:
    """Return the remission of points.

    intensity  (N,) as the file holds it;  returns: (N,) bool, points with coordinates: others have no say.
    named      the user's scale ("1", "255", "65535", "none"), "" to find it out.
    first      the scale of the stream's first scan, if there is one: it holds, and what contradicts it is doubted.
    """
    stand_in = np.full(len(returns), STAND_IN, np.float32)
    if intensity is None or named == NONE:
        return Remission(stand_in, Scale(NONE), 0, [])
    missing = _missing(intensity, returns)
    if intensity.dtype == np.int8 and np.mean((intensity < 0) & ~missing) > MOST_ABOVE:
        intensity = intensity.view(np.uint8)  # drivers call an unsigned byte signed
    valid = returns & ~missing
    sample = intensity[valid]
    sample = sample[:: max(1, len(sample) // SAMPLE)].astype(np.float64)
    constant = not len(sample) or (len(sample) >= FEWEST and not np.ptp(np.percentile(sample, TAILS)))
    if first is not None and not named and constant != (first.name == NONE):
        say = "say nothing" if constant else "differ from point to point"
        return Remission(
            stand_in, Scale(NONE), 0, [f"its remissions {say}, unlike the first scan's; they are not used"]
        )
    if constant and not (named and len(sample)):
        return Remission(stand_in, Scale(NONE), 0, [])
    scale = Scale(f"0-{named}", float(named)) if named else first or _scale(sample, intensity.dtype)
    full = scale.full or 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        values = (intensity.astype(np.float64) - scale.zero if scale.zero else intensity).astype(np.float32)
        values = np.clip(values / np.float32(full) if full != 1 else values, 0, 1)
        outside = valid & ((intensity < scale.zero) | (intensity > scale.zero + full))
    values[missing] = STAND_IN
    odd = int(np.count_nonzero(outside | (missing & returns)))
    doubts = _doubts(sample, values[valid], scale, missing[returns], "--remission" if named else "the first scan")
    if not (named or first) and scale.name in (MIN_MAX, PERCENTILE):
        doubts = [BELOW_ZERO] if scale.name == MIN_MAX else []
    return Remission(values, scale, odd, doubts)


def _missing(intensity: np.ndarray, returns: np.ndarray) -> np.ndarray:
    """Return the mask (N,) of values without a remission: NaN, infinite, or a negative mark of missing ones."""
    if intensity.dtype.kind == "u":
        return np.zeros(len(intensity), bool)
    missing = ~np.isfinite(intensity) if intensity.dtype.kind == "f" else np.zeros(len(intensity), bool)
    negative = intensity[~missing & returns & (intensity < 0)]
    if len(negative):
        values, counts = np.unique(negative, return_counts=True)
        if counts.max() >= MARKED * len(negative):
            missing |= intensity == values[counts.argmax()]
    return missing


def _scale(sample: np.ndarray, dtype: np.dtype) -> Scale:
    """Return the scale of valid values."""
    if np.mean(sample < 0) > MOST_ABOVE:
        low, high = (float(edge) for edge in np.percentile(sample, EDGES))
        return Scale(MIN_MAX, high - low, low)
    most = float(np.percentile(sample, 99))
    integers = dtype.kind in "iu"
    if not integers:
        excess = float(np.mean(sample > 1))
        fractions = bool((sample[sample <= 1] % 1).any())
        if not excess or (excess <= MOST_ABOVE_ONE and fractions):
            return Scale("0-1", 1.0)
    for full in SCALES[1:]:
        if np.mean(sample > full) <= MOST_ABOVE:
            if full == SCALES[-1] and most < full * FULL_SHARE:
                return Scale(PERCENTILE, max(most, SCALES[1]))  # photon counts, or 12 bit
            return Scale(f"0-{full:.0f}", full)
    return Scale(PERCENTILE, most)


def _doubts(sample: np.ndarray, values: np.ndarray, scale: Scale, missing: np.ndarray, source: str) -> list[str]:
    """Return doubts about values (V,) in [0, 1], a sample of them as the file holds them, and the mask of missing ones.

    source  of a scale that the values themselves did not give.
    """
    doubts = []
    full = scale.zero + (scale.full or 1.0)
    beyond = float(np.mean(sample > full))
    if float(np.mean(values >= 1)) > MOST_FULL:
        doubts.append("most of its points have full remission; name the scale with --remission")
    elif beyond > MOST_ABOVE:
        doubts.append(
            f"{beyond:.0%} of its remissions are above {full:g}, and limited; name the scale with --remission"
        )
    if float(np.percentile(sample, 99)) - scale.zero < LEAST_FILLED * (scale.full or 1.0):
        doubts.append(f"its remissions do not reach a hundredth of {full:g}, full by {source}; name another scale")
    if float(np.mean(missing)) > MOST_ABOVE:
        doubts.append(f"{np.mean(missing):.0%} of its points have no valid remission; a constant stands in")
    return doubts
