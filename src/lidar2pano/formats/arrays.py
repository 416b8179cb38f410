"""Points in memory: arrays (plain, structured, named, of NPY and NPZ files), Open3D, PyVista, PointCloud2 of ROS.

Pickled objects are refused, archives are unpacked within bounds.
"""

from __future__ import annotations

import io
import math
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.field_names import FIELDS, are_numbered, find_named, has_axes, meanings, spherical
from lidar2pano.formats.file_contents import MOST_BYTES
from lidar2pano.formats.foreign_files import archive_kind
from lidar2pano.formats.point_cloud import MOST_POINTS, PointCloud, cloud_of_columns, sweep_error
from lidar2pano.formats.unnamed_columns import column_names, row_width

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
# sensor_msgs/PointField.datatype; PCL writes 9 to 11, which the message does not define
DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8", 9: "i8", 10: "u8", 11: "u1"}
AXES = ("x", "y", "z")
NUMBERED = re.compile(r"arr_\d+")  # numpy.savez's own names
MOST_MEMBERS = 1000  # arrays of an archive
UNPACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # bzip2 and lzma give out gigabytes at a time
MOST_HEADER = 1 << 16  # of an NPY: NumPy itself refuses more than 10,000 bytes
MOST_ODD = 0.1  # of the coordinates of a right byte order
SMALLEST, LARGEST = 1e-6, 1e7  # of a coordinate, in any unit: others are bytes of something else
WIDEST, MOST_ROWS = 64, 8  # columns of an array of points; rows of one with a point in each column


def cloud_of(source: Any) -> PointCloud:  # noqa: ANN401
    """Return the PointCloud of an array (N, 3..), an Open3D or PyVista cloud, or a PointCloud2 message.

    Columns of a plain array: x y z in metres, then intensity or remission, then the ring, as far as there are.
    Raises InputError for anything else.
    """
    if isinstance(source, PointCloud):
        return source
    if all(hasattr(source, name) for name in ("fields", "point_step", "width", "height", "data")):
        return cloud_of_message(source)
    tensors = getattr(source, "point", None)  # open3d.t.geometry.PointCloud
    if tensors is not None and "positions" in tensors:
        arrays = {key: np.asarray(value.numpy()) for key, value in dict(tensors.items()).items()}
        return cloud_of_arrays(arrays, format="Open3D cloud")
    if hasattr(source, "points"):
        more = getattr(source, "point_data", {})  # PyVista
        arrays = {"points": np.asarray(source.points)} | {key: np.asarray(more[key]) for key in more}
        return cloud_of_arrays(arrays, format=type(source).__name__)
    try:
        array = np.asarray(source)
    except (TypeError, ValueError):
        array = np.empty(0, object)
    if array.dtype.kind not in "fiuV":
        raise InputError(f"array: a {type(source).__name__} is no cloud; give an array (N, 3) or a path")
    return cloud_of_arrays({"": array}, format="array")


def cloud_of_message(message: Any, name: str = "message") -> PointCloud:  # noqa: ANN401
    """Return the points of a PointCloud2: any fields and offsets, both byte orders, padded rows.

    Stamp and frame are those of its header. Raises InputError if its numbers do not fit its data.
    """
    columns, doubts = message_columns(message, name)
    header = getattr(message, "header", None)
    stamp = getattr(header, "stamp", None)
    whole = getattr(stamp, "sec", getattr(stamp, "secs", None))
    parts = getattr(stamp, "nanosec", getattr(stamp, "nsec", getattr(stamp, "nsecs", 0)))
    return cloud_of_columns(
        columns,
        format="PointCloud2",
        name=name,
        frame=str(getattr(header, "frame_id", "")),
        stamp_s=None if whole is None else whole + parts * 1e-9,
        doubts=doubts,
    )


