"""Scan files: readers by suffix, KITTI's .bin (x y z remission, float32) and SemanticKITTI's .label (uint32).

A path may be one file, a folder of files or a sequence folder.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from lidar2pano.errors import InputError, closest
from lidar2pano.labels import SEMANTIC_KITTI
from lidar2pano.scan import Scan

MOST_BYTES = 1 << 30  # 67 million points: a sparse or wrong file must not fill the memory


def read_bin(path: Path) -> Scan:
    """Read a KITTI .bin: (N, 4) float32 x, y, z in metres and remission in [0, 1].

    Raises InputError when the file cannot be read, is empty, or its length is not a whole number of points.
    """
    try:
        if (length := path.stat().st_size) > MOST_BYTES:
            raise InputError(f"{path}: {length} bytes are no single scan (at most {MOST_BYTES}); name a scan file")
        data = path.read_bytes()
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
        length = path.stat().st_size
        values = np.fromfile(path, dtype="<u4", count=points)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); name a label file that exists") from error
    if length != 4 * points:
        raise InputError(f"{path}: {length} bytes, but its scan has {points} points (4 bytes each); pair them again")
    return SEMANTIC_KITTI.from_raw(values)


def write_bin(path: Path, scan: Scan) -> None:
    """Write a scan as KITTI's .bin."""
    np.concatenate([scan.xyz, scan.remission[:, None]], axis=1).astype("<f4").tofile(path)


def write_label(path: Path, ids: np.ndarray) -> None:
    """Write ids (N,) of SEMANTIC_KITTI as raw uint32 values in file order."""
    SEMANTIC_KITTI.to_raw(ids).astype("<u4").tofile(path)


READERS: dict[str, Callable[[Path], Scan]] = {".bin": read_bin}


def read(path: str | Path) -> Scan:
    """Read one scan file of a known suffix.

    Raises InputError for a file that is missing, of an unknown suffix or damaged.
    """
    path = Path(path)
    if path.name.endswith(".pcd.bin"):
        raise InputError(
            f"{path}: nuScenes' sweeps (five numbers a point) have no reader yet; write it as KITTI's .bin"
        )
    if path.suffix not in READERS:
        raise InputError(f"{path}: no reader for files that end in {path.suffix!r}" + closest(path.suffix, READERS))
    return READERS[path.suffix](path)


def scan_files(path: str | Path) -> list[Path]:
    """Return scan files in order of their names: the file itself, a folder's, or a sequence folder's `velodyne/`.

    Raises InputError when the path does not exist or may not be read, or the folder holds no scan.
    """
    path = Path(path)
    try:
        if path.is_file():
            return [path]
        if not path.is_dir():
            raise InputError(f"{path}: does not exist; name a scan file, a folder of scans or a sequence folder")
        folder = path / "velodyne" if (path / "velodyne").is_dir() else path
        files = sorted(file for file in folder.iterdir() if file.suffix in READERS and file.is_file())
    except OSError as error:
        raise InputError(f"{path}: cannot be looked into ({error.strerror}); ask for permission") from error
    if not files:
        raise InputError(f"{folder}: holds no scan (known endings: {', '.join(READERS)})")
    return files


def scans(path: str | Path) -> Iterator[Scan]:
    """Yield the scans that `scan_files` finds, read one at a time."""
    for file in scan_files(path):
        yield read(file)
