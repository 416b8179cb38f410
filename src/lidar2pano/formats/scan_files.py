"""Rows of float32 without a header: KITTI's .bin (x y z remission) and nuScenes' .pcd.bin (x y z intensity ring).

And SemanticKITTI's .label: one uint32 a point. All are little-endian.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lidar2pano.bounded_files import read_input
from lidar2pano.errors import InputError
from lidar2pano.formats.file_contents import stem_of
from lidar2pano.formats.point_cloud import MOST_POINTS, PointCloud
from lidar2pano.labels import SEMANTIC_KITTI
from lidar2pano.scan import Scan

MOST_BYTES = 1 << 30  # 67 million points: a sparse or wrong file must not fill the memory
MOST_RINGS = 256
SAMPLE = 20_000  # rows to tell the form by; rings and remissions are alike all through it
FEWEST_BYTES = 160  # decide, if the name does not
FAR_M = 1e6  # no coordinate of a scan is beyond: neither in millimetres


def accepts(head: bytes, path: Path) -> bool:
    """Return whether a file may be rows of float32: its name ends in .bin, or its first numbers could be points."""
    if ".bin" in path.suffixes[-2:]:
        return True
    if len(head) <= FEWEST_BYTES:
        return False
    values = np.frombuffer(head, "<f4", len(head) // 16 * 4).reshape(-1, 4)
    return _has_rings(head) or (bool(np.isfinite(values).all()) and _plausible(values) and values.std() > 0.01)


def decode(data: bytes, path: Path) -> PointCloud:
    """Return the points; InputError for a part of a point, or numbers of no points."""
    if _has_rings(data):
        rows = _rows(data, path, 5, "x y z intensity ring as float32, nuScenes' form", "the file is truncated")
        return PointCloud(
            xyz=rows[:, :3],
            intensity=rows[:, 3],
            ring=rows[:, 4].astype(np.int64),
            format="float32 rows, nuScenes",
            name=stem_of(path),
            fields=("x", "y", "z", "intensity", "ring"),
        )
    rows = _kitti_rows(data, path)
    if len(rows) > MOST_POINTS:
        raise InputError(f"{path}: {len(rows)} points are no single sweep (at most {MOST_POINTS}); cut it")
    if not _plausible(rows[:SAMPLE]):
        raise InputError(
            f"{path}: its bytes are no points (x y z remission as float32); the file is damaged or of another format"
        )
    return PointCloud(
        xyz=rows[:, :3],
        intensity=rows[:, 3],
        format="float32 rows, KITTI",
        name=stem_of(path),
        fields=("x", "y", "z", "remission"),
    )


def read_bin(path: Path) -> Scan:
    """Read a KITTI .bin: (N, 4) float32 x, y, z in metres and remission in [0, 1].

    Raises InputError when the file cannot be read, is empty, or its length is not a whole number of points.
    """
    points = _kitti_rows(read_input(path, "name a scan file that exists", MOST_BYTES), path)
    return Scan(xyz=points[:, :3].copy(), remission=points[:, 3].copy(), name=path.stem)


def write_bin(path: Path, scan: Scan) -> None:
    """Write a scan as KITTI's .bin."""
    np.concatenate([scan.xyz, scan.remission[:, None]], axis=1).astype("<f4").tofile(path)


def read_label(path: Path, points: int) -> np.ndarray:
    """Read a SemanticKITTI .label of a scan with `points` points: (N,) int64 ids of SEMANTIC_KITTI.

    Raises InputError when the file cannot be read or was made for another number of points.
    """
    data = read_input(path, "name a label file that exists", MOST_BYTES)
    if len(data) != 4 * points:
        raise InputError(f"{path}: {len(data)} bytes, but its scan has {points} points (4 bytes each); pair them again")
    return SEMANTIC_KITTI.from_raw(np.frombuffer(data, "<u4"))


def write_label(path: Path, ids: np.ndarray) -> None:
    """Write ids (N,) of SEMANTIC_KITTI as raw uint32 values in file order."""
    SEMANTIC_KITTI.to_raw(ids).astype("<u4").tofile(path)


def _kitti_rows(data: bytes, path: Path) -> np.ndarray:
    if not data:
        raise InputError(f"{path}: is empty; a KITTI scan holds 16 bytes a point")
    return _rows(data, path, 4, "x y z remission as float32", "the file is truncated or of another format")


def _rows(data: bytes, path: Path, values: int, form: str, mend: str) -> np.ndarray:
    """Return the rows (N, values); InputError if there is a part of a row."""
    if len(data) % (4 * values):
        size = f"{4 * values} bytes each: {form}"
        raise InputError(f"{path}: {len(data)} bytes are no whole number of points ({size}); {mend}")
    return np.frombuffer(data, "<f4").reshape(-1, values)


def _has_rings(data: bytes) -> bool:
    """Return whether every fifth number is the number of a beam; if all are equal, four a point must make no sense."""
    ring = np.frombuffer(data, "<f4", min(len(data) // 20, SAMPLE) * 5).reshape(-1, 5)[:, 4]
    if len(ring) < 2 or not bool(((ring >= 0) & (ring < MOST_RINGS)).all()):
        return False
    rows = np.frombuffer(data, "<f4", min(len(data) // 16, SAMPLE) * 4).reshape(-1, 4)
    return bool((ring == np.floor(ring)).all()) and (bool((ring != ring[0]).any()) or not _plausible(rows))


def _plausible(rows: np.ndarray) -> bool:
    """Return whether (N, 4) may be x y z remission: no accidental coordinates, and no negative remission."""
    with np.errstate(invalid="ignore"):
        far = (np.abs(rows[:, :3]) > FAR_M) & np.isfinite(rows[:, :3])
        return not bool((rows[:, 3] < 0).any() or far.any())
