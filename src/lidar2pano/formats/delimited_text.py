"""Points as text: CSV, TXT, XYZ, PTS; any separator, with or without a header or a line with their number."""

from __future__ import annotations

import csv
import io
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.field_names import (
    FIELDS,
    Column,
    are_numbered,
    column,
    find_named,
    has_axes,
    meanings,
    unit_factor,
)
from lidar2pano.formats.file_contents import HEAD_BYTES, MOST_BYTES
from lidar2pano.formats.point_cloud import MOST_POINTS, PointCloud, cloud_of_columns, sweep_error
from lidar2pano.formats.unnamed_columns import column_names

SEPARATORS = bytes.maketrans(b",;\t|()[]", b"        ")
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?(nan|inf)", re.IGNORECASE)
NOT_A_NUMBER = re.compile(
    r"[-+]?(?:1\.)?#?\w*(?:nan|inf|ind)\b", re.IGNORECASE
)  # of programs in C: -nan(ind), 1.#QNAN, 1.#INF
COMMA_NUMBER = re.compile(r"[-+]?(\d{1,3}(\.\d{3})+|\d*)(,\d+)?([eE][-+]?\d+)?")  # 3,14 and 1.234,5
QUOTED = re.compile(r'"[-+]?\d*,\d+(?:[eE][-+]?\d+)?"')
GROUPED = re.compile(r'"[-+]?\d{1,3}(?:,\d{3})+(?:\.\d+)?"')  # "1,234.5", quoted since commas separate
FORTRAN = re.compile(rb"(?<![\w.])([-+]?(?:\d+\.?\d*|\.\d+))[dD](?=[-+]?\d+(?![\w.]))")  # 1.0D+01
APOSTROPHE = re.compile(rb"(?<=\d)(?:'|\xe2\x80\x99)(?=\d{3})")  # 1'234.5
CONTROL = re.compile(rb"[\x00-\x08\x0e-\x1f]")  # in no text
REMARK = re.compile(r"^(?:#+|//)\s*")
PLAIN = {  # characters of word processors and of other keyboards -> what tables have
    **dict.fromkeys("\u201c\u201d\u201e\u201f\u00ab\u00bb\uff02", '"'), **dict.fromkeys("\u00a0\u202f", ""),
    "\u2212": "-", "\uff0d": "-", "\uff0c": ",", "\u3001": ",", "\uff1b": ";", "\uff0e": ".", "\u3000": " ",
}  # fmt: skip
# Of texts that are no UTF-8, the most particular first: nearly all bytes are some text in the last ones.
ENCODINGS = ("euc-kr", "gb18030", "shift-jis", "big5", "cp1251", "cp1252")
CLOCK_TIME = re.compile(r"\d{4}-?\d\d-?\d\d[T ]?\d\d:?\d\d:?\d\d(?:[.,]\d+)?(?:Z|[-+]\d\d:?\d\d)?")  # ISO 8601
SAMPLE_LINES = 64
MOST_UNNAMED = 9  # columns of a table without header, for it to be a scan among a folder's files
MOST_NAMED = 12  # columns in a message
MOST_LINE = 1 << 14
MOST_SHOWN = 40  # characters of a line in a message
MOST_LEFT_OUT = 100  # lines of words among those of numbers: more are another table
BLOCK_BYTES = 1 << 20  # of text, parsed at a time
LEAST = 3  # columns


def has_points(head: bytes) -> bool:
    """Return whether a file begins with text, a line of which has three numbers or the names of axes."""
    lines = _sample(head)
    return any(_are_values(cells) for cells in lines) or any(map(_is_header, lines[:8]))


def first_line(head: bytes) -> str | None:
    """Return the beginning of the first line of text; None for other bytes."""
    text = head.decode("utf-8", "replace").strip()
    shown = text.partition("\n")[0][:MOST_SHOWN].strip()
    return shown if shown and not CONTROL.search(head) and "\ufffd" not in text[:-1] else None


