"""Scan files and recordings below a folder or URL, found alike by all commands: selection, times, names of outputs."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from itertools import groupby, islice
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from lidar2pano.bounded_files import read_lines
from lidar2pano.errors import InputError
from lidar2pano.formats.delimited_text import is_table
from lidar2pano.formats.file_contents import PACKED, head_of, stem_of
from lidar2pano.formats.foreign_files import DOWNLOAD, OTHER, foreign_kind
from lidar2pano.formats.json_files import read_json
from lidar2pano.formats.readers import ENDINGS, READERS, TEXT_ENDINGS, ReadOptions
from lidar2pano.name_order import sort_names
from lidar2pano.recordings.recorded_scans import ENDINGS as RECORDINGS
from lidar2pano.recordings.recorded_scans import METADATA, none_selected, recording_reader

TIMES = ("times.txt", "timestamps.txt", "timestamps.json")  # KITTI odometry, KITTI raw, PandaSet
UNIT_S = {19: 1e-9, 18: 1e-9, 16: 1e-6}  # digits of a name, a time since the epoch -> its unit

STORAGE = (".db3", ".mcap", ".db3.zstd", ".mcap.zstd")  # endings of the files of a ROS 2 bag's folder
# Folders of data sets with files of scans' endings: SemanticKITTI's occupancy, nuScenes' labels, labels of images,
# poses
NO_SCANS = ("voxels", "lidarseg", "panoptic", "labels", "oxts")
# The last folders of scans in data sets whose roots are read as a whole: KITTI's and SemanticKITTI's sequences, KITTI's
# raw drives and KITTI-360, KITTI's tracking, nuScenes, Argoverse 2
DATA_SETS = ("velodyne", "velodyne_points/data", "velodyne/[0-9]*", "LIDAR_*", "sensors/lidar")
# Fields of radars' PCDs, nuScenes' among them
RADAR = re.compile(rb"(?im)^(?:FIELDS|COLUMNS) .*\b(?:rcs|dyn_prop|vx_comp|range_rate)\b")
MOST_NAMES = 1 << 20  # looked through below a folder without scans of its own
TABLES = (".feather", ".parquet", *TEXT_ENDINGS)  # of points, or of poses and boxes
# Names of tables beside scans, without points
NO_POINTS = re.compile(r"(?i)pose|traj|calib|time|odom|gps|gnss|imu|oxts|label")
MOST_NAMED = 3  # folders in a message
Head = Callable[[str], bytes]


def drive_files(path: Path, options: ReadOptions) -> list[Path]:
    """Return the scan files and recordings of a path: itself, or the selected ones of each folder, by name.

    Raises InputError as `check_file` and `find_scans`, for --from or --to with scans of unknown times or a single scan,
    and for --topic without a recording.
    """
    if not path.is_dir():
        if replace(options, every=1) != ReadOptions() and recording_reader(check_file(path)) is None:
            raise InputError(f"{path}: is a single scan; leave out --topic, --from and --to")
        return [check_file(path)]
    files: list[Path] = []
    sources = find_scans(path)
    check_topic(path, sources, options)
    for (_, recording), group in groupby(sources, lambda source: (source.folder, source.recording)):
        paths = [path / source.name for source in group]
        files += paths if recording else select_files(paths, options)
    return files


def check_topic(place: object, sources: Iterable[Source], options: ReadOptions) -> None:
    """Raise InputError for --topic where no recording has topics."""
    if options.topic and not any(source.recording for source in sources):
        raise InputError(f"{place}: holds no recording; leave out --topic {options.topic}")


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
            raise none_selected(folder, offsets_s[-1], options)
    return files[:: options.every]


def times(files: Sequence[Path]) -> list[float] | None:
    """Return when the scans of one folder were taken, seconds: by a list of times beside them, or by their names.

    None without either. Raises InputError for a damaged or too short list.
    """
    folder = files[0].parent
    for path in (place / name for place in (folder, folder.absolute().parent) for name in TIMES):
        if path.is_file():
            return _listed_times(path, files)
    stems = [stem_of(file) for file in files]
    if all(stem.isdecimal() and len(stem) in UNIT_S for stem in stems):
        return [int(stem) * UNIT_S[len(stem)] for stem in stems]
    return None


def _listed_times(path: Path, files: Sequence[Path]) -> list[float]:
    """Return each scan's line of a file of times: by its number, from 0; the n-th for scans without numbers."""
    try:
        lines = read_json(path) if path.suffix == ".json" else read_lines(path)
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
    from lidar2pano.panorama import STEM_ENDINGS  # and torch: `inspect` needs none

    paths = {file: (*file.resolve().parts[1:-1], stem_of(file)) for file in files}
    stems = {file: stem_of(file) for file in files}
    for depth in range(2, 2 + max((len(parts) for parts in paths.values()), default=0)):
        shared = {stem for stem, count in Counter(stems.values()).items() if count > 1}
        if not shared:
            break
        stems |= {file: "-".join(_without_velodyne(paths[file])[-depth:]) for file in files if stems[file] in shared}
    recordings = {file: file.is_dir() or _unpacked(file.name).lower().endswith(RECORDINGS) for file in files}
    if clashing({Source(str(file), recordings[file]): stem for file, stem in stems.items()}, STEM_ENDINGS):
        stems = {file: "-".join(file.resolve().parts[1:]) for file in files}
    return stems


