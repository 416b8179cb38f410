"""From a path to scan files: one file, a folder of files, a sequence folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from lidar2pano.errors import InputError
from lidar2pano.formats import READERS, read
from lidar2pano.scan import Scan


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
