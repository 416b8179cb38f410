"""PointCloud: points as a file or a message holds them, and the names of fields."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.field_names import FIELDS, are_poses, find_named, meanings, plain_name, second_pairs, spherical
from lidar2pano.formats.file_contents import stem_of

MOST_POINTS = 1 << 24  # a sweep of the densest LiDAR has 0.6 million points; more are a map or a damaged header
BLOCK_POINTS = 1 << 16  # read at a time of files of any length
POLAR_DOUBT = (  # nothing tells the direction of an azimuth
    "its places are of ranges and angles, whose azimuth is taken as counter-clockwise from ahead; if it is clockwise,"
    " as in sensors' own packets, all is mirrored: write x, y and z"
)
POSES = "holds places with orientations (poses, a trajectory), and no points; name a scan"
OTHER = "name a scan that has some"
MOST_RADIANS, MOST_DEGREES = 6.4, 400.0  # of an azimuth
MOST_BEAMS = 1 << 16  # numbers beyond are no beams
SAMPLE = 2000  # values to tell by whether a field says anything

NANOSECONDS = ("offset_ns", "offset_time", "t", "time_stamp")  # if stored as integers, by convention
EPOCH_S = 1e8  # times beyond this, in seconds, count from an epoch and not from the start of the sweep
UNITS = (1.0, 1e-3, 1e-6, 1e-9)  # seconds
PERIODS_S = (1, 60, 3600, 86_400, 604_800)  # of clocks
CLOCKS = (*((round(period / unit), unit) for period in PERIODS_S for unit in UNITS), (2**32, 1e-9), (2**32, 1e-6))
LONGEST_S = 3.2  # of a sweep: 0.1 s times the root of 1000, half-way to the next unit
SHORTEST_S = 1e-3  # of a sweep in a unit by convention
TURN_S = 0.2  # of the slowest LiDARs, 5 Hz
HALVES = 3.0  # times the shortest half of the times, from its middle, is more than a turn: uniform times reach 1.5
STAMP_S = 60.0  # farther from the scan's stamp, times are of another clock
MOST_ODD = 0.01  # of the points may have no believable time without a word


class NoPointsError(InputError):
    """A scan without any point, as a driver sends one before its sensor turns."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointCloud:
    """Points as a file or message holds them, nothing decided yet; arrays may be views of it, not to be written to.

    xyz        (N, 3) float32 or float64, in the file's own axes and unit.
    intensity  (N,) as stored (any numeric dtype), or None.
    near_infrared  (N,) daylight as stored (any numeric dtype), or None.
    ring       (N,) integer beam number, or None.
    time_s     (N,) float64 seconds relative to `stamp_s`, or None.
    label      (N,) int64 ids of SEMANTIC_KITTI, or None.
    stamp_s    seconds since the epoch or since the recording's own, or None.
    frame      name of the coordinate frame, "" if the file has none.
    format     for people, e.g. "PCD, binary_compressed".
    name       stem of the file, for messages and output names.
    fields     names of all fields of the file, in its order.
    viewpoint  (4, 4) float64 T of the sensor in the cloud's frame as the file claims it, or None.
    doubts     contradictions of the file, a sentence each.
    """

    xyz: np.ndarray
    intensity: np.ndarray | None = None
    ring: np.ndarray | None = None
    time_s: np.ndarray | None = None
    label: np.ndarray | None = None
    stamp_s: float | None = None
    frame: str = ""
    format: str = ""
    name: str = "scan"
    fields: tuple[str, ...] = ()
    viewpoint: np.ndarray | None = None
    doubts: tuple[str, ...] = ()
    near_infrared: np.ndarray | None = None

    def __len__(self) -> int:
        """Number of points, unusable ones included."""
        return len(self.xyz)

    def require_points(self, title: str) -> None:
        """Raise NoPointsError, which begins with `title`, if no point has a place."""
        if not (np.isfinite(self.xyz).all(axis=1) & self.xyz.any(axis=1)).any():
            raise NoPointsError(f"{title}: none of its {len(self)} points has a place (all are 0 or NaN); {OTHER}")


