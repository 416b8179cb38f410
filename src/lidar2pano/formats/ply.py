"""PLY: reads ascii and both byte orders, the scalar properties of the vertices; writes binary vertices."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.delimited_text import numbers
from lidar2pano.formats.file_contents import stem_of
from lidar2pano.formats.point_cloud import MOST_POINTS, PointCloud, cloud_of_columns

MOST_HEADER = 1 << 16
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
WRITTEN = {"float32": "float", "uint8": "uchar", "uint16": "ushort"}  # numpy's name -> PLY's
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


def decode(data: bytes, path: Path) -> PointCloud:
    """Return the vertices; InputError if header and content do not fit each other."""
    end = data.find(b"end_header", 0, MOST_HEADER)
    start = data.find(b"\n", end) + 1
    if end < 0 or start < 1:
        raise InputError(f"{path}: its PLY header has no end; the file is truncated")
    layout, elements = _header(data[:end].decode("latin-1"), path)
    skip = 0
    for name, count, properties in elements:
        if name == "vertex":
            break
        if layout == "ascii":
            raise InputError(f"{path}: has {name!r} before its vertices, which is not read; write the vertices alone")
        skip += count * _dtype(layout, name, properties, path).itemsize
    else:
        raise InputError(f"{path}: has no vertices; name a PLY of points")
    if not 0 <= count <= MOST_POINTS:
        raise InputError(f"{path}: {count} points are no single sweep (at most {MOST_POINTS}); cut it")
    dtype = _dtype(layout, name, properties, path)
    last = elements[-1][0] == "vertex"
    if layout == "ascii":
        columns = _ascii(data[start:], count, dtype, path, last)
    else:
        left = len(data) - start - skip
        if left < count * dtype.itemsize or (last and left - count * dtype.itemsize >= dtype.itemsize):
            raise InputError(
                f"{path}: its header says {count} points of {dtype.itemsize} bytes, but {max(left, 0)} bytes follow;"
                " the file is damaged or truncated"
            )
        rows = np.frombuffer(data, dtype, count, start + skip)
        columns = {key: rows[key] for key in dtype.names or ()}
    return cloud_of_columns(columns, format=f"PLY, {layout}", name=stem_of(path), source=str(path))


Element = tuple[str, int, list[tuple[str, str]]]


def _header(text: str, path: Path) -> tuple[str, list[Element]]:
    """Return the layout, and (name, count, [(property, type)]) of each element."""
    layout = ""
    elements: list[Element] = []
    try:
        for line in text.splitlines()[1:]:
            match line.split():
                case ["format", layout, *_]:
                    pass
                case ["element", name, count]:
                    elements.append((name, int(count), []))
                case ["property", type_name, *_, name]:
                    elements[-1][2].append((name, type_name))
    except (ValueError, IndexError):
        raise InputError(f"{path}: its PLY header makes no sense; write the file again") from None
    if layout not in ORDERS:
        raise InputError(f"{path}: PLY data of form {layout!r} are not read; write it as binary_little_endian")
    return layout, elements


def _dtype(layout: str, name: str, properties: list[tuple[str, str]], path: Path) -> np.dtype:
    """Return the record of one item of an element."""
    fields = {key: ORDERS[layout] + TYPES[type_name] for key, type_name in properties if type_name in TYPES}
    if len(fields) < len(properties):
        raise InputError(f"{path}: properties of {name!r} are lists or named twice; write the vertices alone")
    return np.dtype(list(fields.items()))


def _ascii(data: bytes, count: int, dtype: np.dtype, path: Path, last: bool) -> dict[str, np.ndarray]:
    names = dtype.names or ()
    if not last:  # faces follow
        data = b"\n".join(data.split(b"\n", count)[:count])
    table = numbers(data, path, len(names))
    if len(table) != count:
        raise InputError(f"{path}: its header says {count} points, but it holds {len(table)}; fetch it again")
    return {name: table[:, place].astype(dtype[name]) for place, name in enumerate(names)}


def write_ply(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write binary vertices, as Open3D, CloudCompare and MeshLab open them.

    columns  the properties, each (N,) float32, uint8 or uint16, in that order.
    """
    vertices = np.empty(
        len(next(iter(columns.values()))),
        dtype=[(name, values.dtype.newbyteorder("<")) for name, values in columns.items()],
    )
    for name, values in columns.items():
        vertices[name] = values
    properties = [f"property {WRITTEN[values.dtype.name]} {name}" for name, values in columns.items()]
    form = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    path.write_bytes("\n".join([*form, *properties, "end_header", ""]).encode() + vertices.tobytes())
