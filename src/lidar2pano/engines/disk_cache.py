"""Compiled networks on disk, in the user's cache folder: a file per key, checksummed, atomic, bounded.

The environment variable LIDAR2PANO_CACHE names the folder. A file that cannot be written is not kept, a damaged one is
removed: the network is compiled again.
"""

from __future__ import annotations

import hashlib
import os
import sys
from contextlib import suppress
from pathlib import Path

from lidar2pano.bounded_files import read_bytes
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import write_whole

LIMIT_BYTES = 2**30  # of all files together; the one used longest ago goes first
ENDING = ".compiled"
DIGEST = hashlib.sha256().digest_size


def cache_folder() -> Path:
    """Return the folder of compiled networks; it need not exist."""
    if named := os.environ.get("LIDAR2PANO_CACHE"):
        return Path(named)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local")) / "lidar2pano" / "engines"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "lidar2pano" / "engines"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lidar2pano" / "engines"


def is_empty() -> bool:
    """Return whether nothing was ever stored."""
    return next(cache_folder().glob(f"*{ENDING}"), None) is None


def fetch(key: str) -> bytes | None:
    """Return the bytes stored under a key; None if there are none, or the file is damaged."""
    path = cache_folder() / f"{key}{ENDING}"
    try:
        whole = read_bytes(path, LIMIT_BYTES)
    except OSError:
        return None
    digest, payload = whole[:DIGEST], whole[DIGEST:]
    if hashlib.sha256(payload).digest() != digest:
        with suppress(OSError):
            path.unlink()
        return None
    with suppress(OSError):
        os.utime(path)
    return payload


def store(key: str, payload: bytes) -> None:
    """Keep bytes under a key, and remove the files used longest ago if the limit is passed."""
    folder = cache_folder()
    with suppress(InputError):
        whole = hashlib.sha256(payload).digest() + payload
        write_whole(folder / f"{key}{ENDING}", lambda path: path.write_bytes(whole))
    with suppress(OSError):
        _trim(folder)


def _trim(folder: Path) -> None:
    by_use = sorted(((path.stat(), path) for path in folder.glob(f"*{ENDING}")), key=lambda entry: -entry[0].st_mtime)
    total = 0
    for number, (status, path) in enumerate(by_use):
        total += status.st_size
        if total > LIMIT_BYTES and number:
            path.unlink(missing_ok=True)
