"""The table of readers, chosen by content; the clouds and scans of a path; a folder's scan files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from lidar2pano.errors import InputError
from lidar2pano.formats import delimited_text, feather, float_rows, las, numpy_files, pcd, ply
from lidar2pano.formats.arrays import cloud_of
from lidar2pano.formats.file_contents import contents, head_of
from lidar2pano.formats.interpretation import Interpretation, Overrides, interpret
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.scan import Scan

# Endings of the names of scan files; a file that is named is read whatever its name.
ENDINGS = (".bin", ".pcd", ".ply", ".npy", ".npz", ".las", ".laz", ".feather")
TEXT_ENDINGS = (".csv", ".txt", ".xyz", ".pts", ".asc")  # of a folder's files only where there are no others
PACKED = (".gz", ".zst", ".zstd")


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """Which scans of a recording are read; a file of one scan has no use for it.

    topic           name of the topic or stream; "" for the only one.
    every           one of so many scans is read.
    start_s, end_s  seconds after the recording's first scan; None for all.
    """

    topic: str = ""
    every: int = 1
    start_s: float | None = None
    end_s: float | None = None


class Reader(Protocol):
    """Reads one format."""

    @property
    def name(self) -> str:
        """What the format is called."""
        ...

    def accepts(self, head: bytes, path: Path) -> bool:
        """Whether the file is of this format: by its first HEAD_BYTES; `path` as the last hint only."""
        ...

    def clouds(self, path: Path, options: ReadOptions) -> Iterator[PointCloud]:
        """The clouds of the file: one for a scan, many for a recording. Raises InputError for a damaged file."""
        ...


@dataclass(frozen=True)
class FileReader:
    """The reader of a format that keeps one scan in a file.

    accept  (first bytes, path) -> whether the file is of this format;  decode: (all bytes, path) -> its cloud.
    """

    name: str
    accept: Callable[[bytes, Path], bool]
    decode: Callable[[bytes, Path], PointCloud]

    def accepts(self, head: bytes, path: Path) -> bool:
        """Whether the file is of this format."""
        return self.accept(head, path)

    def clouds(self, path: Path, options: ReadOptions) -> Iterator[PointCloud]:
        """The one cloud of the file."""
        yield self.decode(contents(path), path)


READERS: tuple[Reader, ...] = (  # in the order in which they are asked: those that are sure by content first
    FileReader("PCD", pcd.accepts, pcd.decode),
    FileReader("PLY", ply.accepts, ply.decode),
    FileReader("NPY", numpy_files.accepts_npy, numpy_files.decode_npy),
    FileReader("NPZ", numpy_files.accepts_npz, numpy_files.decode_npz),
    FileReader("LAS", las.accepts, las.decode),
    FileReader("Feather", feather.accepts, feather.decode),
    FileReader("text", delimited_text.accepts, delimited_text.decode),
    FileReader("float32 rows", float_rows.accepts, float_rows.decode),
)


def open_path(path: str | Path, readers: Sequence[Reader] = READERS) -> Reader:
    """The first reader that takes the file; InputError when it cannot be read or none takes it.

    readers  the table; a package above this one (recordings) gives a longer one.
    """
    path = Path(path)
    head = head_of(path)
    for reader in readers:
        if reader.accepts(head, path):
            return reader
    if not head:
        raise InputError(f"{path}: is empty; name a scan file that holds points")
    known = ", ".join(reader.name for reader in readers)
    raise InputError(f"{path}: is of no format that is read ({known}); write it as one of them")


def interpreted(
    path: str | Path,
    options: ReadOptions | None = None,
    overrides: Overrides | None = None,
    like: Interpretation | None = None,
    readers: Sequence[Reader] = READERS,
) -> Iterator[tuple[Scan, Interpretation]]:
    """The scans of a file or recording, one at a time, each with how it was read.

    like  how the first scan of the same stream was read; what is found out once holds for all scans of a stream.
    """
    path = Path(path)
    for cloud in open_path(path, readers).clouds(path, options or ReadOptions()):
        try:
            scan, found = interpret(cloud, overrides, like)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        like = like or found
        yield scan, found


def read(source: Any, overrides: Overrides | None = None) -> Scan:  # noqa: ANN401
    """Read one scan.

    source     path of a file of a known format, whatever its name; or an array (N, 3 or more) of x y z [intensity
               [ring]]; or a cloud of Open3D or PyVista; or a PointCloud2 message of ROS.
    overrides  what is known better than it can be found out; None: everything is found out.
    Raises InputError for a file that is missing, of no known format or damaged, and for what is no sweep.
    """
    if isinstance(source, str | Path):
        for scan, _ in interpreted(source, overrides=overrides):
            return scan
        raise InputError(f"{source}: holds no scan; name another file")
    return interpret(cloud_of(source), overrides)[0]


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
        names = sorted(name for name in folder.iterdir() if not name.name.startswith("."))
        files = [file for file in names if _ending(file) in ENDINGS and file.is_file()]
        files = files or [file for file in names if _ending(file) in TEXT_ENDINGS and _is_table(file)]
    except OSError as error:
        raise InputError(f"{path}: cannot be looked into ({error.strerror}); ask for permission") from error
    if not files:
        raise InputError(f"{folder}: holds no scan (known endings: {', '.join((*ENDINGS, *TEXT_ENDINGS))})")
    return files


def scans(path: str | Path, overrides: Overrides | None = None) -> Iterator[Scan]:
    """Yield the scans of the files that `scan_files` finds, read one at a time and all alike, as one sensor's."""
    like = None
    for file in scan_files(path):
        for scan, found in interpreted(file, overrides=overrides, like=like):
            like = like or found
            yield scan


def _ending(path: Path) -> str:
    """The lower-case ending of a name, without that of its packing."""
    whole = Path(path.stem) if path.suffix.lower() in PACKED else path
    return whole.suffix.lower()


def _is_table(path: Path) -> bool:
    return path.is_file() and delimited_text.accepts(head_of(path), path)
