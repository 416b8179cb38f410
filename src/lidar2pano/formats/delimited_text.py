"""Points as text: CSV, TXT, XYZ, PTS; any separator, with or without a header or a line with their number."""

from __future__ import annotations

import csv
import io
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.file_contents import HEAD_BYTES, MOST_BYTES, stem_of
from lidar2pano.formats.point_cloud import MOST_POINTS, PointCloud, cloud_of_columns
from lidar2pano.formats.unnamed_columns import column_names

SEPARATORS = bytes.maketrans(b",;\t|", b"    ")
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?(nan|inf)", re.IGNORECASE)
# Names of axes: "X", "x_coord", "position.x", "Point:0" (Ouster Studio), "Points_m_XYZ:0" (VeloView), "xyz[0]"
PLACE = r"(?:points?|pos(?:ition)?|coordinates?|coords?|location|cartesian|scalar|xyz|m)"
AXIS = re.compile(rf"(?:{PLACE}[ _.:/-]*)*(?:([xyz])|(?<=\w)[ _.:/\[-]*([012])\]?)(?:[ _.-]*(?:{PLACE}|axis))*")
UNIT = re.compile(r"(.*\S)\s*[\[(]\s*([^\])]*?)\s*[\])]|(\w+)[ _](mm|cm|m)")  # "x [mm]", "Range (m)", "y_mm"
METRES = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "dm": 0.1, "km": 1e3, "ft": 0.3048}
SECONDS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "\u00b5s": 1e-6, "ns": 1e-9}
COMMA_NUMBER = re.compile(r"[-+]?(\d{1,3}(\.\d{3})+|\d*)(,\d+)?([eE][-+]?\d+)?")  # 3,14 and 1.234,5
CONTROL = re.compile(rb"[\x00-\x08\x0e-\x1f]")  # in no text
MINUS, HARD_SPACE, NARROW_SPACE = "\u2212".encode(), "\u00a0".encode(), "\u202f".encode()
SAMPLE_LINES = 64
MOST_UNNAMED = 9  # columns of a table without header, for it to be a scan among a folder's files
MOST_NAMED = 12  # columns in a message
MOST_LINE = 1 << 14
BLOCK_BYTES = 1 << 20  # of text, parsed at a time
LEAST = 3  # columns


class Column(NamedTuple):
    """The name of a column, x, y or z for an axis, and its unit in metres or seconds."""

    name: str
    factor: float


def column(cell: str) -> Column:
    """Return the meaning of a header's cell."""
    plain, unit = cell.strip(), ""
    if not AXIS.fullmatch(plain.lower()) and (named := UNIT.fullmatch(plain)):
        plain, unit = (named[1], named[2].lower()) if named[1] else (named[3], named[4])
    if axis := AXIS.fullmatch(plain.lower()):
        return Column(axis[1] or "xyz"[int(axis[2])], METRES.get(unit, 1.0))
    return Column(plain, SECONDS[unit]) if unit in SECONDS and "time" in plain.lower() else Column(plain, 1.0)


def has_points(head: bytes) -> bool:
    """Return whether a file begins with text, a line of which has three numbers or the names of axes."""
    lines = _sample(head)
    return any(len(cells) >= LEAST and _all_numbers(cells) for cells in lines) or any(map(_is_header, lines[:8]))


def is_table(head: bytes) -> bool:
    """Return whether a file of a folder is a table of points: its header names axes, or it has few columns and none."""
    lines = [cells for cells in _sample(head) if cells]
    if any(map(_is_header, lines[:8])):
        return True
    numeric = [cells for cells in lines if len(cells) > 1]
    return bool(numeric) and all(LEAST <= len(cells) <= MOST_UNNAMED and _all_numbers(cells) for cells in numeric)


def _sample(head: bytes) -> list[list[str]]:
    """Return the cells of the first whole lines; [] if they are no text."""
    if not head or b"\0" in head:
        return []
    lines = _plain_numbers(head).decode("utf-8", "replace").splitlines()
    lines = lines[:-1] if len(head) == HEAD_BYTES and len(lines) > 1 else lines
    return [_cells(line) for line in lines[:SAMPLE_LINES]]


def decode(data: bytes, path: Path) -> PointCloud:
    """Return the points; InputError if lines have too few numbers, or their number is not the first line's."""
    names, claimed, data = _preamble(_plain_numbers(data), path)
    first = _cells(data[:MOST_LINE].lstrip().split(b"\n", 1)[0].decode("utf-8", "ignore"), len(names))
    if not names and not any(NUMBER.fullmatch(cell) for cell in first) and len(first) >= LEAST:
        held = ", ".join(first[:MOST_NAMED]) + (" ..." if len(first) > MOST_NAMED else "")
        raise InputError(f"{path}: its header names no axes (it has {held}); call three of its columns x, y and z")
    if len(first) < LEAST:
        raise InputError(f"{path}: its lines are no points (x y z ... each); name a scan")
    table = numbers(data, path, len(first))
    if claimed is not None and claimed != len(table):
        raise InputError(f"{path}: its first line says {claimed} points, but it holds {len(table)}; fetch it again")
    if names and len(names) != table.shape[1]:
        raise InputError(f"{path}: its header names {len(names)} columns, but lines have {table.shape[1]}; repair it")
    columns: dict[str, np.ndarray] = {}
    for cell, values in zip(names or column_names(table), table.T, strict=True):
        name, factor = column(cell) if names else Column(cell, 1.0)
        columns.setdefault(name, values if factor == 1 else values * factor)
    header = "with a header" if names else "count and numbers" if claimed is not None else "numbers only"
    return cloud_of_columns(columns, format=f"text, {header}", name=stem_of(path), source=str(path))


