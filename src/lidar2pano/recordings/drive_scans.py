"""Scans of a path: of a file, a folder or a recording; when each was taken, and those of them that are wanted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from lidar2pano.bounded_files import read_text
from lidar2pano.errors import InputError
from lidar2pano.formats import readers
from lidar2pano.formats.file_contents import stem_of
from lidar2pano.formats.interpretation import Interpretation, Overrides, interpret
from lidar2pano.formats.json_files import read_json
from lidar2pano.formats.readers import ReadOptions, scan_files
from lidar2pano.recordings.recorded_scans import ENDINGS, METADATA, none_within, recording_reader
from lidar2pano.scan import Scan

TIMES = ("times.txt", "timestamps.txt", "timestamps.json")  # KITTI odometry, KITTI raw, PandaSet
UNIT_S = {19: 1e-9, 18: 1e-9, 16: 1e-6}  # digits of a name that is a time since the epoch -> its unit


@dataclass(frozen=True, kw_only=True)
class DriveScan:
    """A scan of a drive.

    file    the scan file or recording;  stream: the folder of the file, or the recording.
    scan    the points;  found: how they were read.
    """

    file: Path
    stream: Path
    scan: Scan
    found: Interpretation


def read(source: Any, overrides: Overrides | None = None) -> Scan:  # noqa: ANN401
    """Read one scan.

    source     path of a file of a known format, whatever its name; of a recording the first scan is read; or an array
               (N, 3 or more) of x y z [intensity [ring]]; or a cloud of Open3D or PyVista; or a PointCloud2 of ROS.
    overrides  what is known better than it can be found out; None: everything is found out.
    Raises InputError for a file that is missing, of no known format or damaged, and for what is no sweep.
    """
    if isinstance(source, str | Path) and recording_reader(Path(source)):
        return next(scans(source, overrides))
    return readers.read(source, overrides)


def scans(
    path: str | Path,
    overrides: Overrides | None = None,
    *,
    topic: str = "",
    every: int = 1,
    start_s: float | None = None,
    end_s: float | None = None,
) -> Iterator[Scan]:
    """Yield the scans of a file, a folder or a recording one at a time, those of one stream read alike.

    topic           of a recording that has several topics of points; "" for the only one.
    every           one of so many scans of a recording or folder.
    start_s, end_s  seconds after the start of the recording or folder; the end is not included.
    Raises InputError for what cannot be read.
    """
    options = ReadOptions(topic=topic, every=every, start_s=start_s, end_s=end_s)
    for one in drive_scans(path, options, overrides):
        yield one.scan


def drive_scans(path: str | Path, options: ReadOptions, overrides: Overrides | None = None) -> Iterator[DriveScan]:
    """The scans of `scans`, each with where it is from."""
    stream, like = None, None
    for file in drive_files(Path(path), options):
        reader = recording_reader(file)
        here = file if reader else file.parent
        for cloud in (reader or readers.open_path(file)).clouds(file, options):
            try:
                scan, found = interpret(cloud, overrides, like if here == stream else None)
            except InputError as error:
                raise InputError(f"{file}: {error}") from None
            if here != stream:
                stream, like = here, found
            yield DriveScan(file=file, stream=here, scan=scan, found=found)


def drive_files(path: Path, options: ReadOptions) -> list[Path]:
    """The scan files and recordings that a path stands for: itself, or a folder's that are wanted, by name.

    A ROS 2 bag's folder stands for itself. Raises InputError as `scan_files`, and where --from or --to is given for
    scans of unknown times.
    """
    if (path / METADATA).is_file():
        return [path]
    recordings = _recordings(path)
    try:
        files = scan_files(path)
    except InputError:
        if not recordings:
            raise
        files = []
    return (wanted(files, options) if path.is_dir() else files) + recordings


def wanted(files: Sequence[Path], options: ReadOptions) -> list[Path]:
    """Those scan files of one folder that lie between --from and --to, and of these one of --every."""
    files = list(files)
    if files and (options.start_s is not None or options.end_s is not None):
        stamps_s = times(files)
        if stamps_s is None:
            raise InputError(
                f"{files[0].parent}: --from and --to need the scans' times: {', '.join(TIMES)}, or names in nanoseconds"
            )
        folder = files[0].parent
        after_s = [stamp_s - stamps_s[0] for stamp_s in stamps_s]
        start_s, end_s = options.start_s or 0.0, after_s[-1] + 1 if options.end_s is None else options.end_s
        files = [file for file, offset_s in zip(files, after_s, strict=True) if start_s <= offset_s < end_s]
        if not files:
            raise none_within(folder, after_s[-1])
    return files[:: options.every]


def times(files: Sequence[Path]) -> list[float] | None:
    """When the scans of one folder were taken, seconds: by a list of times beside them, or by their names.

    None where neither is there. Raises InputError where the list is damaged or too short.
    """
    folder = files[0].parent
    for path in (place / name for place in (folder, folder.parent) for name in TIMES):
        if path.is_file():
            return _listed(path, files)
    stems = [stem_of(file) for file in files]
    if all(stem.isdecimal() and len(stem) in UNIT_S for stem in stems):
        return [int(stem) * UNIT_S[len(stem)] for stem in stems]
    return None


def _listed(path: Path, files: Sequence[Path]) -> list[float]:
    """The line of a file of times that each scan's number names, from 0; the n-th for scans without numbers."""
    try:
        lines = read_json(path) if path.suffix == ".json" else read_text(path).split("\n")
        stamps_s = [_seconds(line) for line in lines if str(line).strip()]
    except InputError:
        raise
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{path}: cannot be read as times ({error}); write one a line, in seconds") from error
    stems = [stem_of(file) for file in files]
    numbers = [int(stem) for stem in stems] if all(stem.isdecimal() for stem in stems) else range(len(stems))
    if max(numbers) >= len(stamps_s):
        raise InputError(f"{path}: holds {len(stamps_s)} times, none for scan {max(numbers)}; line n is scan n, from 0")
    return [stamps_s[number] for number in numbers]


def _seconds(line: str | float) -> float:
    try:
        return float(line)
    except ValueError:  # KITTI raw: 2011-09-26 13:02:25.964389445
        return datetime.fromisoformat(str(line).strip()[:26]).replace(tzinfo=UTC).timestamp()


def _recordings(path: Path) -> list[Path]:
    if not path.is_dir():
        return []
    try:
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in ENDINGS and file.is_file())
        return [file for file in files if not file.name.startswith(".")]
    except OSError as error:
        raise InputError(f"{path}: cannot be looked into ({error.strerror}); ask for permission") from error
