"""Points in arrays: plain, structured or several with names; clouds of Open3D and PyVista by their attributes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.delimited_text import column_names
from lidar2pano.formats.messages import cloud_of_message, is_point_cloud2
from lidar2pano.formats.point_cloud import INTENSITY, RING, TIME, PointCloud, cloud_of_columns

POINTS = (
    "points",
    "xyz",
    "pts",
    "positions",
    "pcl",
    "pc",
    "pointcloud",
    "point_cloud",
    "cloud",
    "lidar",
    "data",
    "arr_0",
)
WIDEST, MOST_ROWS = 64, 8  # columns of an array of points, and rows of one that has a point in each column


def cloud_of(source: Any, name: str = "array") -> PointCloud:  # noqa: ANN401
    """The PointCloud of an array (N, 3..), an Open3D or PyVista cloud, or a PointCloud2 message.

    Columns of a plain array: x y z in metres, then intensity or remission, then the ring, as far as there are.
    Raises InputError for anything else.
    """
    if isinstance(source, PointCloud):
        return source
    if is_point_cloud2(source):
        return cloud_of_message(source, name)
    tensors = getattr(source, "point", None)  # open3d.t.geometry.PointCloud
    if tensors is not None and "positions" in tensors:
        arrays = {key: np.asarray(value.numpy()) for key, value in dict(tensors.items()).items()}
        return cloud_of_arrays(arrays, format="Open3D cloud", name=name, source=name)
    if hasattr(source, "points"):
        more = getattr(source, "point_data", {})  # PyVista
        arrays = {"points": np.asarray(source.points)} | {key: np.asarray(more[key]) for key in more}
        return cloud_of_arrays(arrays, format=f"{type(source).__name__}", name=name, source=name)
    try:
        array = np.asarray(source)
    except (TypeError, ValueError):
        array = np.empty(0, object)
    if array.dtype.kind not in "fiuV":
        raise InputError(f"{name}: a {type(source).__name__} is no cloud; give an array (N, 3) or a path")
    return cloud_of_arrays({"": array}, format="array", name=name, source=name)


def cloud_of_arrays(arrays: Mapping[str, np.ndarray], *, format: str, name: str, source: str) -> PointCloud:
    """The PointCloud of arrays with names.

    Points are the fields of a structured array, arrays x, y and z, or the array of three and more columns whose name is
    in POINTS, or the longest. Arrays of as many values are further fields. InputError where there are none.
    """
    columns = _columns({key: value for key, value in arrays.items() if value.dtype.kind in "fiuVb"})
    if not columns:
        held = ", ".join(f"{key or 'an array'} {value.shape} {value.dtype}" for key, value in arrays.items())
        raise InputError(f"{source}: has no array of points (N, 3 or more); it has {held or 'nothing'}")
    return cloud_of_columns(columns, format=format, name=name, source=source)


def _columns(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    for array in arrays.values():
        if array.dtype.names and {"x", "y", "z"} <= {field.lower() for field in array.dtype.names}:
            flat = array.reshape(-1)
            return {field: flat[field] for field in array.dtype.names if flat[field].ndim == 1}
    flat = {key: value.reshape(-1) for key, value in arrays.items() if not value.dtype.names}
    lower = {key.lower(): key for key in flat}
    if {"x", "y", "z"} <= lower.keys():
        count = len(flat[lower["x"]])
        return {key: value for key, value in flat.items() if len(value) == count}
    tables = {key: table for key, array in arrays.items() if (table := _table(array)) is not None}
    if not tables:
        return {}
    ranked = {key: POINTS.index(key.lower()) if key.lower() in POINTS else len(POINTS) for key in tables}
    chosen = min(tables, key=lambda key: (ranked[key], -len(tables[key])))
    table = tables[chosen]
    columns = dict(zip(column_names(table), table.T, strict=True))
    known = {*INTENSITY, *RING, *TIME}
    for key, value in flat.items():
        if key != chosen and len(value) == len(table) and key.lower().removeprefix("scalar_") in known:
            columns = {name: column for name, column in columns.items() if name != key.lower()} | {key: value}
    return columns


def _table(array: np.ndarray) -> np.ndarray | None:
    """An array as (N, columns): (N, C), (C, N) or (rows, columns, C); None where it is no table of points."""
    if array.dtype.names or array.dtype.kind == "b":
        return None
    if array.ndim == 3 and 3 <= array.shape[2] <= WIDEST:
        array = array.reshape(-1, array.shape[2])
    if array.ndim != 2:
        return None
    if array.shape[1] > WIDEST and 3 <= array.shape[0] <= MOST_ROWS:
        array = array.T
    return array if 3 <= array.shape[1] <= WIDEST else None
