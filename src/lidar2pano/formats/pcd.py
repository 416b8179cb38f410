"""PCD, the format of PCL: ascii, binary, binary_compressed; any field types, padding, organised clouds.

Compressed data are LZF, unpacked by python-neo-lzf.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lzf
import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.delimited_text import numbers
from lidar2pano.formats.file_contents import MOST_BYTES
from lidar2pano.formats.point_cloud import MOST_POINTS, PointCloud, RowLayout, cloud_of_columns, sweep_error

MOST_HEADER = 1 << 16
EXTENSION_END = b"HEADER_EXT_END"  # of a second header, behind DATA
MOST_RATIO = 90  # of LZF: three bytes stand for 264 at most
BYTES = {"F": (2, 4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
ENTRY = re.compile(rb"(?m)^(?:VERSION|FIELDS|COLUMNS|SIZE|TYPE|WIDTH|POINTS|DATA) ")


@dataclass(frozen=True, kw_only=True)
class Header:
    """The header.

    rows    how the points follow each other; packed ones have column behind column instead.
    layout  "ascii", "binary" or "binary_compressed".
    claims  two numbers of points, if it contradicts itself.
    viewpoint  (4, 4) float64 T of the sensor, None if there is none, or the identity.
    """

    rows: RowLayout
    layout: str
    viewpoint: np.ndarray | None = None
    claims: tuple[int, ...] = ()


def decode(data: bytes, path: Path) -> PointCloud:
    """Return the points; InputError if header and content do not fit each other."""
    header, doubts = read_header(data, path), list[str]()
    if (most := max((header.rows.count, *header.claims))) > MOST_POINTS:
        raise sweep_error(path, most)
    if header.layout == "ascii":
        columns, doubts = _ascii(data, header.rows, path)
    elif header.layout == "binary":
        columns = _binary(data, header.rows, path)
    else:
        columns = _compressed(data, header.rows, path)
    if header.claims:
        count = len(next(iter(columns.values()), ()))
        if count not in header.claims:
            claims = " and ".join(map(str, header.claims))
            raise InputError(f"{path}: its header says {claims} points, but it holds {count}; write the file again")
        points, product = header.claims
        doubts += [f"its header says {points} points, but WIDTH x HEIGHT is {product}; {count} are read"]
    form = f"PCD, {header.layout}"
    return cloud_of_columns(columns, format=form, name=path, viewpoint=header.viewpoint, doubts=doubts)


def row_layout(head: bytes, path: Path) -> RowLayout | None:
    """Return how the points follow each other, by a file's beginning; None if they are packed or unsure."""
    header = read_header(head, path)
    return None if header.layout == "binary_compressed" or header.claims else header.rows


def read_header(data: bytes, path: Path) -> Header:
    """Return the header, checked against the length of the file."""
    entries: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in entries:
        end = data.find(b"\n", start, MOST_HEADER)
        if end < 0:
            raise InputError(f"{path}: its PCD header has no end (a line DATA); the file is truncated")
        words = data[start:end].decode("latin-1").split()
        start = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    try:
        return _header(entries, start, path)
    except InputError:
        raise
    except (ValueError, KeyError, IndexError, OverflowError):
        raise InputError(f"{path}: its PCD header makes no sense; write the file again") from None


def _header(entries: dict[str, list[str]], start: int, path: Path) -> Header:
    names = entries.get("FIELDS") or entries["COLUMNS"]
    sizes = [int(size) for size in _one_each(entries, "SIZE", "4", len(names), path)]
    types = [letter.upper() for letter in _one_each(entries, "TYPE", "F", len(names), path)]
    counts = [int(count) for count in _one_each(entries, "COUNT", "1", len(names), path)]
    form: list[Any] = []
    for place, (size, letter, count) in enumerate(zip(sizes, types, counts, strict=True)):
        if size not in BYTES[letter] or not 0 <= count <= MOST_HEADER:
            raise ValueError(letter)
        form.append((f"{place}", f"<{letter.lower()}{size}", *([(count,)] if count != 1 else [])))
    columns = {}
    for place, (name, count) in enumerate(zip(names, counts, strict=True)):
        if count == 1 and name != "_" and names.index(name) == place:  # of two with one name the first is read
            columns[name] = place
    width, height = (int(entries.get(name, ["0"])[0]) for name in ("WIDTH", "HEIGHT"))
    points = int(entries["POINTS"][0]) if "POINTS" in entries else width * height
    claims = (points, width * height) if width * height and points and width * height != points else ()
    points = 0 if claims else points or width * height
    layout = entries["DATA"][0].lower()
    if layout not in {"ascii", "binary", "binary_compressed"}:
        raise InputError(f"{path}: PCD data of form {layout!r} are not read; write it as binary")
    rows = RowLayout(start, np.dtype(form), columns, points, layout == "ascii")
    if min((points, *claims)) < 0 or rows.dtype.itemsize < 1:
        raise sweep_error(path, max((points, *claims)))
    return Header(rows=rows, layout=layout, viewpoint=_viewpoint(entries.get("VIEWPOINT", [])), claims=claims)


