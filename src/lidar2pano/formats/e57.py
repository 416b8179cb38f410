"""E57 (ASTM E2807), through pye57 (extra `formats`, where it installs)."""

from __future__ import annotations

import io
import re
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from lidar2pano.bounded_files import name_of_open, open_regular
from lidar2pano.errors import InputError
from lidar2pano.formats.point_cloud import BLOCK_POINTS, MOST_POINTS, PointCloud, cloud_of_columns, sweep_error

MAGIC = b"ASTM-E57"
HEADER = struct.Struct("<QQ")  # at XML_PLACE: the XML's offset in the file, its length without checksums
MOST_XML_BYTES = 1 << 26
XML_PLACE, PAGE_BYTES, CHECKED_BYTES = 24, 1024, 1020  # a page ends with a checksum of the bytes before
# libE57's parser fetches documents, from the network, too: of a document type, and of a schema's location.
DECLARATION = re.compile(
    rb"""\s*<\?xml\s+version=["']1\.[01]["'](\s+encoding=["'](?i:utf-8)["'])?(\s+standalone=["']\w+["'])?\s*\?>"""
)
FETCHING = re.compile(rb"<!DOCTYPE|schemaLocation", re.IGNORECASE)
FORMS = ("cartesian", "spherical")
EXPORT = "export its points as PCD, PLY or LAS, e.g. with CloudCompare"
CARTESIAN, SPHERICAL = ("cartesianX", "cartesianY", "cartesianZ"), ("Range", "Azimuth", "Elevation")
INVALID = ("cartesianInvalidState", "sphericalInvalidState")  # above 0: no place


def decode(data: bytes, path: Path) -> PointCloud:
    """Return the points of the first scan, in the scanner's own frame.

    Raises InputError if the file is damaged, or pye57 is not installed.
    """
    _check_xml(io.BytesIO(data), path)
    with _library(path) as pye57, tempfile.NamedTemporaryFile(suffix=".e57") as copy:  # it reads files by name alone
        copy.write(data)
        copy.flush()
        file = pye57.E57(copy.name)
        scans, points = file.scan_count, file.get_header(0).point_count if file.scan_count else 0
        if not 0 < points <= MOST_POINTS:
            raise sweep_error(path, points)
        columns = _columns(file.read_scan_raw(0))
        file.close()
    doubts = [f"it holds {scans} scans, of which the first is read"] if scans > 1 else []
    return cloud_of_columns(columns, format="E57", name=path, doubts=doubts)


def blocks_of(path: Path) -> Iterator[dict[str, np.ndarray]]:
    """Yield the fields of BLOCK_POINTS points at a time of all scans, in the frame of the file; errors as `decode`."""
    with _library(path) as pye57:
        with open_regular(path) as content:
            _check_xml(content, path)
            file = pye57.E57(name_of_open(content))
        for number in range(file.scan_count):
            header = file.get_header(number)
            names = [name for name in header.point_fields if name.startswith((*FORMS, "intensity"))]
            raw, buffers = file.make_buffers(names, BLOCK_POINTS)
            reader = header.points.reader(buffers)
            while count := reader.read():
                columns = _columns({name: values[:count] for name, values in raw.items()})
                if header.has_pose():
                    xyz = np.stack([columns[axis] for axis in CARTESIAN], axis=1)
                    xyz = xyz @ header.rotation_matrix.T + header.translation
                    columns |= dict(zip(CARTESIAN, xyz.T, strict=True))
                yield columns
            reader.close()
        file.close()


@contextmanager
def _library(path: Path) -> Iterator[Any]:
    """Give pye57; InputError if it is not installed, and in place of its errors inside."""
    try:
        import pye57  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError(
            f"{path}: is an E57, which needs pye57: pip install 'lidar2pano[formats]', or {EXPORT}"
        ) from None
    try:
        yield pye57
    except InputError:
        raise
    except Exception as error:  # of libE57, depending on the damage
        reason = str(error).partition("(")[0].strip() or type(error).__name__  # without places in its source
        raise InputError(f"{path}: is an E57 that pye57 does not read ({reason}); {EXPORT}") from None


def _check_xml(file: BinaryIO, path: Path) -> None:
    """Raise InputError for an XML section with references to other documents, or in another encoding than UTF-8."""
    head = file.read(XML_PLACE + HEADER.size)
    offset, length = HEADER.unpack_from(head.ljust(XML_PLACE + HEADER.size), XML_PLACE)
    first, skipped = divmod(offset, PAGE_BYTES)
    file.seek(min(first * PAGE_BYTES, 1 << 62))
    data = file.read((min(length, MOST_XML_BYTES) // CHECKED_BYTES + 2) * PAGE_BYTES)
    pages = range(0, len(data), PAGE_BYTES)
    xml = b"".join(data[page : page + CHECKED_BYTES] for page in pages)[skipped : skipped + length]
    if DECLARATION.match(xml) is None or FETCHING.search(xml) or length > MOST_XML_BYTES:
        raise InputError(f"{path}: is an E57 whose XML cannot be read or refers to other documents; {EXPORT}")


def _columns(raw: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return the fields of a scan; x y z of spherical ones by the standard's formulas, section 8.4.4."""
    fields = {name: np.asarray(values) for name, values in raw.items()}
    if "sphericalRange" in fields and not set(CARTESIAN) <= fields.keys():
        range_m, azimuth, elevation = (fields.pop(f"spherical{name}").astype(np.float64) for name in SPHERICAL)
        along = range_m * np.cos(elevation)
        places = (along * np.cos(azimuth), along * np.sin(azimuth), range_m * np.sin(elevation))
        fields = dict(zip(CARTESIAN, places, strict=True)) | fields
    for name in INVALID:
        if name in fields:
            invalid = fields.pop(name) > 0
            fields |= {axis: np.where(invalid, np.nan, fields[axis]) for axis in CARTESIAN if axis in fields}
    return fields