def message_columns(message: Any, name: str) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:  # noqa: ANN401
    """Return the fields of a PointCloud2, and doubts: name -> (height * width,) of its type; only those of one value.

    A field of no use that does not fit is left out with a doubt.
    """
    data = np.frombuffer(bytes(message.data) if isinstance(message.data, list) else message.data, dtype=np.uint8)
    shape, steps, doubts = _layout(message, len(data), name)
    order, unsure = _byte_order(message, data, shape, steps)
    columns = {}
    for field in message.fields:
        kind, offset = DATATYPES.get(int(field.datatype)), int(field.offset)
        if int(getattr(field, "count", 1)) > 1:
            continue
        fault = f"field {field.name!r} has a type that is none ({field.datatype})"
        if kind and 0 <= offset <= steps[1] - int(kind[1]):
            values = np.ndarray(shape, np.dtype(order + kind), data.data, offset, steps)
            columns[field.name] = values.reshape(-1)
            continue
        if kind:
            fault = f"field {field.name!r} begins at byte {offset} of points of {steps[1]} bytes"
        if field.name in AXES:
            raise InputError(f"{name}: {fault}; record it again with a driver that fills its fields rightly")
        doubts.append(f"{fault}, and is not read")
    return columns, (*doubts, *unsure)


def _byte_order(
    message: Any,  # noqa: ANN401
    data: np.ndarray,
    shape: tuple[int, int],
    steps: tuple[int, int],
) -> tuple[str, list[str]]:
    """Return the order of the bytes, "<" or ">", and doubts: that of the flag, unless only the other gives places."""
    places = [int(each.offset) for each in message.fields if each.name.lower() in AXES and int(each.datatype) == 7]
    places = [place for place in places if 0 <= place <= steps[1] - 4]
    told, other = "><" if message.is_bigendian else "<>"
    odd = {
        order: sum(_odd(np.ndarray(shape, f"{order}f4", data.data, place, steps)) for place in places)
        for order in (told, other)
    }
    if odd[told] <= MOST_ODD * len(places) or odd[other] > MOST_ODD * len(places):
        return told, []
    return other, [f"is_bigendian is {bool(message.is_bigendian)}, but only the other order gives places; it is used"]


def _odd(values: np.ndarray) -> float:
    """Return the share of coordinates of no size among the finite ones that are not 0."""
    size = np.abs(values[np.isfinite(values) & (values != 0)])
    return float(np.mean((size > LARGEST) | (size < SMALLEST))) if len(size) else 0.0


def _layout(message: Any, length: int, name: str) -> tuple[tuple[int, int], tuple[int, int], list[str]]:  # noqa: ANN401
    """Return rows and columns, the bytes from row to row and from point to point, and doubts.

    length  of the message's data, in bytes. A number that the others contradict, and that is not needed, may be wrong.
    """
    rows, width, step = int(message.height), int(message.width), int(message.point_step)
    stride = int(getattr(message, "row_step", 0))
    doubts = []
    if (
        step > 0
        and length
        and length % step == 0
        and (rows * width == 0 or (rows == 1 and stride == length < width * step and length % width))
    ):
        doubts.append(f"height x width is {rows} x {width}, but {length} bytes make {length // step} points")
        rows, width = 1, length // step
    if rows * width > MOST_POINTS:
        raise sweep_error(name, rows * width)
    if rows * width == 0:
        raise sweep_error(name, 0)
    sizes = [(int(each.offset), DATATYPES.get(int(each.datatype), "f4")) for each in message.fields]
    end = max((offset + int(kind[1]) for offset, kind in sizes), default=1)
    fits = 0 < step <= length // (rows * width) and end <= step
    whole = length // (rows * width) if length % (rows * width) == 0 and stride in (0, length // rows) else 0
    if not fits and whole != step and whole >= end:
        doubts.append(f"point_step is {step}, but {length} bytes of {rows * width} points make {whole}")
        step = whole
    packed = width * step
    stride = stride or packed
    if stride != packed and (rows == 1 or length == rows * packed or stride < packed):
        doubts.append(f"row_step is {stride}, but rows of {width} points have {packed} bytes; it is not used")
        stride = packed
    if step < 1 or (rows - 1) * stride + packed > length:
        needed = max((rows - 1) * stride + packed, 0)
        raise InputError(
            f"{name}: {rows} x {width} points of {step} bytes need {needed} bytes, but {length} follow;"
            " the message is damaged or cut, record it again"
        )
    return (rows, width), (stride, step), doubts


