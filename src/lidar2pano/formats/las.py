"""LAS and LAZ, through laspy with lazrs (extra `formats`)."""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from lidar2pano.errors import InputError, require_extra
from lidar2pano.formats.file_contents import MOST_BYTES
from lidar2pano.formats.point_cloud import BLOCK_POINTS, MOST_POINTS, PointCloud, cloud_of_columns, sweep_error

HEADER_BYTES, LAZ_FLAG = 247, 104  # of version 1.4; the byte of the point format, whose highest bit says "packed"
RECORD_BYTES, EXTENDED_RECORD_BYTES = 54, 60  # of a variable length record, without its content


def decode(data: bytes, path: Path) -> PointCloud:
    """Return the points; InputError if the file is damaged, or laspy is not installed."""
    blocks = list(blocks_of(io.BytesIO(data), len(data), path, sweep=True))  # memory grows with decoded points
    columns = {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
    form = ("LAZ" if data[LAZ_FLAG] & 0x80 else "LAS") + f" {data[24]}.{data[25]}"
    return cloud_of_columns(columns, format=form, name=path)


def blocks_of(file: BinaryIO, length: int, path: Path, *, sweep: bool = False) -> Iterator[dict[str, np.ndarray]]:
    """Yield the fields of BLOCK_POINTS points at a time, x, y and z in metres; of a file of so many bytes.

    Raises InputError if the file is damaged, or laspy is not installed, or a `sweep` has more points than one has.
    """
    with require_extra("formats", f"{path}:"):
        import laspy
        import lazrs  # noqa: F401 laspy takes it for LAZ
    count = 0
    try:
        _check_records(file, length)
        with laspy.open(file, closefd=False, laz_backend=laspy.LazBackend.Lazrs) as reader:
            header = reader.header
            _check(header, file, length, path, sweep)
            points = reader.chunk_iterator(BLOCK_POINTS)
            while True:
                with _silent_panics():
                    columns = None if (block := next(points, None)) is None else _columns(block)
                if columns is None:
                    break
                count += len(columns["x"])
                yield columns
        if count != header.point_count:
            raise ValueError(f"{count} of {header.point_count} points")
    except InputError:
        raise
    except BaseException as error:  # laspy and lazrs raise many, a panic of the latter is no Exception
        if isinstance(error, KeyboardInterrupt | SystemExit | GeneratorExit):
            raise
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: is no LAS that can be read ({reason}); it is damaged or cut off") from None


def _columns(points: Any) -> dict[str, np.ndarray]:  # noqa: ANN401
    """Return all fields of some points with one value each, x, y and z in metres."""
    columns = {axis: np.array(getattr(points, axis), np.float64) for axis in "xyz"}
    names = [name for name in points.point_format.dimension_names if name not in {"X", "Y", "Z"}]
    columns |= {name: np.array(points[name]) for name in names}
    return {name: column for name, column in columns.items() if column.ndim == 1}


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


def _bytes_at(file: BinaryIO, start: int, size: int) -> bytes:
    file.seek(start)
    return file.read(size)


def _check_records(file: BinaryIO, length: int) -> None:
    """Refuse a header counting more records before or behind the points than the file has room for.

    LAS 1.4 R15, table 3: size of the header at byte 94, offset of the points at 96, number of records at 100; since
    version 1.4 also place and number of extended records at 235. laspy would read them without end.
    """
    head = _bytes_at(file, 0, HEADER_BYTES)
    size, points, records = struct.unpack_from("<HII", head, 94)
    extended = struct.unpack_from("<QI", head, 235) if head[25:26] >= b"\x04" and size >= HEADER_BYTES else (0, 0)
    if records * RECORD_BYTES > min(points, length) or extended[1] * EXTENDED_RECORD_BYTES > length:
        raise ValueError(f"{records} and {extended[1]} records in {length} bytes")
    file.seek(0)


def _check_chunks(file: BinaryIO, length: int, start: int, size: int) -> None:
    """Refuse a table of more chunks than the file has room for: lazrs would end the process for lack of memory.

    LASzip's specification: the points begin with the table's place (-1: it is written at the file's end), the table
    with its version and the number of chunks; a chunk begins with a whole point.
    """
    place = file.tell()
    (table,) = struct.unpack("<q", _bytes_at(file, start, 8))
    if table == -1:
        (table,) = struct.unpack("<q", _bytes_at(file, length - 8, 8))
    if not start <= table <= length - 8:
        raise ValueError("its table of chunks lies outside")
    _, chunks = struct.unpack("<II", _bytes_at(file, table, 8))
    if chunks * size > length:
        raise ValueError(f"{chunks} chunks in {length} bytes")
    file.seek(place)


def _check(header: Any, file: BinaryIO, length: int, path: Path, sweep: bool) -> None:  # noqa: ANN401
    """Refuse a header of more points than the file has room for, or a sweep."""
    points, size, start = header.point_count, header.point_format.size, header.offset_to_point_data
    if points < 1:
        raise sweep_error(path, 0)
    if sweep and (points > MOST_POINTS or points * size > MOST_BYTES * 2):
        raise InputError(f"{path}: {points} points of {size} bytes are no single sweep (at most {MOST_POINTS}); cut it")
    if header.are_points_compressed:
        _check_chunks(file, length, start, size)
    elif points * size > length - start:
        left = length - start
        raise InputError(f"{path}: its header says {points} points of {size} bytes, but {left} bytes follow; truncated")