class RowLayout(NamedTuple):
    """How the points of a file follow each other: rows of one type from an offset on, or lines of text.

    columns  place of a field in the row by its name;  count: of the points, 0 if the file does not say.
    """

    start: int
    dtype: np.dtype
    columns: dict[str, int]
    count: int
    text: bool

    @property
    def starts(self) -> list[int]:
        """Place of each field's first value in a line of text, and the number of values."""
        sizes = [math.prod(self.dtype[name].shape) for name in self.dtype.names or ()]
        return list(accumulate(sizes, initial=0))

    def check_lines(self, lines: int, path: Path) -> None:
        """Raise InputError for another number of lines than the header says."""
        if self.count not in (0, lines):
            raise InputError(f"{path}: its header says {self.count} points, but it holds {lines}; fetch it again")

    def binary_count(self, length: int, path: Path) -> int:
        """Return the number of rows in a file of `length` bytes; InputError if it is truncated."""
        size, left = self.dtype.itemsize, length - self.start
        count = self.count or left // max(size, 1)
        if not size or count * size > left:
            raise InputError(
                f"{path}: its header says {count} points, which need {count * size} bytes, but {left} follow;"
                " the file is truncated"
            )
        return count

    def fields(self, rows: bytes | memoryview) -> dict[str, np.ndarray]:
        """Return the fields of some binary rows by their names."""
        values = np.frombuffer(rows, self.dtype if self.columns else np.uint8)
        return {name: values[f"{place}"] for name, place in self.columns.items()}


def sweep_error(source: object, points: int) -> InputError:
    """Return the error of a file or message of no points, or of more than a scan may have."""
    if not points:
        return NoPointsError(f"{source}: holds no points; {OTHER}")
    return InputError(f"{source}: {points} points are no single sweep (at most {MOST_POINTS}); cut it")


def cloud_of_columns(
    columns: Mapping[str, np.ndarray],
    *,
    format: str,
    name: str | Path,
    frame: str = "",
    stamp_s: float | None = None,
    viewpoint: np.ndarray | None = None,
    doubts: Sequence[str] = (),
) -> PointCloud:
    """Return the PointCloud whose fields are `columns`: name -> (N,) of any numeric dtype and byte order.

    name  of the cloud, or the path of its file; it begins the message of an InputError.
    Fields are found by the names above; others are only listed. Raises InputError if x, y or z is missing or there
    is no point.
    """
    if are_poses(columns):
        raise InputError(f"{name}: {POSES}")
    key_by_name = {plain_name(key): key for key in reversed(list(columns))}
    if not {"x", "y", "z"} <= key_by_name.keys() and (polar := spherical(list(columns))):
        columns, doubts = _with_places(columns, polar), [*doubts, POLAR_DOUBT]
        key_by_name = {plain_name(key): key for key in reversed(list(columns))}
    if not {"x", "y", "z"} <= key_by_name.keys():
        axes_by_key = zip(columns, meanings([plain_name(key) for key in columns]), strict=True)
        key_by_name = {name: key for key, (name, _) in axes_by_key}
    if missing := [axis for axis in "xyz" if axis not in key_by_name]:
        held = ", ".join(columns) or "none"
        raise InputError(f"{name}: has no field {missing[0]!r} (it has {held}); name a scan with x, y and z")
    axes = [columns[key_by_name[axis]] for axis in "xyz"]
    if not 0 < len(axes[0]) <= MOST_POINTS:
        raise sweep_error(name, len(axes[0]))
    exact = any(axis.dtype.itemsize > 4 or (axis.dtype.kind in "iu" and axis.dtype.itemsize > 2) for axis in axes)
    dtype = np.float64 if exact else np.float32
    xyz = np.empty((len(axes[0]), 3), dtype)
    for column, axis in enumerate(axes):
        xyz[:, column] = axis
    squared = np.einsum("ij,ij->i", xyz, xyz)
    valid = np.isfinite(squared) & (squared > 0)
    intensity, ring, time, light = (
        [(key, columns[key]) for key in find_named(columns, names, words)] for names, words in FIELDS
    )
    time = _whole_times(columns) or time
    time_s, start_s, unsure = point_times(time, stamp_s, valid)
    return PointCloud(
        xyz=xyz,
        intensity=_native(_telling(intensity, valid)) if intensity else None,
        ring=_integers(_telling(ring, valid)) if ring else None,
        time_s=time_s,
        stamp_s=start_s,
        frame=frame,
        format=format,
        name=stem_of(name) if isinstance(name, Path) else name,
        fields=tuple(columns),
        viewpoint=viewpoint,
        doubts=(*doubts, *unsure),
        near_infrared=_native(light[0][1]) if light else None,
    )


