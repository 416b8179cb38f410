"""Rows of little-endian float32 without a header: KITTI's .bin (x y z remission), nuScenes' .pcd.bin (and a ring)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.file_contents import stem_of
from lidar2pano.formats.point_cloud import MOST_POINTS, PointCloud

MOST_RINGS = 256
SAMPLE = 20_000  # rows that tell what a file is; rings and remissions are alike all through it
FEWEST_BYTES = 160  # that decide, where the name does not
FAR_M = 1e6  # no coordinate of a scan is beyond: neither in millimetres


def accepts(head: bytes, path: Path) -> bool:
    """Whether a file may be rows of float32: its name ends in .bin, or its first numbers could be points."""
    if ".bin" in path.suffixes[-2:]:
        return True
    if len(head) > FEWEST_BYTES and _has_rings(head):
        return True
    values = np.frombuffer(head, "<f4", len(head) // 16 * 4).reshape(-1, 4)
    return len(head) > FEWEST_BYTES and bool(np.isfinite(values).all()) and _plausible(values) and values.std() > 0.01


def decode(data: bytes, path: Path) -> PointCloud:
    """The points; InputError when the length is no whole number of points, or the numbers are none of points."""
    if not data:
        raise InputError(f"{path}: is empty; a KITTI scan holds 16 bytes a point")
    if _has_rings(data):
        if len(data) % 20:
            raise InputError(
                f"{path}: {len(data)} bytes are no whole number of points (20 bytes each: x y z intensity ring as"
                " float32, nuScenes' form); the file is truncated"
            )
        rows = np.frombuffer(data, "<f4").reshape(-1, 5)
        return PointCloud(
            xyz=rows[:, :3],
            intensity=rows[:, 3],
            ring=rows[:, 4].astype(np.int64),
            format="float32 rows, nuScenes",
            name=stem_of(path),
            fields=("x", "y", "z", "intensity", "ring"),
        )
    if len(data) % 16:
        raise InputError(
            f"{path}: {len(data)} bytes are no whole number of points (16 bytes each: x y z remission as float32);"
            " the file is truncated or of another format"
        )
    rows = np.frombuffer(data, "<f4").reshape(-1, 4)
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


def _has_rings(data: bytes) -> bool:
    """Whether every fifth number is the number of a beam; if all are the same, four a point must make no sense."""
    ring = np.frombuffer(data, "<f4", min(len(data) // 20, SAMPLE) * 5).reshape(-1, 5)[:, 4]
    if len(ring) < 2 or not bool(((ring >= 0) & (ring < MOST_RINGS)).all()):
        return False
    rows = np.frombuffer(data, "<f4", min(len(data) // 16, SAMPLE) * 4).reshape(-1, 4)
    return bool((ring == np.floor(ring)).all()) and (bool((ring != ring[0]).any()) or not _plausible(rows))


def _plausible(rows: np.ndarray) -> bool:
    """Whether (N, 4) may be x y z remission: coordinates that are no accident, and no negative remission."""
    with np.errstate(invalid="ignore"):
        far = (np.abs(rows[:, :3]) > FAR_M) & np.isfinite(rows[:, :3])
        return not bool((rows[:, 3] < 0).any() or far.any())
