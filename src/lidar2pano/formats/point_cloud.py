"""PointCloud: points as a file or a message holds them, and the names of fields."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.point_times import plain_name, point_times

MOST_POINTS = 1 << 24  # a sweep of the densest LiDAR has 0.6 million points; more are a map or a damaged header
# Names of fields, the best first; compared in lower case, without CloudCompare's "scalar_".
INTENSITY = ("reflectivity", "reflectance", "remission", "intensity", "intensities", "signal", "i")
RING = ("ring", "channel", "laser_number", "laser_id", "beam", "line", "row")
TIME = ("offset_ns", "offset_time", "time_offset", "time", "time_stamp", "timestamp", "timestamps", "t", "gps_time")
MOST_BEAMS = 1 << 16  # numbers beyond are no beams
SAMPLE = 2000  # values to tell by whether a field says anything


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
    viewpoint: np.ndarray | None = None,
    doubts: Sequence[str] = (),
) -> PointCloud:
    """Return the PointCloud whose fields are `columns`: name -> (N,) of any numeric dtype and byte order.

    Fields are found by the names above; others are only listed. Raises InputError if x, y or z is missing or there
    is no point; `source`, else the name, begins its message.
    """
    key_by_name = {plain_name(key): key for key in reversed(list(columns))}
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
    squared = np.einsum("ij,ij->i", xyz, xyz)
    valid = np.isfinite(squared) & (squared > 0)
    intensity, ring, time = (
        [(key_by_name[name], columns[key_by_name[name]]) for name in names if name in key_by_name]
        for names in (INTENSITY, RING, TIME)
    )
    time_s, start_s, unsure = point_times(time, stamp_s, valid)
    return PointCloud(
        xyz=xyz,
        intensity=_native(_telling(intensity, valid)) if intensity else None,
        ring=_integers(_telling(ring, valid)) if ring else None,
        time_s=time_s,
        stamp_s=start_s,
        frame=frame,
        format=format,
        name=name,
        fields=tuple(columns),
        viewpoint=viewpoint,
        doubts=(*doubts, *unsure),
    )


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