def is_table(head: bytes) -> bool:
    """Return whether a file of a folder is a table of points: its header names axes, or it has few columns and none."""
    lines = [cells for cells in _sample(head) if cells]
    if any({"x", "y", "z"} <= {column(cell).name for cell in cells} for cells in lines[:8]):
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
    header, claimed, data = _preamble(_plain_numbers(data), path)
    first = _cells(data[:MOST_LINE].lstrip().split(b"\n", 1)[0].decode("utf-8", "ignore"), len(header))
    no_points = InputError(f"{path}: its lines are no points (x y z ... each); name a scan")
    if len(first) < LEAST:
        raise no_points
    table, left_out = numbers(data, path, len(first))
    if claimed is not None and claimed != len(table):
        raise InputError(f"{path}: its first line says {claimed} points, but it holds {len(table)}; fetch it again")
    if len(header) == table.shape[1] - 1 and bool((np.diff(table[:, 0]) == 1).all()):
        header = [Column("index"), *header]  # R's and pandas' own numbers of rows have no name
    if header and len(header) != table.shape[1]:
        commas = ", or write its numbers with points" * (table.shape[1] == 2 * len(header))
        raise InputError(
            f"{path}: its header names {len(header)} columns, but lines have {table.shape[1]}; repair it{commas}"
        )
    columns: dict[str, np.ndarray] = {}
    if not header:
        table = table[:, np.isfinite(table).any(axis=0)]  # others are times of a clock, or words
        if table.shape[1] < LEAST:
            raise no_points
    for (name, factor), values in zip(header or map(Column, column_names(table)), table.T, strict=True):
        columns.setdefault(name, values if factor == 1 else values * factor)
    form = "with a header" if header else "count and numbers" if claimed is not None else "numbers only"
    doubts = [f"{left_out} of its lines hold no numbers, and are left out"] if left_out else []
    return cloud_of_columns(columns, format=f"text, {form}", name=path, doubts=doubts)


def _plain_numbers(data: bytes) -> bytes:
    """Return text with decimal points and ASCII signs: "3,14;2,72" is "3.14;2.72", and "1.234,5" is "1234.5".

    Exponents of Fortran ("1.0D+01") become those of C, and marks of thousands go.

    Commas are decimal where other separators make three numbers or more of a line, and within quotes.
    """
    if b"\n" not in data[:HEAD_BYTES]:
        data = data.replace(b"\r", b"\n")
    head = data[:HEAD_BYTES]
    for sign, plain in PLAIN.items() if not head.isascii() else ():
        data = data.replace(sign.encode(), plain.encode()) if sign.encode() in head else data
    head = data[:HEAD_BYTES]
    data = FORTRAN.sub(rb"\1e", data) if FORTRAN.search(head) else data
    data = APOSTROPHE.sub(b"", data) if APOSTROPHE.search(head) else data
    lines = data[:HEAD_BYTES].decode("utf-8", "replace").splitlines()[:SAMPLE_LINES]
    if any(GROUPED.search(line) and "." in line for line in lines):
        return re.sub(rb'"[^"\n]*"', lambda cell: cell[0].replace(b",", b"").strip(b'"'), data)
    if sum(bool(QUOTED.search(line)) for line in lines) > len(lines) // 2:
        return re.sub(rb'"([-+]?\d*),(\d+(?:[eE][-+]?\d+)?)"', rb"\1.\2", data)
    rows = [cells for line in lines if len(cells := re.split(r"[;|\t ]+", line.strip(" ;|\t"))) >= LEAST]
    rows = [cells for cells in rows if all(COMMA_NUMBER.fullmatch(cell.strip('"')) for cell in cells)]
    if not any("," in cell for cells in rows for cell in cells):
        return data
    if any("." in cell for cells in rows for cell in cells):
        data = data.replace(b".", b"")
    return data.replace(b",", b".")


class Table(NamedTuple):
    """The numbers (N, C) float64 of lines of text, and how many lines among them hold none."""

    values: np.ndarray
    left_out: int


