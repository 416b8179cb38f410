"""Scan files and recordings of a folder: selection, times, names of their outputs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path

from lidar2pano.bounded_files import read_text
from lidar2pano.drives.scan_search import check_file, find_scans
from lidar2pano.errors import InputError
from lidar2pano.formats.file_contents import stem_of
from lidar2pano.formats.json_files import read_json
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.recordings.recorded_scans import none_within

TIMES = ("times.txt", "timestamps.txt", "timestamps.json")  # KITTI odometry, KITTI raw, PandaSet
UNIT_S = {19: 1e-9, 18: 1e-9, 16: 1e-6}  # digits of a name, a time since the epoch -> its unit


def drive_files(path: Path, options: ReadOptions) -> list[Path]:
    """Return the scan files and recordings of a path: itself, or the selected ones of each folder, by name.

    Raises InputError as `check_file` and `find_scans`, and for --from or --to with scans of unknown times.
    """
    if not path.is_dir():
        return [check_file(path)]
    files: list[Path] = []
    for (_, recording), group in groupby(find_scans(path), lambda source: (source.folder, source.recording)):
        paths = [path / source.name for source in group]
        files += paths if recording else select_files(paths, options)
    return files


def select_files(files: Sequence[Path], options: ReadOptions) -> list[Path]:
    """Return the scan files of one folder between --from and --to, and of these one of --every."""
    files = list(files)
    if files and (options.start_s is not None or options.end_s is not None):
        folder, stamps_s = files[0].parent, times(files)
        if stamps_s is None:
            raise InputError(
                f"{folder}: --from and --to need the scans' times: {', '.join(TIMES)}, or names in nanoseconds"
            )
        offsets_s = [stamp_s - stamps_s[0] for stamp_s in stamps_s]
        start_s, end_s = options.start_s or 0.0, offsets_s[-1] + 1 if options.end_s is None else options.end_s
        files = [file for file, offset_s in zip(files, offsets_s, strict=True) if start_s <= offset_s < end_s]
        if not files:
            raise none_within(folder, offsets_s[-1])
    return files[:: options.every]


def times(files: Sequence[Path]) -> list[float] | None:
    """Return when the scans of one folder were taken, seconds: by a list of times beside them, or by their names.

    None without either. Raises InputError for a damaged or too short list.
    """
    folder = files[0].parent
    for path in (place / name for place in (folder, folder.parent) for name in TIMES):
        if path.is_file():
            return _listed_times(path, files)
    stems = [stem_of(file) for file in files]
    if all(stem.isdecimal() and len(stem) in UNIT_S for stem in stems):
        return [int(stem) * UNIT_S[len(stem)] for stem in stems]
    return None


def _listed_times(path: Path, files: Sequence[Path]) -> list[float]:
    """Return each scan's line of a file of times: by its number, from 0; the n-th for scans without numbers."""
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


def output_stems(files: Sequence[Path]) -> dict[Path, str]:
    """Return the name of each file's outputs: its stem; for equal ones, with folders' names in front."""
    from lidar2pano.panorama import STEM_ENDINGS  # and torch, which `inspect` does not need

    paths = {file: (*file.resolve().parts[1:-1], stem_of(file)) for file in files}
    stems = {file: stem_of(file) for file in files}
    for depth in range(2, 2 + max((len(parts) for parts in paths.values()), default=0)):
        shared = {stem for stem, count in Counter(stems.values()).items() if count > 1}
        if not shared:
            break
        stems |= {file: "-".join(_without_velodyne(paths[file])[-depth:]) for file in files if stems[file] in shared}
    outputs = {f"{stem}{ending}" for stem in stems.values() for ending in ("", *STEM_ENDINGS)}
    if len(outputs) < (1 + len(STEM_ENDINGS)) * len(files):  # another suffix only, or "a" beside "a.segments"
        stems = {file: "-".join(file.resolve().parts[1:]) for file in files}
    return stems


def _without_velodyne(parts: tuple[str, ...]) -> tuple[str, ...]:
    """Return a path's parts without the folder of every sequence."""
    return tuple(part for part in parts[:-1] if part != "velodyne") + parts[-1:]