def _without_velodyne(parts: tuple[str, ...]) -> tuple[str, ...]:
    """Return a path's parts without the folder of every sequence."""
    return tuple(part for part in parts[:-1] if part != "velodyne") + parts[-1:]


class Source(NamedTuple):
    """A scan file or a recording, by its name below the root."""

    name: str
    recording: bool

    @property
    def folder(self) -> str:
        """Name of its folder."""
        return self.name.rpartition("/")[0]


def clashing(stems: Mapping[Source, str], endings: Sequence[str]) -> list[Source]:
    """List the scan files and recordings with an output of the same name as another one.

    stems  of their outputs' names, to which a recording adds each scan's number;  endings: of stems of further outputs.
    """
    outputs = {
        source: {f"{stem}{'-#' if source.recording else ''}{ending}" for ending in ("", *endings)}
        for source, stem in stems.items()
    }
    count = Counter(name for names in outputs.values() for name in names)
    number = re.compile(rf"-\d{{6,}}(?=({'|'.join(map(re.escape, endings))})?$)")
    numbered = {
        source: {number.sub("-#", name) for name in names} for source, names in outputs.items() if not source.recording
    }
    of_files = {name for names in numbered.values() for name in names}
    of_recordings = {name for source, names in outputs.items() if source.recording for name in names}
    return [
        source
        for source, names in outputs.items()
        if any(count[name] > 1 for name in names)
        or (names & of_files if source.recording else numbered[source] & of_recordings)
    ]


def find_sources(names: Iterable[str], head: Head | None = None) -> list[Source]:
    """Return the scan files and recordings among the names of files, folder by folder, each in the order of names.

    head  name -> first bytes, by which tables of text and radars' detections are told; None: there are no tables, and
          radars are told by their folders' names.
    A ROS 2 bag's folder is one recording. Tables of text count where their folder holds nothing else.
    """
    files_by_folder: dict[str, list[str]] = {}
    for name in names:
        folder, _, file = name.rpartition("/")
        if not file.startswith(".") and not set(NO_SCANS).intersection(folder.split("/")):
            files_by_folder.setdefault(folder, []).append(name)
    sources = [
        source
        for folder in sort_names(files_by_folder)
        for source in _sources_of_folder(folder, files_by_folder[folder], head)
    ]
    in_data_set = any(_in_data_set(source.folder) for source in sources)  # then tables elsewhere are poses and boxes
    return [source for source in sources if not (in_data_set and _is_table(source) and not _in_data_set(source.folder))]


def _sources_of_folder(folder: str, names: list[str], head: Head | None) -> list[Source]:
    recordings = [name for name in names if _unpacked(name).lower().endswith(RECORDINGS)]
    stored = [name for name in recordings if name.lower().endswith(STORAGE)]
    if stored and any(PurePosixPath(name).name == METADATA for name in names):
        recordings = [name for name in recordings if name not in stored] + [folder]
    scans = [name for name in names if _ending(name) in ENDINGS and not _is_radar(name, head)]
    if head and not (scans or recordings):
        scans = [name for name in names if _ending(name) in TEXT_ENDINGS and is_table(head(name))]
    sources = [Source(name, name in recordings) for name in sort_names([*scans, *recordings])]
    return sorted(sources, key=lambda source: source.recording)  # stable


def _is_radar(name: str, head: Head | None) -> bool:
    if head is None:
        return "radar" in name.rpartition("/")[0].lower()
    return _ending(name) == ".pcd" and RADAR.search(head(name)) is not None


def _unpacked(name: str) -> str:
    """Return the name without the ending of its packing."""
    path = PurePosixPath(name)
    return name[: -len(path.suffix)] if path.suffix.lower() in PACKED else name


def _ending(name: str) -> str:
    return PurePosixPath(_unpacked(name)).suffix.lower()


def names_below(root: Path, deep: bool = True) -> Iterator[str]:
    """Yield the names of all files below a folder whose folders are not hidden; not `deep`: of its own files.

    Links to folders are followed, each folder is listed once. InputError for a folder without permission.
    """
    listed: set[tuple[int, int]] = set()
    for folder, folders, files in os.walk(root, followlinks=True, onerror=_refuse):
        state = Path(folder).stat()
        if (state.st_dev, state.st_ino) in listed:
            folders.clear()
            continue
        listed.add((state.st_dev, state.st_ino))
        folders[:] = sort_names(name for name in folders if deep and not name.startswith("."))
        inner = Path(folder).relative_to(root)
        yield from ((inner / name).as_posix() for name in files)