def numbers(data: bytes, path: Path, width: int) -> Table:
    """Return the numbers of lines of text, NaN for empty cells; InputError for lines of other widths.

    A few lines of words (a remark, a second header, a sum at the end) are left out.
    """
    data = _plain_numbers(data) if width else b""  # a header may name no columns
    most = data.count(b"\n") + 1
    if len(data) > MOST_BYTES or most > MOST_POINTS + 1:
        raise InputError(f"{path}: is too long for a single sweep (at most {MOST_POINTS} points); cut it")
    table, count, left_out = np.empty((most, width)), 0, 0
    for rows, odd in tables(io.BytesIO(data), path, width):
        left_out += odd
        if count + len(rows) > most:
            raise InputError(f"{path}: its lines end in different ways; write them with one kind of line end")
        table[count : count + len(rows)] = rows
        count += len(rows)
    if not count:
        raise sweep_error(path, 0)
    return Table(table[:count], left_out)


def tables(file: BinaryIO, path: Path, width: int) -> Iterator[Table]:
    """Yield the numbers of the lines of a file from where it stands, BLOCK_BYTES of text at a time; like `numbers`."""
    lines, left_out, begun = 0, 0, False
    for block in _blocks(file, path):
        table = _rows(block, path, width, lines)
        left_out += table.left_out
        rows = table.values
        if (not begun and len(rows) and not np.isfinite(rows[:, :LEAST]).any()) or left_out > MOST_LEFT_OUT:
            raise InputError(f"{path}: its lines are no numbers; name a scan")
        yield table
        lines, begun = lines + block.count(b"\n"), begun or len(rows) > 0


def _blocks(file: BinaryIO, path: Path) -> Iterator[bytes]:
    """Yield whole lines, BLOCK_BYTES or less together: what is made of them takes many times as much."""
    rest = b""
    while data := rest + file.read(BLOCK_BYTES - len(rest)):
        end = len(data) if len(data) < BLOCK_BYTES else data.rfind(b"\n") + 1
        if not end:
            raise InputError(f"{path}: has a line of more than {BLOCK_BYTES} characters; name a scan")
        yield data[:end]
        rest = data[end:]


