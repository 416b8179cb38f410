"""Rows of floats without a header: KITTI's .bin (x y z remission), nuScenes' .pcd.bin (x y z intensity ring), others.

And SemanticKITTI's .label: one uint32 a point.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lidar2pano.bounded_files import read_input
from lidar2pano.errors import InputError
from lidar2pano.formats.point_cloud import MOST_POINTS, PointCloud, cloud_of_columns, sweep_error
from lidar2pano.formats.unnamed_columns import MOST_RINGS, are_integers, block_count, column_names, row_width
from lidar2pano.labels import SEMANTIC_KITTI
from lidar2pano.scan import Scan

MOST_BYTES = 16 * MOST_POINTS  # a sparse or wrong file must not fill the memory
SAMPLE = 20_000  # numbers to tell their type by; coordinates are alike all through a file
FEWEST_BYTES = 160  # decide, if the name does not
FAR_M = 1e9  # no coordinate of a scan is beyond: neither in micrometres
SMALLEST = 1e-12  # of a nonzero coordinate
MOST_ODD, MOST_FAR = 0.25, 0.02  # of the numbers, one of which may be a time; of the coordinates
KITTI, NUSCENES = ("x", "y", "z", "remission"), ("x", "y", "z", "intensity", "ring")
TYPES = {"<f4": "float32", "<f8": "float64", ">f4": "big-endian float32", ">f8": "big-endian float64"}


def accepts(head: bytes, path: Path) -> bool:
    """Return whether a file may be rows of float32: its name ends in .bin, or its first numbers could be points."""
    if ".bin" in path.suffixes[-2:]:
        return True
    if len(head) <= FEWEST_BYTES:
        return False
    values = np.frombuffer(head, "<f4", len(head) // 4)
    return bool(np.isfinite(values).all()) and not _odd_share(values) and values.std() > 0.01


def decode(data: bytes, path: Path) -> PointCloud:
    """Return the points; InputError for a part of a point, or numbers of no points."""
    if not data:
        raise InputError(f"{path}: is empty; name a scan file that holds points")
    shares = {kind: _odd_share(_numbers(data, kind, SAMPLE)) for kind in TYPES}
    kind = min(shares, key=lambda kind: shares[kind])
    if shares[kind] > MOST_ODD and len(data) > FEWEST_BYTES:
        raise _no_points(path)
    width = row_width(_numbers(data, kind, len(data)))
    width = width if width >= len("xyz") else 0  # it tells nothing
    whole = len(data) % np.dtype(kind).itemsize == 0
    if not width and whole and (columns := block_count(_numbers(data, kind, len(data)))):
        width, table = columns, np.frombuffer(data, kind).reshape(columns, -1).T
    else:
        width = width or _shortest_width(data, kind)
        table = _rows(data, kind, width, path)
    if len(table) > MOST_POINTS:
        raise sweep_error(path, len(table))
    names = column_names(table)
    if width == len(KITTI):
        names = ["remission" if name == "intensity" else name for name in names]
    places = [names.index(axis) for axis in "xyz"] if "x" in names else [0, 1, 2]
    if _odd_share(table[:SAMPLE, places]) > MOST_FAR:
        raise _no_points(path)
    form = {KITTI: "KITTI", NUSCENES: "nuScenes"}.get(tuple(names), f"{width} numbers a point")
    columns = dict(zip(names, table.T, strict=True))
    return cloud_of_columns(columns, format=f"{TYPES[kind]} rows, {form}", name=path)


def _no_points(path: Path) -> InputError:
    return InputError(f"{path}: its bytes are no points (x y z remission as float32); it is of another format")


def read_bin(path: Path) -> Scan:
    """Read a KITTI .bin: (N, 4) float32 x, y, z in metres and remission in [0, 1].

    Raises InputError when the file cannot be read, is empty, or its length is not a whole number of points.
    """
    data = read_input(path, "name a scan file that exists", MOST_BYTES)
    if not data:
        raise InputError(f"{path}: is empty; a KITTI scan holds 16 bytes a point")
    points = _rows(data, "<f4", len(KITTI), path)
    return Scan(xyz=points[:, :3].copy(), remission=points[:, 3].copy(), name=path.stem)


def write_bin(path: Path, scan: Scan) -> None:
    """Write a scan as KITTI's .bin."""
    np.concatenate([scan.xyz, scan.remission[:, None]], axis=1).astype("<f4").tofile(path)


def read_label(path: Path, points: int) -> np.ndarray:
    """Read a SemanticKITTI .label of a scan with `points` points: (N,) int64 ids of SEMANTIC_KITTI.

    Raises InputError when the file cannot be read or was made for another number of points.
    """
    return SEMANTIC_KITTI.from_raw(raw_labels(path, points))


def raw_labels(path: Path, points: int) -> np.ndarray:
    """Read a SemanticKITTI .label as it is, (N,) uint32 with classes and instances; raises like `read_label`."""
    data = read_input(path, "name a label file that exists", MOST_BYTES)
    if len(data) != 4 * points:
        raise InputError(f"{path}: {len(data)} bytes, but its scan has {points} points (4 bytes each); pair them again")
    return np.frombuffer(data, "<u4")


def write_label(path: Path, ids: np.ndarray) -> None:
    """Write ids (N,) of SEMANTIC_KITTI as raw uint32 values in file order."""
    SEMANTIC_KITTI.to_raw(ids).astype("<u4").tofile(path)


def _rows(data: bytes, kind: str, width: int, path: Path) -> np.ndarray:
    """Return the rows (N, width); InputError if there is a part of a row."""
    size = width * np.dtype(kind).itemsize
    if len(data) % size:
        raise InputError(
            f"{path}: {len(data)} bytes are no whole number of points ({size} bytes each: {width} {TYPES[kind]});"
            " the file is truncated or of another format"
        )
    return np.frombuffer(data, kind).reshape(-1, width)


def _numbers(data: bytes, kind: str, most: int) -> np.ndarray:
    return np.frombuffer(data, kind, min(len(data) // np.dtype(kind).itemsize, most))


def _odd_share(values: np.ndarray) -> float:
    """Return the share of sizes without a use (coordinates, remissions, beams) among the finite numbers."""
    with np.errstate(invalid="ignore"):
        size = np.abs(values[np.isfinite(values)])
    return float(np.mean((size > FAR_M) | ((size > 0) & (size < SMALLEST)))) if len(size) else 1.0


def _shortest_width(data: bytes, kind: str) -> int:
    """Return the numbers of a point among too few: nuScenes' if each fifth is the number of a beam, else KITTI's."""
    values = _numbers(data, kind, len(data))
    fifth = values[len(NUSCENES) - 1 :: len(NUSCENES)]
    beams = len(fifth) > 1 and are_integers(fifth, MOST_RINGS)
    several = beams and bool((fifth != fifth[0]).any() or (values[len(KITTI) - 1 :: len(KITTI)] < 0).any())
    return len(NUSCENES) if several else len(KITTI)
