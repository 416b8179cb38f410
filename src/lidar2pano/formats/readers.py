"""The table of readers, chosen by content; a path's clouds; a path's scans."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from lidar2pano.errors import InputError
from lidar2pano.formats.interpretation import Interpretation, Overrides, interpret
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.scan import Scan

HEAD_BYTES = 4096  # of a file, by which readers decide


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """Which scans of a recording are read; a file of one scan has no use for it.

    topic  name of the topic or stream; "" for the only one.
    every  each so many scans one is read.
    start_s, end_s  seconds after the recording's first scan; None for all.
    """

    topic: str = ""
    every: int = 1
    start_s: float | None = None
    end_s: float | None = None


class Reader(Protocol):
    """Reads one format."""

    name: str

    def accepts(self, head: bytes, path: Path) -> bool:
        """Whether the file is of this format: by its first HEAD_BYTES; `path` as the last hint only."""
        ...

    def clouds(self, path: Path, options: ReadOptions) -> Iterator[PointCloud]:
        """The clouds of the file: one for a scan, many for a recording. Raises InputError for a damaged file."""
        ...


READERS: tuple[Reader, ...] = ()  # in the order in which they are asked


def open_path(path: str | Path, readers: Sequence[Reader] = READERS) -> Reader:
    """The first reader that takes the file; InputError when it cannot be read or none takes it.

    readers  the table; a package above this one (recordings) gives a longer one.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); name a scan file that exists") from error
    for reader in readers:
        if reader.accepts(head, path):
            return reader
    known = ", ".join(reader.name for reader in readers)
    raise InputError(f"{path}: is of no format that can be read ({known}); write it as one of them")


def interpreted(
    path: str | Path,
    options: ReadOptions | None = None,
    overrides: Overrides | None = None,
    readers: Sequence[Reader] = READERS,
) -> Iterator[tuple[Scan, Interpretation]]:
    """The scans of a file or recording, one at a time, each with how it was read."""
    path = Path(path)
    for cloud in open_path(path, readers).clouds(path, options or ReadOptions()):
        yield interpret(cloud, overrides)
