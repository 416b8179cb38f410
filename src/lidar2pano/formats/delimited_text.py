"""Points as text: CSV, TXT, XYZ, PTS; any separator, with or without a header or a line with their number."""

from __future__ import annotations

import csv
import io
import re
import warnings
from pathlib import Path

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.file_contents import MOST_BYTES, stem_of
from lidar2pano.formats.point_cloud import MOST_POINTS, PointCloud, cloud_of_columns

SEPARATORS = bytes.maketrans(b",;\t|", b"    ")
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?(nan|inf)", re.IGNORECASE)
AXES = {"points_m_xyz:0": "x", "points_m_xyz:1": "y", "points_m_xyz:2": "z"}  # VeloView
MOST_LINE = 1 << 14
LEAST = 3  # columns


def has_points(head: bytes) -> bool:
    """Return whether a file begins with text, a line of which has three numbers or the names of axes."""
    text = head.removeprefix(b"\xef\xbb\xbf")
    if not text or b"\0" in text:
        return False
    try:
        lines = text.decode("utf-8", "strict" if len(head) < 4096 else "ignore").splitlines()
    except UnicodeDecodeError:
        return False
    return any(len(_cells(line)) >= LEAST and _all_numbers(_cells(line)) for line in lines[:64]) or any(
        {"x", "y", "z"} <= {AXES.get(cell.lower(), cell.lower()) for cell in _cells(line)} for line in lines[:8]
    )


def decode(data: bytes, path: Path) -> PointCloud:
    """Return the points; InputError if lines have too few numbers, or their number is not the first line's."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    if b";" in data[:MOST_LINE] and b"," in data[:MOST_LINE] and not data[:MOST_LINE].lstrip().startswith(b"#"):
        data = data.replace(b",", b".")  # 3,14;2,72
    names, claimed, data = _preamble(data, path)
    first = _cells(data[:MOST_LINE].lstrip().split(b"\n", 1)[0].decode("utf-8", "ignore"), len(names))
    if len(first) < LEAST:
        raise InputError(f"{path}: its lines are no points (x y z ... each); name a scan")
    table = numbers(data, path, len(first))
    if claimed is not None and claimed != len(table):
        raise InputError(f"{path}: its first line says {claimed} points, but it holds {len(table)}; fetch it again")
    if names and len(names) != table.shape[1]:
        raise InputError(f"{path}: its header names {len(names)} columns, but lines have {table.shape[1]}; repair it")
    columns = dict(zip(names or column_names(table), table.T, strict=True))
    header = "with a header" if names else "count and numbers" if claimed is not None else "numbers only"
    return cloud_of_columns(columns, format=f"text, {header}", name=stem_of(path), source=str(path))


def column_names(table: np.ndarray) -> list[str]:
    """Return names for the columns of a table (N, C): x y z, intensity or colours, then "column N"."""
    names = ["x", "y", "z"]
    rest = table[:, 3:]
    with np.errstate(invalid="ignore"):
        colours = rest.shape[1] == 3 and bool(((rest >= 0) & (rest <= 255) & (rest == np.floor(rest))).all())
        rings = rest.shape[1] > 1 and bool(((rest[:, 1] >= 0) & (rest[:, 1] < 256) & (rest[:, 1] % 1 == 0)).all())
    if colours:
        return [*names, "red", "green", "blue"]
    if rest.shape[1]:
        names.append("intensity")
    if rings and np.ptp(rest[:, 1]) > 0:
        names.append("ring")
    return names + [f"column {number}" for number in range(len(names) + 1, table.shape[1] + 1)]


def numbers(data: bytes, path: Path, width: int) -> np.ndarray:
    """Return the numbers (N, width) float64 of lines of text, NaN for empty cells; InputError for other widths."""
    if len(data) > MOST_BYTES or data.count(b"\n") > MOST_POINTS:
        raise InputError(f"{path}: is too long for a single sweep (at most {MOST_POINTS} points); cut it")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # if there is no number at all
            table = np.loadtxt(io.BytesIO(data.translate(SEPARATORS)), ndmin=2, encoding="latin-1")
    except (UserWarning, ValueError):
        return _line_by_line(data, path, width)
    return table if table.shape[1] == width else _line_by_line(data, path, width)


def _line_by_line(data: bytes, path: Path, width: int) -> np.ndarray:
    """Like `numbers`, for files with comments, empty cells, text cells and to find the wrong line."""
    rows = []
    for number, line in enumerate(data.decode("utf-8", "replace").splitlines(), 1):
        cells = _cells(line, width)
        if not line.strip() or line.lstrip().startswith(("#", "//")):
            continue
        if len(cells) != width:
            raise InputError(f"{path}: point {number} has {len(cells)} values instead of {width}; it is damaged or cut")
        rows.append([float(cell) if NUMBER.fullmatch(cell) else np.nan for cell in cells])
        if len(rows) == 1 and not np.isfinite(rows[0][:LEAST]).any():
            raise InputError(f"{path}: its lines are no numbers; name a scan")
    if not rows:
        raise InputError(f"{path}: holds no points; name a scan that has some")
    return np.array(rows)


MOST_DIGITS = 19  # of a number of points


def _preamble(data: bytes, path: Path) -> tuple[list[str], int | None, bytes]:
    """Return the header's names, the number of points claimed by a line, and the rest of the file."""
    names: list[str] = []
    claimed = None
    while data:
        line, _, rest = data.partition(b"\n")
        if len(line) > MOST_LINE:
            raise InputError(f"{path}: its first line has {len(line)} characters; name a scan")
        text = line.decode("utf-8", "replace").strip()
        cells = _cells(text.lstrip("#/ "))
        if not cells or (text.startswith(("#", "//")) and not _is_header(cells)):
            data = rest
        elif claimed is None and len(cells) == 1 and cells[0].isdecimal() and len(cells[0]) < MOST_DIGITS:
            claimed, data = int(cells[0]), rest
        elif not names and _is_header(cells):
            names, data = [AXES.get(cell.lower(), cell) for cell in cells], rest
        else:
            break
    return names, claimed, data


def _is_header(cells: list[str]) -> bool:
    return {"x", "y", "z"} <= {AXES.get(cell.lower(), cell.lower().removeprefix("scalar_")) for cell in cells}


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
    return [cell.strip('"') for cell in line.split()]


def _all_numbers(cells: list[str]) -> bool:
    return all(NUMBER.fullmatch(cell) for cell in cells)