def _one_each(entries: dict[str, list[str]], line: str, usual: str, fields: int, path: Path) -> list[str]:
    """Return the words of a line of the header, one a field: without some, the last fields are the usual ones.

    The length of the data tells whether they are.
    """
    words = entries.get(line, [])
    if len(words) > fields:
        raise InputError(
            f"{path}: its header names {fields} FIELDS, but has {len(words)} in {line}; write the file again"
        )
    return words + [usual] * (fields - len(words))


def _viewpoint(words: list[str]) -> np.ndarray | None:
    """Return the sensor's pose of x y z and a quaternion w x y z; None without any."""
    try:
        x, y, z, w, i, j, k = (float(word) for word in words)
    except ValueError:
        return None
    if length := float(np.linalg.norm((w, i, j, k))):
        w, i, j, k = (value / length for value in (w, i, j, k))
    T = np.eye(4)
    T[:3, :3] += 2 * np.array(
        [[-j * j - k * k, i * j - k * w, i * k + j * w],
         [i * j + k * w, -i * i - k * k, j * k - i * w],
         [i * k - j * w, j * k + i * w, -i * i - j * j]]
    )  # fmt: skip
    T[:3, 3] = x, y, z
    return T if np.isfinite(T).all() and not np.allclose(T, np.eye(4)) else None


def _ascii(data: bytes, layout: RowLayout, path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the fields, and a doubt about values behind them."""
    text = data[layout.start :]
    if (end := text.find(EXTENSION_END, 0, MOST_HEADER)) >= 0:
        text = text[end + len(EXTENSION_END) :].lstrip()
    *starts, width = layout.starts
    values = len(text[:MOST_HEADER].lstrip().split(b"\n", 1)[0].split())
    table, _ = numbers(text, path, max(width, values))
    layout.check_lines(len(table), path)
    columns = {name: _of_type(table[:, starts[at]], layout.dtype[at]) for name, at in layout.columns.items()}
    doubt = f"its lines have {values} values for {width} of its header; those behind them are left out"
    return columns, [doubt] if values > width else []


def _of_type(values: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Return the values as the header's type, or as they are if it has no such values."""
    if dtype.kind != "f":
        limits = np.iinfo(dtype)
        with np.errstate(invalid="ignore"):
            if not bool(((values >= limits.min) & (values <= limits.max)).all()):
                return values
    return values.astype(dtype)


def _binary(data: bytes, layout: RowLayout, path: Path) -> dict[str, np.ndarray]:
    points = layout.binary_count(len(data), path)
    end = layout.start + points * layout.dtype.itemsize
    if len(data) - end >= layout.dtype.itemsize and any(memoryview(data)[end:]):
        raise InputError(f"{path}: its header says {points} points, but more follow; write the file again")
    return layout.fields(memoryview(data)[layout.start : end])


def _compressed(data: bytes, layout: RowLayout, path: Path) -> dict[str, np.ndarray]:
    start, step = layout.start, layout.dtype.itemsize
    _check_length(len(data) - start, 8, layout, path)
    packed, unpacked = (int(size) for size in np.frombuffer(data, "<u4", 2, start))
    body = data[start + 8 : start + 8 + packed]
    _check_length(len(body), packed, layout, path)
    points = layout.count or unpacked // step
    if unpacked != points * step or unpacked > min(MOST_BYTES, MOST_RATIO * packed):
        raise InputError(
            f"{path}: {points} points of {step} bytes do not unpack from {packed} bytes to {unpacked};"
            " the file is damaged"
        )
    flat = _unpacked(body, unpacked, path)
    fields: Any = layout.dtype.fields
    places = {name: fields[f"{place}"] for name, place in layout.columns.items()}
    return {name: np.frombuffer(flat, dtype, points, offset * points) for name, (dtype, offset, *_) in places.items()}


def _check_length(size: int, needed: int, layout: RowLayout, path: Path) -> None:
    if size < needed:
        raise InputError(
            f"{path}: its header says {layout.count} points, which need {needed} bytes, but {size} follow;"
            " the file is truncated"
        )


def _unpacked(packed: bytes, size: int, path: Path) -> bytes:
    """Return `size` bytes of LZF; as many packed ones are taken as they are, as some programs write them."""
    try:
        flat, reason = lzf.decompress(packed, size), "it does not have the length that it says"
    except ValueError as error:
        flat, reason = None, str(error)
    if flat is not None and len(flat) == size:
        return flat
    if len(packed) == size:
        return packed
    raise InputError(f"{path}: cannot be unpacked ({reason}); it is damaged, fetch it again")
