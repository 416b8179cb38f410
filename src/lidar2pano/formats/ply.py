"""PLY: reads ascii and both byte orders, the scalar properties of the vertices; writes binary vertices."""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.delimited_text import numbers
from lidar2pano.formats.point_cloud import MOST_POINTS, PointCloud, RowLayout, cloud_of_columns, sweep_error

MOST_HEADER = 1 << 16
END = re.compile(rb"end[_ ]header")  # with a space by LSD-SLAM
MOST_LISTED = 1 << 21  # items with lists, walked one by one
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
SPLAT = {"f_dc_0", "opacity", "rot_0"}  # of a vertex, by Kerbl et al. 2023
WRITTEN = {"float32": "float", "uint8": "uchar", "uint16": "ushort"}  # numpy's name -> PLY's
OF_CARLA = "it is as CARLA writes it, whose y points to the right; it was mirrored, since ours points to the left"
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


class Property(NamedTuple):
    """A property of an element's items: NumPy type of its values, and of their number if it is a list."""

    name: str
    values: np.dtype
    count: np.dtype | None


class Element(NamedTuple):
    """An element of the header: so many items, one after the other."""

    name: str
    count: int
    properties: list[Property]

    @property
    def has_lists(self) -> bool:
        """Whether its items have different lengths."""
        return any(entry.count is not None for entry in self.properties)

    def layout(self, start: int, *, text: bool) -> RowLayout:
        """Return how items without lists follow each other from an offset on; of properties of one name the first."""
        scalars = [entry for entry in self.properties if entry.count is None]
        dtype = np.dtype([(f"{place}", entry.values) for place, entry in enumerate(scalars)])
        columns: dict[str, int] = {}
        for place, entry in enumerate(scalars):
            columns.setdefault(entry.name, place)
        return RowLayout(start, dtype, columns, self.count, text)