def _with_places(columns: Mapping[str, np.ndarray], polar: Sequence[str]) -> dict[str, np.ndarray]:
    """Return columns with x, y and z in place of those named `polar`: a range, an azimuth and an elevation.

    Angles are radians, degrees if they are more than a turn of these, an azimuth hundredths of degrees likewise.
    """
    range_m, azimuth, elevation = (columns[key].astype(np.float64) for key in polar)
    if not range_m.shape == azimuth.shape == elevation.shape:
        raise InputError("ranges and angles are of different numbers; write x, y and z")
    largest = float(np.nanmax(np.abs(azimuth), initial=0))
    unit = 1.0 if largest <= MOST_RADIANS else np.pi / 180
    azimuth = azimuth * (unit if largest <= MOST_DEGREES else unit / 100)
    elevation = elevation * unit
    level_m = range_m * np.cos(elevation)
    places = {"x": level_m * np.cos(azimuth), "y": level_m * np.sin(azimuth), "z": range_m * np.sin(elevation)}
    return places | {key: values for key, values in columns.items() if key not in polar}


def _whole_times(columns: Mapping[str, np.ndarray]) -> list[tuple[str, np.ndarray]]:
    """Return times in nanoseconds of two columns, of whole seconds and of the rest ("sec", "nsec"); [] for no pair."""
    for key, prefix, unit in second_pairs(list(columns)):
        seconds, parts = columns[key[0]], columns[key[1]]
        exact = all(values.dtype.kind in "iu" or values.dtype.itemsize == 8 for values in (seconds, parts))
        if exact and all(
            bool((np.isfinite(values) & (values >= 0) & (values < 2**33)).all()) for values in (seconds, parts)
        ):
            return [(prefix, seconds.astype(np.int64) * 10**9 + parts.astype(np.int64) * unit)]
    return []


