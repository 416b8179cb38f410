"""Files of data sets in KITTI's layout: .bin (x y z remission, float32) and SemanticKITTI's .label (uint32)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lidar2pano.bounded_files import read_bytes
from lidar2pano.errors import InputError
from lidar2pano.labels import SEMANTIC_KITTI
from lidar2pano.scan import Scan

MOST_BYTES = 1 << 30  # 67 million points: a sparse or wrong file must not fill the memory


def read_bin(path: Path) -> Scan:
    """Read a KITTI .bin: (N, 4) float32 x, y, z in metres and remission in [0, 1].

    Raises InputError when the file cannot be read, is empty, or its length is not a whole number of points.
    """
    try:
        data = read_bytes(path, MOST_BYTES)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); name a scan file that exists") from error
    if not data:
        raise InputError(f"{path}: is empty; a KITTI scan holds 16 bytes a point")
    if len(data) % 16:
        raise InputError(
            f"{path}: {len(data)} bytes are no whole number of points (16 bytes each: x y z remission as float32);"
            " the file is truncated or of another format"
        )
    points = np.frombuffer(data, dtype="<f4").reshape(-1, 4)
    return Scan(xyz=points[:, :3].copy(), remission=points[:, 3].copy(), name=path.stem)


def read_label(path: Path, points: int) -> np.ndarray:
    """Read a SemanticKITTI .label of a scan with `points` points: (N,) int64 ids of SEMANTIC_KITTI.

    Raises InputError when the file cannot be read or was made for another number of points.
    """
    try:
        data = read_bytes(path, MOST_BYTES)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); name a label file that exists") from error
    if len(data) != 4 * points:
        raise InputError(f"{path}: {len(data)} bytes, but its scan has {points} points (4 bytes each); pair them again")
    return SEMANTIC_KITTI.from_raw(np.frombuffer(data, "<u4"))


def write_bin(path: Path, scan: Scan) -> None:
    """Write a scan as KITTI's .bin."""
    np.concatenate([scan.xyz, scan.remission[:, None]], axis=1).astype("<f4").tofile(path)


def write_label(path: Path, ids: np.ndarray) -> None:
    """Write ids (N,) of SEMANTIC_KITTI as raw uint32 values in file order."""
    SEMANTIC_KITTI.to_raw(ids).astype("<u4").tofile(path)