def _refuse(error: OSError) -> None:
    raise InputError(f"{error.filename}: cannot be looked into ({error.strerror}); ask for permission")


def head_below(root: Path, name: str) -> bytes:
    """Return the first bytes of a file below a folder, b"" if it cannot be read: reading it will say why."""
    try:
        return head_of(root / name)
    except InputError:
        return b""


def find_scans(root: Path) -> list[Source]:
    """Return the scan files and recordings of a folder, or of the folders of a data set below its root.

    Raises InputError for a folder without scans of its own, naming folders below with scans.
    """
    head = partial(head_below, root)
    own = find_sources(names_below(root, deep=False), head)
    if not all(map(_is_table, own)):
        return own
    below = find_sources(islice(names_below(root), MOST_NAMES), head)
    if not below and any(_is_radar(name, head) for name in names_below(root)):
        raise InputError(f"{root}: its PCDs are a radar's detections (rcs), no scans; name a folder of a LiDAR's")
    if not below:
        raise _held_instead(root)
    if all(_in_data_set(source.folder) for source in below):
        return below
    if own:
        return own
    raise InputError(f"{root}: holds no scan itself; {_counts(below)}; name a folder, or take all with `bulk`")


def left_out(root: Path, names: Iterable[str]) -> str:
    """Return a note on files that may be scans beside the scan files and recordings of these names; "" for none.

    The first file of each ending in a folder stands for the others. Tables of text count beside other scans only.
    """
    names = set(names)
    folders = {name.rpartition("/")[0] for name in names}
    scan_folders = {name.rpartition("/")[0] for name in names if _ending(name) not in TEXT_ENDINGS}
    groups: dict[tuple[str, str], list[str]] = {}
    for name in names_below(root, deep=folders != {""}):
        (folder, _, file), ending = name.rpartition("/"), _ending(name)
        is_usual = ending in ENDINGS or ending in RECORDINGS or (ending in TEXT_ENDINGS and folder not in scan_folders)
        if folder in folders and name not in names and not is_usual and not file.startswith("."):
            groups.setdefault((folder, ending), []).append(name)
    counts = Counter[str]()
    for (_, ending), group in groups.items():
        if _may_be_scan(root, min(group)):
            counts[ending or "without ending"] += len(group)
    listed = ", ".join(f"{count} {ending}" for ending, count in sorted(counts.items()))
    return f"{root}: files that may be scans are left out ({listed}); `translate` takes them by name" if listed else ""


def _may_be_scan(root: Path, name: str) -> bool:
    head, path = head_below(root, name), root / name
    if not head or foreign_kind(head, path):
        return False
    binary = any(reader.accepts(head, path) for reader in READERS if reader.name != "text")
    return binary or (is_table(head) and not NO_POINTS.search(path.name))


def _held_instead(root: Path) -> InputError:
    """Return the error for a folder without scans: what its most frequent files are, if they are of a known kind."""
    names = sort_names(islice(names_below(root), MOST_NAMES))
    for ending, count in Counter(_ending(name) or name for name in names).most_common(MOST_NAMED):
        name = next(name for name in names if (_ending(name) or name) == ending)
        if (kind := foreign_kind(head_below(root, name), root / name)) and kind.advice not in (OTHER, DOWNLOAD):
            return InputError(f"{root}: holds no scan, but {count} {ending} ({name} is {kind.name}); {kind.advice}")
        if head_below(root, name).startswith(b"PK"):
            return InputError(f"{root}: holds no scan, but archives ({name}); unpack them")
    return no_scan(root)


def no_scan(place: object) -> InputError:
    """Return the error for a folder or URL without scans."""
    endings = ", ".join((*ENDINGS, *TEXT_ENDINGS, *RECORDINGS))
    return InputError(f"{place}: holds no scan (known endings: {endings}); name another folder")


def check_file(path: Path) -> Path:
    """Return the path of a regular file; InputError if it does not exist, or is a device, FIFO or socket."""
    if path.is_file():
        return path
    if path.exists():
        raise InputError(f"{path}: is a device, FIFO or socket, no file; write it to a file, or pipe it into `-`")
    raise InputError(f"{path}: does not exist; name a scan file, a folder of scans or a sequence folder")


def _is_table(source: Source) -> bool:
    return not source.recording and _ending(source.name) in TABLES


def _in_data_set(folder: str) -> bool:
    return any(PurePosixPath(folder).match(pattern) for pattern in DATA_SETS)


def _counts(sources: list[Source]) -> str:
    """Return how many scans the first folders hold, as a clause."""
    counts = Counter(source.folder or source.name for source in sources)
    clauses = [f"{folder} below it holds {count}" for folder, count in list(counts.items())[:MOST_NAMED]]
    further = [f"{len(counts) - MOST_NAMED} more folders hold others"] if len(counts) > MOST_NAMED else []
    return ", ".join([*clauses, *further])