def cloud_of_arrays(arrays: Mapping[str, np.ndarray], *, format: str, name: str | Path = "array") -> PointCloud:
    """Return the PointCloud of arrays with names.

    Points are the fields of a structured array, arrays x, y and z, or the array of three and more columns whose name is
    in POINTS, or the longest. Arrays of as many values are further fields. InputError if there are none.
    """
    columns = _columns({key: value for key, value in arrays.items() if value.dtype.kind in "fiuVb"})
    if not columns:
        held = ", ".join(f"{key or 'an array'} {value.shape} {value.dtype}" for key, value in arrays.items())
        raise InputError(f"{name}: has no array of points (N, 3 or more); it has {held or 'nothing'}")
    return cloud_of_columns(columns, format=format, name=name)


def _columns(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    if records := next(filter(None, map(_columns_of_records, arrays.values())), None):
        return records
    if (
        len(arrays) > 1
        and all(map(NUMBERED.fullmatch, arrays))
        and (joined := _joined(list(arrays.values()))) is not None
    ):
        return dict(zip(column_names(joined), joined.T, strict=True))
    flat = {key: value.reshape(-1) for key, value in arrays.items() if not value.dtype.names}
    keys = {name.lower(): key for key, (name, _) in zip(flat, meanings(list(flat)), strict=True)}
    if {"x", "y", "z"} <= keys.keys():
        count = len(flat[keys["x"]])
        return {key: value for key, value in flat.items() if len(value) == count}
    if (polar := spherical(list(flat))) and len({len(flat[key]) for key in polar}) == 1:
        return {key: value for key, value in flat.items() if len(value) == len(flat[polar[0]])}
    tables = {key: table for key, array in arrays.items() if (table := _table(array)) is not None}
    if not tables:
        return {}
    ranked = {key: POINTS.index(key.lower()) if key.lower() in POINTS else len(POINTS) for key in tables}
    held = {key: np.count_nonzero(table[:, :3].any(1)) for key, table in tables.items()}
    chosen = min(tables, key=lambda key: (ranked[key], -held[key]))
    table = tables[chosen]
    columns = dict(zip(column_names(table), table.T, strict=True))
    further = {key: value for key, value in flat.items() if key != chosen and len(value) == len(table)}
    for names, words in FIELDS[:3]:
        for key in find_named(further, names, words):
            columns = {name: column for name, column in columns.items() if name != key.lower()} | {key: further[key]}
    return columns


def _columns_of_records(array: np.ndarray) -> dict[str, np.ndarray] | None:
    """Return the columns of a structured array of points; None for another."""
    if not array.dtype.names:
        return None
    fields = _fields(array.reshape(-1))
    if has_axes(list(fields)):
        return fields
    if not are_numbered(list(fields)) or len(fields) < len(AXES):
        return None
    table = np.column_stack(list(fields.values()))  # with NumPy's own names: f0, f1, ...
    return dict(zip(column_names(table), table.T, strict=True))


def _joined(arrays: list[np.ndarray]) -> np.ndarray | None:
    """Return arrays without names side by side, (N, C): those of most points; None for no points."""
    plain = [array for array in arrays if array.dtype.kind in "fiu" and array.ndim in (1, 2) and len(array)]
    count = max((len(array) for array in plain), default=0)
    columns = [array.reshape(count, -1) for array in plain if len(array) == count and array.size <= WIDEST * count]
    columns = sorted(columns, key=lambda table: table.shape[1] < len(AXES))  # labels behind points
    joined = np.hstack(columns) if columns else np.empty((0, 0))
    return joined if 3 <= joined.shape[1] <= WIDEST else None


def _fields(rows: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of structured rows (N,): those of a field with several values a row are numbered."""
    fields: dict[str, np.ndarray] = {}
    for name in rows.dtype.names or ():
        values = rows[name]
        if values.ndim == 1:
            fields[name] = values
        elif values.ndim == 2 and values.shape[1] <= WIDEST:
            fields |= {f"{name}[{column}]": values[:, column] for column in range(values.shape[1])}
    return fields


def _table(array: np.ndarray) -> np.ndarray | None:
    """Return an array as (N, columns): (N, C), (C, N), an image with C channels, rows in turn; None for no points."""
    if array.dtype.names or array.dtype.kind == "b":
        return None
    if array.ndim == 3 and 3 <= array.shape[0] <= MOST_ROWS < min(array.shape[1:]):  # channels of an image
        array = np.moveaxis(array, 0, 2)
    if array.ndim == 3 and 3 <= array.shape[2] <= WIDEST:
        array = array.reshape(-1, array.shape[2])
    if array.ndim == 1 and (width := row_width(array)) >= 3 and len(array) % width == 0:
        array = array.reshape(-1, width)
    if array.ndim != 2:
        return None
    if array.shape[1] > WIDEST and 3 <= array.shape[0] <= MOST_ROWS:
        array = array.T
    return array if 3 <= array.shape[1] <= WIDEST else None


def decode_npy(data: bytes, path: Path) -> PointCloud:
    """Return the points of an array; InputError if it is damaged, pickled or no array of points."""
    array = _array(io.BytesIO(data), len(data), f"{path}")
    return cloud_of_arrays({"": array}, format="NPY", name=path)


def decode_npz(data: bytes, path: Path) -> PointCloud:
    """Return the points of an archive; InputError if it is damaged, pickled or has no array of points."""
    arrays: dict[str, np.ndarray] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
            if not members:
                raise _no_arrays(archive, path)
            if len(members) > MOST_MEMBERS or sum(member.file_size for member in members) > MOST_BYTES:
                raise InputError(f"{path}: unpacks to more than {MOST_BYTES} bytes, which is no single scan; cut it")
            if any(member.compress_type not in UNPACKED for member in members):
                raise InputError(f"{path}: is packed in another way than NumPy's; write it by savez_compressed")
            for member in members:
                name = member.filename.removesuffix(".npy")
                with archive.open(member) as file:
                    try:
                        arrays[name] = _array(file, member.file_size, f"{path}: {name}")
                    except InputError as error:
                        if "pickled" not in str(error) or len(members) == 1:
                            raise
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, OSError, ValueError, KeyError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: cannot be unpacked ({error}); it is damaged or cut off, fetch it again") from error
    except Exception as error:  # zlib.error and others of its decompressors
        raise InputError(f"{path}: cannot be unpacked ({error}); it is damaged, fetch it again") from error
    return cloud_of_arrays(arrays, format="NPZ", name=path)


def _no_arrays(archive: zipfile.ZipFile, path: Path) -> InputError:
    """Return the error of a ZIP archive without arrays, by what its members tell of it."""
    names = archive.namelist()[:MOST_MEMBERS]
    if kind := archive_kind(names):
        return InputError(f"{path}: is {kind.name}; {kind.advice}")
    return InputError(
        f"{path}: is a ZIP archive without arrays (it has {', '.join(names[:3]) or 'nothing'}); unpack it"
        " (`unzip FILE`) and name a scan of it, or its folder"
    )


def _array(file: IO[bytes], length: int, source: str) -> np.ndarray:
    """Return the array of an NPY of `length` bytes, without executing or allocating more than it holds."""
    head = io.BytesIO(file.read(min(length, MOST_HEADER)))
    try:
        version = np.lib.format.read_magic(head)
        if version > (3, 0):
            raise InputError(f"{source}: is an NPY of version {version[0]}, newer than 3; write it in an older one")
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(head)
    except InputError:
        raise
    except Exception as error:  # a bad literal raises many
        raise InputError(f"{source}: is no NPY ({str(error).splitlines()[0]}); it is damaged or cut off") from None
    if dtype.hasobject:
        raise InputError(f"{source}: is pickled, which could execute anything and is not read; save plain numbers")
    count, left = math.prod(shape), length - head.tell()
    if min(shape, default=0) < 0 or count * dtype.itemsize != left:
        raise InputError(
            f"{source}: says {' x '.join(map(str, shape))} values of {dtype.itemsize} bytes, but {left} bytes follow;"
            " the file is damaged or truncated"
        )
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)
