"""PointCloud: points as a file or a message holds them, and the names of fields."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lidar2pano.errors import InputError

MOST_POINTS = 1 << 24  # a sweep of the densest LiDAR has 0.6 million points; more are a map or a damaged header
# Names of fields, the best first; compared in lower case, without CloudCompare's "scalar_".
INTENSITY = ("reflectivity", "reflectance", "remission", "intensity", "intensities", "signal", "i")
RING = ("ring", "channel", "laser_number", "laser_id", "beam", "line", "row")
TIME = ("offset_ns", "offset_time", "time_offset", "time", "time_stamp", "timestamp", "timestamps", "t", "gps_time")
NANOSECONDS = ("offset_ns", "offset_time", "t", "time_stamp")  # if stored as integers, by convention
EPOCH_S = 1e8  # times beyond this, in seconds, count from an epoch and not from the start of the sweep


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointCloud:
    """Points as a file or message holds them, nothing decided yet; arrays may be views of it, not to be written to.

    xyz        (N, 3) float32 or float64, in the file's own axes and unit.
    intensity  (N,) as stored (any numeric dtype), or None.
    ring       (N,) integer beam number, or None.
    time_s     (N,) float64 seconds relative to `stamp_s`, or None.
    label      (N,) int64 ids of SEMANTIC_KITTI, or None.
    stamp_s    seconds since the epoch or since the recording's own, or None.
    frame      name of the coordinate frame, "" if the file has none.
    format     for people, e.g. "PCD, binary_compressed".
    name       stem of the file, for messages and output names.
    fields     names of all fields of the file, in its order.
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

    def __len__(self) -> int:
        """Number of points, unusable ones included."""
        return len(self.xyz)


def cloud_of_columns(
    columns: Mapping[str, np.ndarray],
    *,
    format: str,
    name: str,
    source: str = "",
    frame: str = "",
    stamp_s: float | None = None,
) -> PointCloud:
    """Return the PointCloud whose fields are `columns`: name -> (N,) of any numeric dtype and byte order.

    Fields are found by the names above; others are only listed. Raises InputError if x, y or z is missing or there
    is no point; `source`, else the name, begins its message.
    """
    key_by_name = {_plain(key): key for key in reversed(list(columns))}
    if missing := [axis for axis in "xyz" if axis not in key_by_name]:
        held = ", ".join(columns) or "none"
        raise InputError(f"{source or name}: has no field {missing[0]!r} (it has {held}); name a scan with x, y and z")
    axes = [columns[key_by_name[axis]] for axis in "xyz"]
    if not 0 < len(axes[0]) <= MOST_POINTS:
        raise InputError(
            f"{source or name}: {len(axes[0])} points are no single sweep (1 to {MOST_POINTS}); name a scan"
        )
    exact = any(axis.dtype.itemsize > 4 or (axis.dtype.kind in "iu" and axis.dtype.itemsize > 2) for axis in axes)
    dtype = np.float64 if exact else np.float32
    if (together := _side_by_side(axes)) is not None:
        xyz = together.astype(dtype, copy=False)
    else:
        xyz = np.empty((len(axes[0]), 3), dtype)
        for column, axis in enumerate(axes):
            xyz[:, column] = axis
    intensity, ring, time = (_first(columns, key_by_name, names) for names in (INTENSITY, RING, TIME))
    time_s, start_s = seconds(*time, stamp_s) if time else (None, stamp_s)
    return PointCloud(
        xyz=xyz,
        intensity=_native(intensity[1]) if intensity else None,
        ring=ring[1].astype(np.int64) if ring else None,
        time_s=time_s,
        stamp_s=start_s,
        frame=frame,
        format=format,
        name=name,
        fields=tuple(columns),
    )


def seconds(name: str, values: np.ndarray, stamp_s: float | None) -> tuple[np.ndarray | None, float | None]:
    """Return times of points in seconds relative to a stamp, and the stamp; (None, stamp_s) if they are no times.

    A sweep in the unit lasts nearest to 0.1 s, or nanoseconds for integer fields of NANOSECONDS.
    Times since an epoch become relative to `stamp_s`, or to the first one if there is none.
    """
    finite = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    if not len(finite) or finite.min() == finite.max():
        return None, stamp_s
    low, high = finite.min().item(), finite.max().item()
    unit = next((unit for unit in (1.0, 1e-3, 1e-6) if (high - low) * unit < 3.2), 1e-9)
    if values.dtype.kind in "iu" and _plain(name) in NANOSECONDS:
        unit = 1e-9
    if low * unit < EPOCH_S:
        return values.astype(np.float64) * unit, stamp_s
    first_s = low * unit
    time_s = (values - values.dtype.type(low)).astype(np.float64) * unit
    if stamp_s is None or abs(first_s - stamp_s) > 60:
        return time_s, first_s
    return time_s + (first_s - stamp_s), stamp_s


def _side_by_side(axes: list[np.ndarray]) -> np.ndarray | None:
    """Return three columns as one array (N, 3), a view, if they lie side by side in each record."""
    first, *further = axes
    size = first.dtype.itemsize
    start = first.__array_interface__["data"][0]
    for place, axis in enumerate(further, 1):
        if (axis.dtype, axis.strides) != (first.dtype, first.strides):
            return None
        if axis.__array_interface__["data"][0] != start + place * size:
            return None
    return np.lib.stride_tricks.as_strided(first, (len(first), 3), (first.strides[0], size), writeable=False)


def _plain(name: str) -> str:
    return name.strip().lower().removeprefix("scalar_").strip()


def _first(
    columns: Mapping[str, np.ndarray], key_by_name: Mapping[str, str], names: tuple[str, ...]
) -> tuple[str, np.ndarray] | None:
    return next(((key_by_name[name], columns[key_by_name[name]]) for name in names if name in key_by_name), None)


def _native(values: np.ndarray) -> np.ndarray:
    """Return the values in the machine's byte order."""
    return values.astype(values.dtype.newbyteorder("="), copy=False)