def decode(data: bytes, path: Path) -> PointCloud:
    """Return the vertices without their lists; InputError if header and content do not fit each other."""
    layout, elements, place, start = _whole_header(data, path)
    vertices, last, header_end = elements[place], place == len(elements) - 1, start
    if {entry.name for entry in vertices.properties} >= SPLAT:
        raise InputError(f"{path}: holds Gaussian splats, a scene learned from photographs; name a scan")
    if not 0 < vertices.count <= MOST_POINTS:
        raise sweep_error(path, vertices.count)
    if layout == "ascii":
        columns = _ascii(data[start:], elements, place, path)
    else:
        items = memoryview(b"")
        for element in elements[: place + 1]:
            first = start
            items, start = _binary(data, first, element, path)
        least = max((start - first) // vertices.count, 1)
        if last and data[start:].strip(b"\0\r\n\t ") and len(data) - start >= least:
            raise InputError(
                f"{path}: its header says {vertices.count} points, but more follow; the file is damaged or truncated"
            )
        columns = vertices.layout(0, text=False).fields(items)
    faces = sum(element.count for element in elements if element.name == "face")
    doubts = [f"it has {faces} faces: a mesh, and no scan of a LiDAR"] if faces > 0 else []
    if is_of_carla(data[:header_end], vertices):
        columns["y"], doubts = -columns["y"], [*doubts, OF_CARLA]
    return cloud_of_columns(columns, format=f"PLY, {layout}", name=path, doubts=doubts)


def is_of_carla(header: bytes, vertices: Element) -> bool:
    """Return whether a file is as CARLA writes it: float32 x y z and I, or CosAngle, ObjIdx and ObjTag."""
    names = [entry.name for entry in vertices.properties]
    return b"property float32 x" in header and names in (
        ["x", "y", "z", "I"],
        ["x", "y", "z", "CosAngle", "ObjIdx", "ObjTag"],
    )


def row_layout(head: bytes, path: Path) -> RowLayout | None:
    """Return how the vertices follow each other, by a file's beginning; None if they are not rows of one size."""
    layout, elements, place, start = _whole_header(head, path)
    *preceding, vertices = elements[: place + 1]
    rows = [element for element in preceding if element.count]
    if any(element.has_lists for element in (*rows, vertices)):
        return None
    if layout == "ascii" and (rows or elements[-1] is not vertices):
        return None
    sizes = (element.count * element.layout(0, text=False).dtype.itemsize for element in rows)
    return vertices.layout(start + sum(sizes), text=layout == "ascii")


def _whole_header(data: bytes, path: Path) -> tuple[str, list[Element], int, int]:
    """Return the layout, the elements, the place of the vertices among them, and the offset of the content."""
    match = END.search(data, 0, MOST_HEADER)
    end = match.start() if match else 0
    start = data.find(b"\n", end) + 1
    if not end or start < 1:
        raise InputError(f"{path}: its PLY header has no end (a line end_header); the file is truncated or no PLY")
    layout, elements = _header(data[:end].decode("latin-1"), path)
    place = next((place for place, element in enumerate(elements) if element.name == "vertex"), None)
    if place is None:
        raise InputError(f"{path}: has no vertices; name a PLY of points")
    if elements[place].count < 0:
        raise sweep_error(path, elements[place].count)
    return layout, elements, place, start


def _header(text: str, path: Path) -> tuple[str, list[Element]]:
    """Return the layout, and the elements; of properties with one name the first."""
    layout = ""
    elements: list[Element] = []
    try:
        for line in text.splitlines()[1:]:
            match line.split():
                case ["format", layout, *_]:
                    pass
                case ["element", name, count]:
                    elements.append(Element(name, int(count), []))
                case ["property", "list", count_type, type_name, name]:
                    elements[-1].properties.append(Property(name, _type(layout, type_name), _type(layout, count_type)))
                case ["property", type_name, name]:
                    elements[-1].properties.append(Property(name, _type(layout, type_name), None))
    except (ValueError, IndexError, KeyError):
        raise InputError(f"{path}: its PLY header makes no sense; write the file again") from None
    if layout not in ORDERS:
        raise InputError(f"{path}: PLY data of form {layout!r} are not read; write it as binary_little_endian")
    return layout, elements


def _type(layout: str, name: str) -> np.dtype:
    return np.dtype(ORDERS.get(layout, "<") + TYPES[name])


def _binary(data: bytes, start: int, element: Element, path: Path) -> tuple[memoryview, int]:
    """Return the items of an element, which begin at `start`, without their lists, and the place where they end."""
    end = start + element.count * element.layout(0, text=False).dtype.itemsize
    items = memoryview(data)[start:end]
    if element.has_lists:
        items, end = _walk(data, start, element, path)
    if not start <= end <= len(data):
        raise InputError(
            f"{path}: its header says {element.count} items of {element.name!r}, which need {end - start} bytes,"
            f" but {len(data) - start} follow; the file is damaged or truncated"
        )
    return items, end


def _walk(data: bytes, start: int, element: Element, path: Path) -> tuple[memoryview, int]:
    """Like `_binary`, one item after the other."""
    if element.count > MOST_LISTED:
        raise InputError(f"{path}: {element.count} items with lists are no single sweep; write the vertices alone")
    steps = [(entry.values.itemsize, entry.count) for entry in element.properties]
    items, place = bytearray(), start
    try:
        for _ in range(element.count):
            for size, count in steps:
                if count is None:
                    items += data[place : place + size]
                    place += size
                else:
                    place += count.itemsize + max(int(np.frombuffer(data, count, 1, place)[0]), 0) * size
    except (ValueError, OverflowError):
        raise InputError(f"{path}: ends within {element.name!r}; the file is damaged or truncated") from None
    return memoryview(items), place


def _ascii(text: bytes, elements: list[Element], place: int, path: Path) -> dict[str, np.ndarray]:
    """Return the scalar properties of the vertices, of the lines behind the header."""
    vertices = elements[place]
    text = text[_end_of_line(text, sum(element.count for element in elements[:place])) :]
    if vertices.has_lists or place < len(elements) - 1:
        text = text[: _end_of_line(text, vertices.count)]
    if vertices.has_lists:
        text = b"\n".join(_without_lists(line, vertices, path) for line in text.splitlines())
    layout = vertices.layout(0, text=True)
    table, _ = numbers(text, path, layout.starts[-1])
    layout.check_lines(len(table), path)
    return {name: table[:, place].astype(layout.dtype[place]) for name, place in layout.columns.items()}


def _without_lists(line: bytes, vertices: Element, path: Path) -> bytes:
    """Return a vertex's line without the values of its lists."""
    words, scalars, place = line.split(), [], 0
    try:
        for entry in vertices.properties:
            if entry.count is None:
                scalars.append(words[place])
            else:
                place += max(int(float(words[place])), 0)
            place += 1
    except (IndexError, ValueError, OverflowError):
        raise InputError(f"{path}: a vertex has fewer values than its header says; it is damaged or cut") from None
    return b" ".join(scalars)


def _end_of_line(text: bytes, number: int) -> int:
    """Return the place behind line `number`, from 1; the end of the text if it has fewer lines."""
    ends = (match.end() for match in re.finditer(b"\n", text))
    return next(islice(ends, min(number - 1, len(text)), None), len(text)) if number > 0 else 0


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
