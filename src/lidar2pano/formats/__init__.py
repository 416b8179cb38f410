"""Readers of scan files, by suffix."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from lidar2pano.errors import InputError, closest
from lidar2pano.formats.kitti import read_bin
from lidar2pano.scan import Scan

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
