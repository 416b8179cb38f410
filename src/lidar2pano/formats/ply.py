"""PLY: reads ascii and both byte orders, the scalar properties of the vertices; writes binary vertices."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.delimited_text import BLOCK_BYTES, numbers
from lidar2pano.formats.file_contents import stem_of
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

    def runs(self) -> list[list[Property]]:
        """Return the properties in runs: each but the last one ends with a list."""
        runs: list[list[Property]] = [[]]
        for entry in self.properties:
            runs[-1].append(entry)
            if entry.count is not None:
                runs.append([])
        return runs


def decode(data: bytes, path: Path) -> PointCloud:
    """Return the vertices without their lists; InputError if header and content do not fit each other."""
    layout, elements, place, start = _whole_header(data, path)
    vertices, last = elements[place], place == len(elements) - 1
    if {entry.name for entry in vertices.properties} >= SPLAT:
        raise InputError(f"{path}: holds Gaussian splats, a scene learned from photographs; name a scan")
    if not 0 < vertices.count <= MOST_POINTS:
        raise sweep_error(path, vertices.count)
    if layout == "ascii":
        body = data[start:]
        if skipped := sum(element.count for element in elements[:place]):
            body = body.split(b"\n", skipped)[-1]
        columns = _ascii(body, vertices, path, last)
    else:
        for element in elements[:place]:
            start = _binary(data, start, element, path)[1]
        columns, end = _binary(data, start, vertices, path)
        if (
            last
            and data[end:].strip(b"\0\r\n\t ")
            and len(data) - end >= max((end - start) // max(vertices.count, 1), 1)
        ):
            raise InputError(
                f"{path}: its header says {vertices.count} points, but more follow; the file is damaged or truncated"
            )
    faces = sum(element.count for element in elements if element.name == "face")
    doubts = [f"it has {faces} faces: a mesh, and no scan of a LiDAR"] if faces > 0 else []
    if is_of_carla(data[:start], vertices):
        columns["y"], doubts = -columns["y"], [*doubts, OF_CARLA]
    return cloud_of_columns(columns, format=f"PLY, {layout}", name=stem_of(path), source=str(path), doubts=doubts)


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
    if len(vertices.runs()) > 1 or any(len(element.runs()) > 1 for element in rows):
        return None
    if layout == "ascii" and (rows or elements[-1] is not vertices):
        return None
    sizes = (element.count * sum(entry.values.itemsize for entry in element.properties) for element in rows)
    columns = {entry.name: place for place, entry in reversed(list(enumerate(vertices.properties)))}
    dtype = np.dtype([(f"{place}", entry.values) for place, entry in enumerate(vertices.properties)])
    return RowLayout(start + sum(sizes), dtype, columns, vertices.count, layout == "ascii")


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


def _binary(data: bytes, start: int, element: Element, path: Path) -> tuple[dict[str, np.ndarray], int]:
    """Return the scalar properties of an element whose items begin at `start`, and the end of its items."""
    runs = element.runs()
    places, end = _places(data, start, element, runs, path)
    if not start <= end <= len(data):
        raise InputError(
            f"{path}: its header says {element.count} items of {element.name!r}, which need {end - start} bytes,"
            f" but {len(data) - start} follow; the file is damaged or truncated"
        )
    content = np.frombuffer(data, np.uint8)
    columns: dict[str, np.ndarray] = {}
    for place, run in zip(places, runs, strict=True):
        offset = 0
        for entry in run:
            if entry.count is None:
                size = entry.values.itemsize
                if isinstance(place, range):
                    values = np.ndarray((element.count,), entry.values, data, place.start + offset, (place.step,))
                else:
                    values = content[place[:, None] + (offset + np.arange(size))].view(entry.values)[:, 0]
                columns.setdefault(entry.name, values)
                offset += size
    return columns, end


def _places(
    data: bytes, start: int, element: Element, runs: list[list[Property]], path: Path
) -> tuple[list[range | np.ndarray], int]:
    """Return where each run of properties begins in each item, and the end of the items."""
    sizes = [sum(entry.values.itemsize for entry in run if entry.count is None) for run in runs]
    if len(runs) == 1:
        end = start + element.count * sizes[0]
        return [range(start, max(end, start + 1), max(sizes[0], 1))], end
    if not 0 <= element.count <= MOST_LISTED:
        raise InputError(f"{path}: {element.count} items with lists are no single sweep; write the vertices alone")
    places = np.empty((len(runs), element.count), np.int64)
    lists = [run[-1] for run in runs[:-1]]
    place = start
    for item in range(element.count):
        for number, listed in enumerate(lists):
            places[number, item] = place
            place += sizes[number]
            if listed.count is None or place + listed.count.itemsize > len(data):
                raise InputError(f"{path}: ends within {element.name!r} {item}; the file is damaged or truncated")
            count = int(np.frombuffer(data, listed.count, 1, place)[0])
            place += listed.count.itemsize + max(count, 0) * listed.values.itemsize
        places[-1, item] = place
        place += sizes[-1]
    return list(places), place


def _ascii(data: bytes, vertices: Element, path: Path, last: bool) -> dict[str, np.ndarray]:
    if len(vertices.runs()) > 1:
        data = b"\n".join(_without_lists(line, vertices, path) for line in data.splitlines()[: vertices.count])
    elif not last:  # faces follow
        data = data[: _end_of_line(data, vertices.count)]
    scalars = [entry for entry in vertices.properties if entry.count is None]
    table, _ = numbers(data, path, len(scalars))
    if len(table) != vertices.count:
        raise InputError(f"{path}: its header says {vertices.count} points, but it holds {len(table)}; fetch it again")
    columns: dict[str, np.ndarray] = {}
    for place, entry in enumerate(scalars):
        columns.setdefault(entry.name, table[:, place].astype(entry.values))
    return columns


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


def _end_of_line(data: bytes, number: int) -> int:
    """Return the place of the end of line `number`, from 1; the end of the data if they have fewer lines."""
    for start in range(0, len(data), BLOCK_BYTES):
        ends = np.flatnonzero(np.frombuffer(data, np.uint8, min(BLOCK_BYTES, len(data) - start), start) == ord("\n"))
        if number <= len(ends):
            return start + int(ends[number - 1]) if number else 0
        number -= len(ends)
    return len(data)


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