def _rows(block: bytes, path: Path, width: int, lines: int) -> Table:
    """Return the numbers of whole lines, `lines` of which came before in the file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # if there is no number at all
            table = np.loadtxt(io.BytesIO(block.translate(SEPARATORS)), ndmin=2, encoding="latin-1")
    except (UserWarning, ValueError):
        return _line_by_line(block, path, width, lines)
    return Table(table, 0) if table.shape[1] == width else _line_by_line(block, path, width, lines)


def _line_by_line(block: bytes, path: Path, width: int, lines: int) -> Table:
    """Like `_rows`, for lines with comments, empty cells, text cells and to find the wrong line."""
    rows: list[list[float]] = []
    left_out = 0
    for number, line in enumerate(block.decode("utf-8", "replace").splitlines(), lines + 1):
        cells = _cells(line, width)
        if not line.strip() or line.lstrip().startswith(("#", "//")):
            continue
        values = [float(cell) if NUMBER.fullmatch(cell) else np.nan for cell in cells]
        if len(cells) == width and np.isfinite(values[:LEAST]).all():
            rows.append(values)
            continue
        words = any(letter.isalpha() for cell in cells if not _is_number(cell) for letter in cell)
        if len(cells) != width and not words:
            raise InputError(f"{path}: point {number} has {len(cells)} values instead of {width}; it is damaged or cut")
        if len(cells) == width and (not words or _numeric(cells) >= LEAST):
            rows.append(values)
            continue
        left_out += 1
        if left_out > MOST_LEFT_OUT:
            break
    return Table(np.array(rows).reshape(-1, width), left_out)


MOST_DIGITS = 19  # of a number of points


def _preamble(data: bytes, path: Path) -> tuple[list[Column], int | None, bytes]:
    """Return the header's columns, the number of points claimed by a line, and the rest of the file.

    Lines of words before the header are passed over, and a line of units behind it is read.
    """
    header: list[Column] = []
    words: list[str] = []  # of the first line that is neither header nor numbers
    claimed, start = None, 0
    for _ in range(SAMPLE_LINES):
        end = data.find(b"\n", start, start + MOST_LINE + 1)
        if end < 0 and len(data) - start > MOST_LINE:
            raise InputError(f"{path}: its first line has more than {MOST_LINE} characters; name a scan")
        end = len(data) if end < 0 else end
        text = _text(data[start:end])
        cells = _cells(REMARK.sub("", text))
        remark = text.startswith(("#", "//", "sep="))
        if claimed is None and len(cells) == 1 and cells[0].isdecimal() and len(cells[0]) < MOST_DIGITS:
            claimed = int(cells[0])
        elif not header and (_is_header(cells) or _is_numbered(cells)):
            header = meanings(cells) if has_axes(cells) else []
            words = []
        elif header and len(cells) == len(header) and not any(map(NUMBER.fullmatch, cells)) and any(cells):
            header = [_in_unit(column, cell) for column, cell in zip(header, cells, strict=True)]
        elif not remark and (_numeric(cells) >= LEAST or (header and len(cells) == len(header))):
            break
        elif cells and not remark:
            words = words or cells
        if end == len(data):
            break
        start = end + 1
    if len(words) >= LEAST and not header:
        held = ", ".join(words[:MOST_NAMED]) + (" ..." if len(words) > MOST_NAMED else "")
        raise InputError(f"{path}: its header names no axes (it has {held}); call three of its columns x, y and z")
    return header, claimed, data[start:]


def _text(line: bytes) -> str:
    """Return a line of any encoding: of those in which it is text, the first in which it names a remission or so."""
    texts: list[str] = []
    accents = not re.search(rb"[\x80-\xff]{2}", line)  # letters of the West stand alone, others side by side
    for encoding in ("utf-8", *(ENCODINGS[::-1] if accents else ENCODINGS)):
        try:
            texts.append(line.decode(encoding).strip())
        except UnicodeDecodeError:
            continue
        if encoding == "utf-8" or any(find_named(_cells(texts[-1]), (), words) for _, words in FIELDS[:3]):
            return texts[-1]
    return texts[-1] if texts else line.decode("latin-1").strip()


def _in_unit(column: Column, cell: str) -> Column:
    """Return the column in the unit of a cell below its name."""
    return column._replace(factor=unit_factor(column.name, cell.strip("[]() "), column.factor))


def _is_header(cells: list[str]) -> bool:
    return not any(map(NUMBER.fullmatch, cells)) and has_axes(cells)


def _is_number(cell: str) -> bool:
    return bool(NUMBER.fullmatch(cell) or NOT_A_NUMBER.match(cell))


def _numeric(cells: list[str]) -> int:
    return sum(map(_is_number, cells))


def _is_numbered(cells: list[str]) -> bool:
    return len(cells) >= LEAST and not any(map(NUMBER.fullmatch, cells)) and are_numbered(cells)


def _cells(line: str, width: int = 0) -> list[str]:
    """Return a line's cells without quotes; a separator at the end adds none beyond `width`."""
    line = line.strip()
    if line.startswith(("(", "[")):  # a tuple or list of Python
        line = line.lstrip("([ ").rstrip(")], ")
    if "\t\t" not in line and _all_numbers(words := line.split()):  # spaces and tabs alike
        return words
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


def _are_values(cells: list[str]) -> bool:
    """Return whether cells are numbers, three or more, and times of a clock."""
    values = [cell for cell in cells if not CLOCK_TIME.fullmatch(cell)]
    return len(values) >= LEAST and _all_numbers(values)


def _all_numbers(cells: list[str]) -> bool:
    return all(NUMBER.fullmatch(cell) for cell in cells)
