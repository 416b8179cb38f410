"""LAS and LAZ, through laspy with lazrs (extra `formats`)."""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.file_contents import MOST_BYTES, stem_of
from lidar2pano.formats.point_cloud import MOST_POINTS, PointCloud, cloud_of_columns

BLOCK_POINTS = 1 << 16
RECORD_BYTES, EXTENDED_RECORD_BYTES = 54, 60  # of a variable length record, without its content


def decode(data: bytes, path: Path) -> PointCloud:
    """Return the points; InputError if the file is damaged, or laspy is not installed."""
    try:
        import laspy
        import lazrs  # noqa: F401 laspy takes it for LAZ
    except ModuleNotFoundError:
        raise InputError(f"{path}: needs the extra 'formats': pip install 'lidar2pano[formats]'") from None
    try:
        _check_records(data)
        with laspy.open(io.BytesIO(data), closefd=False, laz_backend=laspy.LazBackend.Lazrs) as reader:
            header = reader.header
            size = header.point_format.size
            _check(header.point_count, size, len(data) - header.offset_to_point_data, header, path)
            if header.are_points_compressed:
                _check_chunks(data, header.offset_to_point_data, size)
            with _silent_panics():  # in blocks: memory grows with decoded points
                blocks = [_columns(block) for block in reader.chunk_iterator(BLOCK_POINTS)]
        columns = {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
        if len(columns["x"]) != header.point_count:
            raise ValueError(f"{len(columns['x'])} of {header.point_count} points")
    except InputError:
        raise
    except BaseException as error:  # laspy and lazrs raise many, a panic of the latter is no Exception
        if isinstance(error, KeyboardInterrupt | SystemExit):
            raise
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: is no LAS that can be read ({reason}); it is damaged or cut off") from None
    version = f"{header.version.major}.{header.version.minor}"
    packed = "LAZ" if header.are_points_compressed else "LAS"
    columns = {name: column for name, column in columns.items() if column.ndim == 1}
    return cloud_of_columns(columns, format=f"{packed} {version}", name=stem_of(path), source=str(path))


def _columns(points: Any) -> dict[str, np.ndarray]:  # noqa: ANN401
    """Return all fields of some points, x, y and z in metres."""
    columns = {axis: np.array(getattr(points, axis), np.float64) for axis in "xyz"}
    names = [name for name in points.point_format.dimension_names if name not in {"X", "Y", "Z"}]
    return columns | {name: np.array(points[name]) for name in names}


@contextmanager
def _silent_panics() -> Iterator[None]:
    """Inside, the process's stderr goes nowhere: a panic of lazrs prints there before it becomes an exception."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        kept = os.dup(2)
    except OSError:  # it is closed
        kept = os.dup(nowhere)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _check_records(data: bytes) -> None:
    """Refuse a header counting more records before or behind the points than the file has room for.

    LAS 1.4 R15, table 3: size of the header at byte 94, offset of the points at 96, number of records at 100; since
    version 1.4 also place and number of extended records at 235. laspy would read them without end.
    """
    size, points, records = struct.unpack_from("<HII", data, 94)
    extended = struct.unpack_from("<QI", data, 235) if data[25:26] >= b"\x04" and size >= 247 else (0, 0)
    if records * RECORD_BYTES > min(points, len(data)) or extended[1] * EXTENDED_RECORD_BYTES > len(data):
        raise ValueError(f"{records} and {extended[1]} records in {len(data)} bytes")


def _check_chunks(data: bytes, start: int, size: int) -> None:
    """Refuse a table of more chunks than the file has room for: lazrs would end the process for lack of memory.

    LASzip's specification: the points begin with the table's place (-1: it is written at the file's end), the table
    with its version and the number of chunks; a chunk begins with a whole point.
    """
    (table,) = struct.unpack_from("<q", data, start)
    if table == -1:
        (table,) = struct.unpack_from("<q", data, len(data) - 8)
    if not start <= table <= len(data) - 8:
        raise ValueError("its table of chunks lies outside")
    _, chunks = struct.unpack_from("<II", data, table)
    if chunks * size > len(data):
        raise ValueError(f"{chunks} chunks in {len(data)} bytes")


def _check(points: int, size: int, left: int, header: object, path: Path) -> None:
    """Refuse a header of more points than the file or the memory holds."""
    packed = getattr(header, "are_points_compressed", False)
    if not 0 < points <= MOST_POINTS or points * size > MOST_BYTES * 2:
        raise InputError(f"{path}: {points} points of {size} bytes are no single sweep (at most {MOST_POINTS}); cut it")
    if not packed and points * size > left:
        raise InputError(f"{path}: its header says {points} points of {size} bytes, but {left} bytes follow; truncated")