def _plain_numbers(data: bytes) -> bytes:
    """Return text with decimal points and ASCII signs: "3,14;2,72" is "3.14;2.72", and "1.234,5" is "1234.5".

    Commas are decimal where other separators make three numbers or more of a line.
    """
    for sign, plain in ((MINUS, b"-"), (NARROW_SPACE, b""), (HARD_SPACE, b"")):
        data = data.replace(sign, plain) if sign in data[:HEAD_BYTES] else data
    lines = data[:HEAD_BYTES].decode("utf-8", "replace").splitlines()[:SAMPLE_LINES]
    rows = [cells for line in lines if len(cells := re.split(r"[;|\t ]+", line.strip(" ;|\t"))) >= LEAST]
    rows = [cells for cells in rows if all(COMMA_NUMBER.fullmatch(cell.strip('"')) for cell in cells)]
    if not any("," in cell for cells in rows for cell in cells):
        return data
    if any("." in cell for cells in rows for cell in cells):
        data = data.replace(b".", b"")
    return data.replace(b",", b".")


def numbers(data: bytes, path: Path, width: int) -> np.ndarray:
    """Return the numbers (N, width) float64 of lines of text, NaN for empty cells; InputError for other widths."""
    if b"\n" not in data:
        data = data.replace(b"\r", b"\n")
    most = data.count(b"\n") + 1
    if len(data) > MOST_BYTES or most > MOST_POINTS + 1:
        raise InputError(f"{path}: is too long for a single sweep (at most {MOST_POINTS} points); cut it")
    table, count, lines = np.empty((most, width)), 0, 0
    for block in _blocks(data, path):
        rows = _rows(block, path, width, lines)
        if not count and len(rows) and not np.isfinite(rows[0, :LEAST]).any():
            raise InputError(f"{path}: its lines are no numbers; name a scan")
        if count + len(rows) > most:
            raise InputError(f"{path}: its lines end in different ways; write them with one kind of line end")
        table[count : count + len(rows)] = rows
        count, lines = count + len(rows), lines + block.count(b"\n")
    if not count:
        raise InputError(f"{path}: holds no points; name a scan that has some")
    return table[:count]


def _blocks(data: bytes, path: Path) -> Iterator[bytes]:
    """Yield whole lines, BLOCK_BYTES or less together: what is made of them takes many times as much."""
    start = 0
    while start < len(data):
        end = len(data) if len(data) - start <= BLOCK_BYTES else data.rfind(b"\n", start, start + BLOCK_BYTES) + 1
        if not end:
            raise InputError(f"{path}: has a line of more than {BLOCK_BYTES} characters; name a scan")
        yield data[start:end]
        start = end


def _rows(block: bytes, path: Path, width: int, lines: int) -> np.ndarray:
    """Return the numbers of whole lines, `lines` of which came before in the file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # if there is no number at all
            table = np.loadtxt(io.BytesIO(block.translate(SEPARATORS)), ndmin=2, encoding="latin-1")
    except (UserWarning, ValueError):
        return _line_by_line(block, path, width, lines)
    return table if table.shape[1] == width else _line_by_line(block, path, width, lines)


def _line_by_line(block: bytes, path: Path, width: int, lines: int) -> np.ndarray:
    """Like `_rows`, for lines with comments, empty cells, text cells and to find the wrong line."""
    rows = []
    for number, line in enumerate(block.decode("utf-8", "replace").splitlines(), lines + 1):
        cells = _cells(line, width)
        if not line.strip() or line.lstrip().startswith(("#", "//")):
            continue
        if len(cells) != width:
            raise InputError(f"{path}: point {number} has {len(cells)} values instead of {width}; it is damaged or cut")
        rows.append([float(cell) if NUMBER.fullmatch(cell) else np.nan for cell in cells])
    return np.array(rows).reshape(-1, width)


MOST_DIGITS = 19  # of a number of points


def _preamble(data: bytes, path: Path) -> tuple[list[str], int | None, bytes]:
    """Return the header's names, the number of points claimed by a line, and the rest of the file."""
    names: list[str] = []
    claimed, start = None, 0
    while start < len(data):
        end = data.find(b"\n", start, start + MOST_LINE + 1)
        if end < 0 and len(data) - start > MOST_LINE:
            raise InputError(f"{path}: its first line has more than {MOST_LINE} characters; name a scan")
        end = len(data) if end < 0 else end
        line = data[start:end]
        text = line.decode("utf-8", "replace").strip()
        cells = _cells(text.lstrip("#/ "))
        if not cells or text.startswith("sep=") or (text.startswith(("#", "//")) and not _is_header(cells)):
            start = end + 1
        elif claimed is None and len(cells) == 1 and cells[0].isdecimal() and len(cells[0]) < MOST_DIGITS:
            claimed, start = int(cells[0]), end + 1
        elif not names and _is_header(cells):
            names, start = cells, end + 1
        else:
            break
    return names, claimed, data[start:]


def _is_header(cells: list[str]) -> bool:
    return {"x", "y", "z"} <= {column(cell).name for cell in cells}


def _cells(line: str, width: int = 0) -> list[str]:
    """Return a line's cells without quotes; a separator at the end adds none beyond `width`."""
    line = line.strip()
    for separator in (";", ",", "\t", "|"):
        if separator in line:
            try:
                cells = next(csv.reader([line], delimiter=separator), [])
            except csv.Error:  # a bare line end within it, or a cell of 100 kB
                return [line]
            if len(cells) > width and not cells[-1].strip():
                cells.pop()
            return [cell.strip().strip('"') for cell in cells]
    return [cell.strip('"') for cell in re.split(r"\s+(?![\[(])", line)] if line else []


def _all_numbers(cells: list[str]) -> bool:
    return all(NUMBER.fullmatch(cell) for cell in cells)