def _telling(fields: Sequence[tuple[str, np.ndarray]], valid: np.ndarray) -> np.ndarray:
    """Return the first of the fields (name, values) that differs from point to point, or just the first."""
    for _, values in fields if len(fields) > 1 else ():
        sample = values[valid][:: max(1, len(values) // SAMPLE)].astype(np.float64)
        sample = sample[np.isfinite(sample)]
        if len(sample) and np.ptp(np.percentile(sample, (1, 99))) > 0:
            return values
    return fields[0][1]


def _integers(values: np.ndarray) -> np.ndarray:
    """Return numbers of beams as int64, -1 for a value that is no such number."""
    if values.dtype.kind != "f":
        return values.astype(np.int64)
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(values) < MOST_BEAMS, values, -1).astype(np.int64)


def _native(values: np.ndarray) -> np.ndarray:
    """Return the values in the machine's byte order."""
    return values.astype(values.dtype.newbyteorder("="), copy=False)


def point_times(
    fields: Sequence[tuple[str, np.ndarray]], stamp_s: float | None, valid: np.ndarray
) -> tuple[np.ndarray | None, float | None, list[str]]:
    """Return times by the first usable one of the fields (name, values), the stamp, and doubts; see `seconds`."""
    doubts: list[str] = []
    for name, values in fields:
        time_s, start_s, odd = seconds(name, values, stamp_s, valid)
        if time_s is not None:
            share = odd / max(int(np.count_nonzero(valid)), 1)
            few = f"{odd} of its points have times more than a turn from the others; they are taken at mid-sweep"
            return time_s, start_s, [few] if share > MOST_ODD else []
        if odd:
            doubts = [f"field {name!r} is no time of a sweep in any unit; it is not used"]
    return None, stamp_s, doubts


def seconds(
    name: str, values: np.ndarray, stamp_s: float | None, valid: np.ndarray | None = None
) -> tuple[np.ndarray | None, float | None, int]:
    """Return times of points in seconds relative to a stamp, the stamp, and the number of points left out.

    valid  (N,) bool: points with coordinates; others have no say. None: all.
    A sweep in the unit lasts nearest to 0.1 s, or nanoseconds for integer fields of NANOSECONDS. A point more than a
    turn from the others gets the middle of the others. Times since an epoch become relative to `stamp_s`, or to the
    first one if there is none; those of another clock to the first one. The times are None if they are constant (0 are
    left out) or of no sweep (all are).
    """
    values = values.astype(values.dtype.newbyteorder("="), copy=False)
    usable = np.isfinite(values) if values.dtype.kind == "f" else np.ones(len(values), bool)
    valid = usable & valid if valid is not None and (usable & valid).any() else usable
    if not usable.any():
        return None, stamp_s, 0
    values = _unwrapped(values, valid)
    middle, spread = _shortest_half(np.sort(values[valid]))
    if not spread:
        return None, stamp_s, 0
    unit = _unit(name, values.dtype, spread)
    if unit is None:
        return None, stamp_s, len(values)
    near = usable & (np.abs(_differences(values, middle)) * unit <= max(HALVES * spread * unit, TURN_S))
    odd = int(np.count_nonzero(valid & ~near))
    values = np.where(near, values, middle)
    low = values[near & valid].min()
    low_s = float(low) * unit
    if abs(low_s) < LONGEST_S:
        return values.astype(np.float64) * unit, stamp_s, odd
    time_s = _differences(values, low) * unit
    if low_s >= EPOCH_S:
        if stamp_s is None or abs(low_s - stamp_s) > STAMP_S:
            return time_s, low_s, odd
        time_s += low_s - stamp_s
    return time_s, stamp_s, odd


def _unwrapped(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return times without the step of a clock that begins again amid a sweep, as Velodyne's does each hour.

    Then all times are within a turn of the clock's beginning or its end, in one unit.
    """
    times = values.astype(np.float64)
    low, high = float(times[valid].min()), float(times[valid].max())
    for period, unit in CLOCKS:
        turn = TURN_S / unit
        if not (0 <= low < turn and period - turn < high < period):
            continue
        is_later = times < turn
        if (is_later | (times >= period - turn))[valid].all():
            return np.where(is_later, times + period, times)
    return values


def _differences(values: np.ndarray, origins: np.ndarray | np.generic) -> np.ndarray:
    """Return values minus origins, float64: exact for large integers, without overflow."""
    if values.dtype.kind == "f":
        with np.errstate(invalid="ignore", over="ignore"):
            return (values - origins).astype(np.float64)
    return np.where(values >= origins, (values - origins).astype(np.uint64), 0).astype(np.float64) - np.where(
        values < origins, (origins - values).astype(np.uint64), 0
    ).astype(np.float64)


def _shortest_half(values: np.ndarray) -> tuple[np.generic, float]:
    """Return the middle and the width of the shortest interval with most of the sorted values; 0 wide if all agree.

    Fewer than half of the values can be anything. A value of more than half of the points is no time, and left out.
    """
    half = len(values) // 2 + 1
    widths = _differences(values[half - 1 :], values[: len(values) - half + 1])
    start = int(np.argmin(widths))
    middle = values[start + half // 2]
    if not widths[start] and (remainder := values[values != middle]).size > 1:
        return _shortest_half(remainder)
    return middle, float(widths[start])


def _unit(name: str, dtype: np.dtype, spread: float) -> float | None:
    """Return the unit in seconds in which a sweep lasts nearest to 0.1 s; None if there is none."""
    if dtype.kind in "iu" and plain_name(name) in NANOSECONDS and SHORTEST_S <= 2 * spread * 1e-9 < LONGEST_S:
        return 1e-9
    return next((unit for unit in UNITS if 2 * spread * unit < LONGEST_S), None)
