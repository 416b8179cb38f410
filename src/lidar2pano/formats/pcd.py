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
from lidar2pano.formats.file_contents import MOST_BYTES, stem_of
from lidar2pano.formats.point_cloud import MOST_POINTS, PointCloud, RowLayout, cloud_of_columns, sweep_error

MOST_HEADER = 1 << 16
EXTENSION_END = b"HEADER_EXT_END"  # of a second header, behind DATA
MOST_RATIO = 90  # of LZF: three bytes stand for 264 at most
BYTES = {"F": (2, 4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
ENTRY = re.compile(rb"(?m)^(?:VERSION|FIELDS|COLUMNS|SIZE|TYPE|WIDTH|POINTS|DATA) ")


@dataclass(frozen=True, kw_only=True)
class Header:
    """The header.

    fields  (name, NumPy type, values a point, offset in a point) of each field;  step: bytes of a point.
    points  their number, 0 if the header does not say;  claims: two numbers, if it contradicts itself.
    layout  "ascii", "binary" or "binary_compressed";  start: offset of the points.
    viewpoint  (4, 4) float64 T of the sensor, None if there is none, or the identity.
    """

    fields: tuple[tuple[str, np.dtype, int, int], ...]
    step: int
    points: int
    layout: str
    start: int
    viewpoint: np.ndarray | None = None
    claims: tuple[int, ...] = ()


def decode(data: bytes, path: Path) -> PointCloud:
    """Return the points; InputError if header and content do not fit each other."""
    header, doubts = read_header(data, path), list[str]()
    if (most := max((header.points, *header.claims))) > MOST_POINTS:
        raise sweep_error(path, most)
    if header.layout == "ascii":
        columns, doubts = _ascii(data, header, path)
    elif header.layout == "binary":
        columns = _binary(data, _layout_of(header), path)
    else:
        columns = _compressed(data, header, path)
    if header.claims:
        count = len(next(iter(columns.values()), ()))
        if count not in header.claims:
            claims = " and ".join(map(str, header.claims))
            raise InputError(f"{path}: its header says {claims} points, but it holds {count}; write the file again")
        points, product = header.claims
        doubts += [f"its header says {points} points, but WIDTH x HEIGHT is {product}; {count} are read"]
    return cloud_of_columns(
        columns,
        format=f"PCD, {header.layout}",
        name=stem_of(path),
        source=str(path),
        viewpoint=header.viewpoint,
        doubts=doubts,
    )


def row_layout(head: bytes, path: Path) -> RowLayout | None:
    """Return how the points follow each other, by a file's beginning; None if they are packed or unsure."""
    header = read_header(head, path)
    return None if header.layout == "binary_compressed" or header.claims else _layout_of(header)


def _layout_of(header: Header) -> RowLayout:
    form: Any = {
        "names": [f"{place}" for place in range(len(header.fields))],
        "formats": [(dtype, (count,)) if count != 1 else dtype for _, dtype, count, _ in header.fields],
        "offsets": [offset for *_, offset in header.fields],
        "itemsize": header.step,
    }
    columns = {name: place for place, (name, _, count, _) in enumerate(header.fields) if count == 1 and name != "_"}
    return RowLayout(header.start, np.dtype(form), columns, header.points, header.layout == "ascii")


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
    fields, step = [], 0
    for name, size, letter, count in zip(names, sizes, types, counts, strict=True):
        if size not in BYTES[letter] or not 0 <= count <= MOST_HEADER:
            raise ValueError(name)
        taken = any(name == other for other, *_ in fields)  # of two with one name the first is read
        fields.append(("_" if taken else name, np.dtype(f"<{letter.lower()}{size}"), count, step))
        step += size * count
    width, height = (int(entries.get(name, ["0"])[0]) for name in ("WIDTH", "HEIGHT"))
    points = int(entries["POINTS"][0]) if "POINTS" in entries else width * height
    claims = (points, width * height) if width * height and points and width * height != points else ()
    points = 0 if claims else points or width * height
    layout = entries["DATA"][0].lower()
    if layout not in {"ascii", "binary", "binary_compressed"}:
        raise InputError(f"{path}: PCD data of form {layout!r} are not read; write it as binary")
    if min((points, *claims)) < 0 or step < 1:
        raise sweep_error(path, max((points, *claims)))
    return Header(
        fields=tuple(fields),
        step=step,
        points=points,
        layout=layout,
        start=start,
        viewpoint=_viewpoint(entries.get("VIEWPOINT", [])),
        claims=claims,
    )


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


def _ascii(data: bytes, header: Header, path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the fields, and a doubt about values behind them."""
    text = data[header.start :]
    if (end := text.find(EXTENSION_END, 0, MOST_HEADER)) >= 0:
        text = text[end + len(EXTENSION_END) :].lstrip()
    width = sum(count for _, _, count, _ in header.fields)
    values = len(text[:MOST_HEADER].lstrip().split(b"\n", 1)[0].split())
    table, _ = numbers(text, path, max(width, values))
    if header.points and len(table) != header.points:
        raise InputError(f"{path}: its header says {header.points} points, but it holds {len(table)}; fetch it again")
    columns, place = {}, 0
    for name, dtype, count, _ in header.fields:
        if count == 1 and name != "_":
            columns[name] = _of_type(table[:, place], dtype)
        place += count
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


def _compressed(data: bytes, header: Header, path: Path) -> dict[str, np.ndarray]:
    _check_length(len(data) - header.start, 8, header, path)
    packed, unpacked = (int(size) for size in np.frombuffer(data, "<u4", 2, header.start))
    body = data[header.start + 8 : header.start + 8 + packed]
    _check_length(len(body), packed, header, path)
    points = header.points or unpacked // header.step
    if unpacked != points * header.step or unpacked > min(MOST_BYTES, MOST_RATIO * packed):
        raise InputError(
            f"{path}: {points} points of {header.step} bytes do not unpack from {packed} bytes to {unpacked};"
            " the file is damaged"
        )
    flat = _unpacked(body, unpacked, path)
    return {
        name: np.frombuffer(flat, dtype, points, offset * points)
        for name, dtype, count, offset in header.fields
        if count == 1 and name != "_"
    }


def _check_length(size: int, needed: int, header: Header, path: Path) -> None:
    if size < needed:
        raise InputError(
            f"{path}: its header says {header.points} points, which need {needed} bytes, but {size} follow;"
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
