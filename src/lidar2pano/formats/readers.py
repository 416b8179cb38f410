"""The table of readers, chosen by content; the clouds and scans of a file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lidar2pano.errors import InputError
from lidar2pano.formats import arrays, delimited_text, e57, feather, las, pcd, ply
from lidar2pano.formats import scan_files as float_rows
from lidar2pano.formats.file_contents import contents, head_of
from lidar2pano.formats.foreign_files import foreign_kind
from lidar2pano.formats.interpretation import Interpretation, Overrides, interpret
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.scan import Scan

# Endings of the names of scan files; a file named by the user is read whatever its name.
ENDINGS = (".bin", ".pcd", ".ply", ".npy", ".npz", ".las", ".laz", ".feather", ".parquet", ".e57")
TEXT_ENDINGS = (".csv", ".txt", ".xyz", ".pts", ".asc")  # of a folder's files only if there are no others


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """The scans of a recording to read; a file of one scan has no use for it.

    topic           name of the topic or stream; "" for the only one.
    every           one of so many scans is read.
    start_s, end_s  seconds after the recording's first scan; None for all.
    """

    topic: str = ""
    every: int = 1
    start_s: float | None = None
    end_s: float | None = None

    def __post_init__(self) -> None:
        """Raise InputError for an end that is not behind the start."""
        if self.start_s is not None and self.end_s is not None and self.end_s <= self.start_s:
            raise InputError(f"--from {self.start_s:g} --to {self.end_s:g}: ends before it begins; name a later --to")


@dataclass(frozen=True)
class Reader:
    """The reader of a format of one scan a file.

    accepts  (first HEAD_BYTES, path) -> whether the file is of this format; the path is the last hint only.
    decode   (all bytes, path) -> its cloud; raises InputError for a damaged file.
    """

    name: str
    accepts: Callable[[bytes, Path], bool]
    decode: Callable[[bytes, Path], PointCloud]

    def cloud(self, path: Path) -> PointCloud:
        """Read the cloud of a file."""
        return self.decode(contents(path), path)


def begins(*magics: bytes) -> Callable[[bytes, Path], bool]:
    """Return a test of whether the first bytes of a file are one of `magics`."""
    return lambda head, _: head.startswith(magics)


def _begins_pcd(head: bytes, _: Path) -> bool:
    return pcd.ENTRY.search(head) is not None and (b"FIELDS " in head or b"COLUMNS " in head)


READERS: tuple[Reader, ...] = (  # the first to accept a file reads it: those sure by content come first
    Reader("PCD", _begins_pcd, pcd.decode),
    Reader("PLY", begins(b"ply\n", b"ply\r", b"ply "), ply.decode),
    Reader("NPY", begins(b"\x93NUMPY"), arrays.decode_npy),
    Reader("NPZ", begins(b"PK\x03\x04", b"PK\x05\x06"), arrays.decode_npz),
    Reader("LAS", begins(b"LASF"), las.decode),
    Reader("E57", begins(e57.MAGIC), e57.decode),
    Reader("Feather", begins(b"ARROW1", b"FEA1"), feather.decode),
    Reader("Parquet", begins(feather.PARQUET), feather.decode),
    Reader("text", lambda head, _: b"\0" not in head and delimited_text.has_points(head), delimited_text.decode),
    Reader("float32 rows", float_rows.accepts, float_rows.decode),
)


def open_path(path: str | Path) -> Reader:
    """Return the first reader to accept the file; InputError when it cannot be read or none accepts it."""
    path = Path(path)
    head = head_of(path)
    if kind := foreign_kind(head, path):
        raise InputError(f"{path}: is {kind.name}; {kind.advice}")
    for reader in READERS:
        if reader.accepts(head, path):
            return reader
    if not head:
        raise InputError(f"{path}: is empty; name a scan file that holds points")
    if (line := delimited_text.first_line(head)) is not None:
        raise InputError(f"{path}: is text, but no table of points (it begins {line!r}); name a scan")
    formats = ", ".join(reader.name for reader in READERS)
    raise InputError(f"{path}: is of no format that is read ({formats}); write it as one of them")


def interpreted(path: str | Path, overrides: Overrides | None = None) -> tuple[Scan, Interpretation]:
    """Read the scan of a file, with its interpretation."""
    path = Path(path)
    cloud = open_path(path).cloud(path)
    cloud.require_points(f"{path}")
    try:
        return interpret(cloud, overrides)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def read(source: Any, overrides: Overrides | None = None) -> Scan:  # noqa: ANN401
    """Read one scan.

    source     path of a file of a known format, whatever its name; or an array (N, 3 or more) of x y z [intensity
               [ring]]; or a cloud of Open3D or PyVista; or a PointCloud2 message of ROS.
    overrides  the user's knowledge; None: everything is found out from the scan.
    Raises InputError for a file missing, damaged or of no known format, and for points that are no sweep.
    """
    if isinstance(source, str | Path):
        return interpreted(source, overrides)[0]
    return interpret(arrays.cloud_of(source), overrides)[0]
