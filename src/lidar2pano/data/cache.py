"""Caches of data sets: in memory the last frames, on disk a segmenter's predictions."""

from __future__ import annotations

import hashlib
import os
import zlib
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import fields, is_dataclass
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from torch import Tensor

from lidar2pano.bounded_files import read_bytes, sha256_of
from lidar2pano.data.frames import Frame
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import write_whole
from lidar2pano.scan import Scan

T = TypeVar("T")
MOST_BYTES = 1 << 26  # of packed labels: a byte for each point of the largest scan, four times
LIMIT_BYTES = 256 * 2**20  # of one cache; every worker of a loader has its own


class LruCache:
    """The values used last, as many as fit into `limit` bytes of arrays; at least one."""

    def __init__(self, limit: int = LIMIT_BYTES) -> None:
        self.limit, self.held_bytes = limit, 0
        self._held: OrderedDict[Hashable, Any] = OrderedDict()

    def get(self, key: Hashable, load: Callable[[], T]) -> T:
        """Return the value of `key`: the one held, else the result of `load`."""
        if key in self._held:
            self._held.move_to_end(key)
            return self._held[key]
        value = self._held[key] = load()
        self.held_bytes += nbytes(value)
        while self.held_bytes > self.limit and len(self._held) > 1:
            self.held_bytes -= nbytes(self._held.popitem(last=False)[1])
        return value


def cached_by_files(files: Callable[[Path], Iterable[Path]]) -> Callable[[Callable[[Path], T]], Callable[[Path], T]]:
    """Return a decorator: the results of a function of a path, the last four, are reused until its files change.

    files  (path) -> the files read by the function; missing ones count, too.
    """

    def decorate(read: Callable[[Path], T]) -> Callable[[Path], T]:
        @lru_cache(maxsize=4)
        def read_once(path: Path, changes_ns: tuple[int, ...]) -> T:  # noqa: ARG001 a part of the cache's key
            return read(path)

        @wraps(read)
        def reread_if_changed(path: Path) -> T:
            return read_once(path, tuple(file.stat().st_mtime_ns if file.is_file() else 0 for file in files(path)))

        return reread_if_changed

    return decorate


def nbytes(value: object) -> int:
    """Return bytes of the arrays and tensors in a value: itself, or parts of a tuple or a dataclass."""
    if isinstance(value, np.ndarray | Tensor):
        return value.nbytes
    if isinstance(value, tuple):
        return sum(map(nbytes, value))
    if is_dataclass(value):
        return sum(nbytes(getattr(value, field.name)) for field in fields(value))
    return 0


def stored_labels(frame: Frame) -> np.ndarray:
    """Return labels (N,) int64 by `prepare --labels-folder predicted_labels`; InputError if the file is missing."""
    return frame.require("predicted_labels")[0]


class PredictedLabels:
    """A segmenter's labels of scans: made when they are first requested, kept on disk, shared by all processes.

    label_points  the segmenter: scan -> (N,) integer ids of SEMANTIC_KITTI.
    weights       its weight file.
    A file is found by the SHA-256 of the weights and of the scan: other weights or another scan make another file, but
    labels by an older projection or clean-up stay in use until predictions/ is removed. It lies in the data set's
    folder .lidar2pano/ or, if it may not be written, in the user's cache (XDG_CACHE_HOME).
    """

    def __init__(self, label_points: Callable[[Scan], Tensor], weights: str | Path) -> None:
        self.label_points = label_points
        self.key = sha256_of(weights)[:16]

    def complete(self, frames: Sequence[Frame]) -> bool:
        """Return whether these frames, with files as they are now, are known to be labelled; no scan is read."""
        name = self._completed(frames)
        return name is not None and any(path.is_file() for path in self._paths(frames[0], name))

    def note_complete(self, frames: Sequence[Frame]) -> None:
        """Note all these frames as labelled, if possible."""
        if (name := self._completed(frames)) is not None:
            write_first(self._paths(frames[0], name), Path.touch)

    def _completed(self, frames: Sequence[Frame]) -> str | None:
        """Return name of the note for these frames; None if one of them is not a file of its own."""
        digest = hashlib.sha256()
        for frame in frames:
            try:
                stamp = Path(frame.scan_file).stat()  # pyright: ignore[reportAttributeAccessIssue]
            except (AttributeError, OSError):
                return None
            digest.update(os.fsencode(f"{frame.name} {stamp.st_size} {stamp.st_mtime_ns}\n"))
        return f"{digest.hexdigest()[:32]}.complete" if len(frames) else None

    def _paths(self, frame: Frame, name: str) -> list[Path]:
        """Return the places of a file, the first place first: beside the data, and in the user's cache."""
        return kept_at(frame.root, f"predictions/{self.key}/{name}")

    def of(self, frame: Frame) -> np.ndarray:
        """Return (N,) int64 ids of the points of a frame's scan."""
        scan = frame.scan
        digest = hashlib.sha256(scan.xyz.tobytes() + scan.remission.tobytes())
        paths = self._paths(frame, f"{digest.hexdigest()[:32]}.zlib")
        for path in paths:
            if (labels := _read(path, len(scan))) is not None:
                return labels
        labels = self.label_points(scan).cpu().numpy().astype(np.int64)
        compressed = zlib.compress(labels.astype(np.uint8).tobytes(), 1)
        write_first(paths, lambda path: path.write_bytes(compressed))
        return labels


def kept_at(root: Path | None, name: str) -> list[Path]:
    """Return the places of a file made of a data set, the first place first: beside the data, in the user's cache."""
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lidar2pano"
    return [folder / name for folder in ([root / ".lidar2pano"] if root else []) + [user]]


def write_first(paths: Iterable[Path], write: Callable[[Path], object]) -> None:
    """Write a file to the first writable place; to none if all are read-only."""
    for path in paths:
        try:
            write_whole(path, write)
        except InputError:
            continue
        return


def _read(path: Path, points: int) -> np.ndarray | None:
    try:
        labels = np.frombuffer(zlib.decompressobj().decompress(read_bytes(path, MOST_BYTES), points + 1), np.uint8)
    except (OSError, zlib.error):
        return None
    return labels.astype(np.int64) if len(labels) == points else None
