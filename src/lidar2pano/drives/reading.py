"""Readings of a drive: scans one after the other, all of a stream as its first one was read, without skew, with poses.

Commands, fleets, servers and nodes read scans here, those of a growing folder as soon as each is complete;
`translation` turns readings into panoramas.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, TypeAlias

import numpy as np
import torch

from lidar2pano.calibration import Calibration, LensCalibration
from lidar2pano.drives.camera_choice import CameraOptions, may_have_cameras
from lidar2pano.drives.drive_motion import Motion, T_scan_cloud, motion_of
from lidar2pano.drives.folders import drive_files, output_stems
from lidar2pano.errors import InputError
from lidar2pano.formats.file_contents import stem_of
from lidar2pano.formats.interpretation import Interpretation, Overrides, interpret
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.geometry.stitching import Camera
from lidar2pano.hardware import Timer
from lidar2pano.recordings import reading_process
from lidar2pano.recordings.recorded_scans import recording_reader
from lidar2pano.scan import Scan

if TYPE_CHECKING:
    from lidar2pano.drives.cameras import RecordingCameras, ScanCameras

CPU = torch.device("cpu")

LOOK_S = 0.2  # between looks into the folder
SETTLED_S = 1.0  # a file unchanged for so long is complete
GIVE_UP_S = 10.0  # an unreadable one may still grow for so long
Version = tuple[int, int]  # size in bytes and time of the last change in nanoseconds


@dataclass(frozen=True, kw_only=True)
class ScanSource:
    """A scan to be read.

    path    of the scan file or recording;  title: for messages;  stem: of its outputs' names.
    cloud   returns its points; raises InputError for damage.
    stream  the scans of one stream follow each other in time: a folder, a recording; None for a scan by itself.
    number  of a recording's scan, None for a scan file.
    """

    path: Path
    title: str
    stem: str
    cloud: Callable[[], PointCloud]
    stream: Hashable = None
    number: int | None = None


@dataclass(frozen=True, kw_only=True)
class Reading:
    """A scan as it was read, or the error of reading it.

    scan            named by the source's title; None with an error.
    interpretation  how the cloud was read.
    pose            (4, 4) float64 T_world_sensor, metres; None if it is unknown or not wanted.
    labels          (N,) int64 ids of SEMANTIC_KITTI in place of the segmenter's; None: the segmenter's.
    calibration     of the camera at whose optical centre the panorama stands; None: the pipeline's own place.
    cameras         of the same moment, in the scan's frame;  camera_doubts: a sentence on each unreadable one.
    timer           milliseconds of the stages "read" and "pose"; translation goes on with it.
    """

    source: ScanSource
    scan: Scan | None = None
    interpretation: Interpretation | None = None
    pose: np.ndarray | None = None
    labels: np.ndarray | None = None
    calibration: Calibration | LensCalibration | None = None
    cameras: tuple[Camera, ...] = ()
    camera_doubts: tuple[str, ...] = ()
    timer: Timer = field(default_factory=partial(Timer, CPU))
    error: Exception | None = None


CameraReader: TypeAlias = "Callable[[ScanSource, Interpretation], ScanCameras]"


@dataclass(frozen=True, kw_only=True)
class ReadingOptions:
    """Options of reading scans.

    selection  of scans of a folder or recording;  overrides: facts about them.
    motion     whether recorded motion of the sensor takes the skew out of scans whose points have times.
    poses      whether a pose is wanted for each scan: estimated by KISS-ICP unless recorded.
    strict     whether an implausible scan is an error.
    cameras    that are read with each scan; None: none.
    """

    selection: ReadOptions = field(default_factory=ReadOptions)
    overrides: Overrides = field(default_factory=Overrides)
    motion: bool = True
    poses: bool = False
    strict: bool = False
    cameras: CameraOptions | None = None


class StreamReader:
    """Reads scan after scan; the first one of each stream tells how the others are read, and how the sensor moves."""

    def __init__(self, options: ReadingOptions | None = None) -> None:
        self._options = options or ReadingOptions()
        self._stream: Hashable = None
        self._first: Interpretation | None = None
        self._motion: Motion | None = None
        self._cameras: CameraReader | None = None
        self._close: Callable[[], None] | None = None  # of the stream's cameras

    def read(self, source: ScanSource) -> Reading:
        """Read a scan. Raises InputError for damaged poses of its stream: they are missing to all its scans."""
        followed = source.stream is not None and source.stream == self._stream
        reading = read_scan(source, self._options, self._first if followed else None)
        if reading.scan is None or reading.interpretation is None:
            return reading
        if not followed:
            self._stream, self._first, self._motion = source.stream, reading.interpretation, None
            if isinstance(source.stream, Path) and self._options.motion:
                selection, poses = self._options.selection, self._options.poses
                self._motion = motion_of(source.stream, reading.scan, reading.interpretation, selection, poses)
            self._open_cameras(source)
        reading = move_scan(reading, self._motion, self._options.poses) if self._motion else reading
        return read_cameras(reading, self._cameras, self._options.cameras) if self._cameras else reading

    def __call__(self, sources: Iterable[ScanSource]) -> Iterator[Reading]:
        """Read scans one at a time."""
        try:
            yield from map(self.read, sources)
        finally:
            self.close()

    def _open_cameras(self, source: ScanSource) -> None:
        """Look for the cameras of a stream once; InputError for topics that are not in its recording."""
        self.close()
        options = self._options.cameras
        if options is None:
            return
        if source.number is None or options.named:
            if options.topics:
                raise InputError(f"--cameras {','.join(options.topics)}: {source.title} is no recording; leave it out")
            if options.named or may_have_cameras(source.path):
                self._cameras = partial(_cameras_of_file, options)
        elif isinstance(source.stream, Path):
            from lidar2pano.drives.cameras import RecordingCameras

            cameras = RecordingCameras(source.path, options)
            if cameras:
                self._cameras, self._close = partial(_cameras_of_message, cameras), cameras.close
            else:
                cameras.close()

    def close(self) -> None:
        """Close the stream's cameras."""
        if self._close:
            self._close()
        self._cameras = self._close = None


def read_scan(source: ScanSource, options: ReadingOptions, first: Interpretation | None = None) -> Reading:
    """Read a scan like the first one of its stream; a damaged one gives a reading with an error."""
    reading = Reading(source=source)
    try:
        with reading.timer("read"):
            cloud = replace(source.cloud(), name=source.title)
            try:
                scan, interpretation = interpret(cloud, options.overrides, first)
            except InputError as error:
                raise InputError(f"{source.title}: {error}") from None
            if options.strict and interpretation.doubts:
                raise InputError(f"{source.title}: {interpretation.doubts[0]} (an error because of --strict)")
    except InputError as error:
        return replace(reading, error=error)
    return replace(reading, scan=scan, interpretation=interpretation)


def move_scan(reading: Reading, motion: Motion, poses: bool) -> Reading:
    """Take the skew out of a reading's scan, and give it its pose if `poses`; an unknown place is its error."""
    if reading.scan is None or reading.interpretation is None:
        return reading
    try:
        with reading.timer("pose"):
            scan, pose = motion(reading.source.path, reading.scan, reading.interpretation)
    except InputError as error:
        return replace(reading, error=error)
    return replace(reading, scan=scan, pose=pose if poses else None)


def read_cameras(reading: Reading, find: CameraReader, options: CameraOptions | None) -> Reading:
    """Read the cameras of a reading's scan. InputError for a wrong number of masks."""
    if reading.error or reading.interpretation is None or options is None:
        return reading
    with reading.timer("images"):
        cameras = find(reading.source, reading.interpretation)
    if not cameras.cameras and not cameras.doubts:
        del reading.timer.milliseconds["images"]
        return reading
    viewpoint = cameras.viewpoint if options.viewpoint else None
    return replace(reading, cameras=cameras.cameras, camera_doubts=cameras.doubts, calibration=viewpoint)


def _cameras_of_file(options: CameraOptions, source: ScanSource, interpretation: Interpretation) -> ScanCameras:
    from lidar2pano.drives.cameras import cameras_of  # and readers of data sets: few scans need them

    stem = stem_of(source.path) if source.number is None else source.stem
    return cameras_of(source.path, stem, options, T_scan_cloud(interpretation))


def _cameras_of_message(cameras: RecordingCameras, source: ScanSource, interpretation: Interpretation) -> ScanCameras:
    return cameras.of(interpretation.stamp_s or 0.0, interpretation.frame, T_scan_cloud(interpretation))


def scan_sources(
    files: Iterable[Path], selection: ReadOptions, stems: Mapping[Path, str] | None = None
) -> Iterator[ScanSource]:
    """Yield the scans of files and recordings; an unreadable one is among them, and fails when it is read.

    stems  of the outputs' names by file; None: `output_stems`.
    """
    files = list(files)
    stems = output_stems(files) if stems is None else stems
    for file in files:
        try:
            reader = recording_reader(file)
            if reader is None:
                yield _file_source(file, stems[file], partial(reading_process.read_cloud, file))
                continue
            for frame in reading_process.frames(file, selection):
                yield ScanSource(
                    path=file,
                    title=frame.title,
                    stem=stems[file] + frame.name.removeprefix(file.stem),
                    cloud=frame.cloud,
                    stream=file,
                    number=frame.number,
                )
        except InputError as error:
            yield _file_source(file, stems[file], partial(_fail, error))


def _file_source(file: Path, stem: str, cloud: Callable[[], PointCloud]) -> ScanSource:
    return ScanSource(path=file, title=str(file), stem=stem, cloud=cloud, stream=file.parent)


def _fail(error: InputError) -> NoReturn:
    raise error


def posed_scans(
    path: str | Path,
    *,
    topic: str = "",
    every: int = 1,
    start_s: float | None = None,
    end_s: float | None = None,
    overrides: Overrides | None = None,
) -> Iterator[tuple[Scan, np.ndarray | None]]:
    """Yield the scans of a recording or folder, without skew, each with T_world_sensor (4, 4) float64.

    topic, every, start_s, end_s  choose scans as in `scans`;  overrides: as in `read`.
    A pose is None at times of unknown motion. Raises InputError as `scans`, for damaged poses, and without recorded
    ones if KISS-ICP (extra `recordings`) is missing.
    """
    selection = ReadOptions(topic=topic, every=every, start_s=start_s, end_s=end_s)
    options = ReadingOptions(selection=selection, overrides=overrides or Overrides(), poses=True)
    return ((scan, reading.pose) for scan, reading in _named_scans(Path(path), options))


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

    topic           of a recording with several topics of points; "" for the only one.
    every           one of so many scans of a recording or folder.
    start_s, end_s  seconds after the start of the recording or folder; the end is not included.
    Raises InputError for an unreadable path or scan.
    """
    selection = ReadOptions(topic=topic, every=every, start_s=start_s, end_s=end_s)
    options = ReadingOptions(selection=selection, overrides=overrides or Overrides(), motion=False)
    return (scan for scan, _ in _named_scans(Path(path), options))


def _named_scans(path: Path, options: ReadingOptions) -> Iterator[tuple[Scan, Reading]]:
    """Yield the scans of a path, named by their files' stems, with their readings; raise a reading's error."""
    files = drive_files(path, options.selection)
    stems = {file: stem_of(file) for file in files}
    for reading in StreamReader(options)(scan_sources(files, options.selection, stems)):
        if reading.error or reading.scan is None:
            raise reading.error or AssertionError
        yield replace(reading.scan, name=reading.source.stem), reading


def check_followed(paths: Sequence[Path], selection: ReadOptions) -> Path:
    """Return the one folder to follow; InputError for anything else."""
    if len(paths) != 1 or not paths[0].is_dir():
        raise InputError(f"--follow {' '.join(map(str, paths))}: name one folder, into which scans are written")
    if selection.start_s is not None or selection.end_s is not None:
        raise InputError("--follow takes scans as they come; leave out --from and --to")
    return paths[0]


def follow_folder(folder: Path, selection: ReadOptions, stopped: threading.Event) -> Iterator[ScanSource]:
    """Yield the scans of a folder as they are completed, in order of their names, until `stopped` is set.

    A later change of a file takes it again; an unreadable one fails after GIVE_UP_S only.
    """
    taken: dict[Path, Version] = {}
    first_look: dict[Path, tuple[Version, float]] = {}
    owner: dict[str, Path] = {}  # of a stem: its first file
    arrived = 0
    while not stopped.is_set():
        for file, version, age_s in _settled_files(folder, taken, first_look):
            if stopped.is_set():
                return
            stem, path_name = stem_of(file), "-".join(file.relative_to(folder).parts)
            stems = {file: stem if owner.setdefault(stem, file) == file else path_name}
            new = file not in taken
            arrived += new
            if new and (arrived - 1) % selection.every:
                taken[file] = version
                continue
            for source in _readable_sources(scan_sources([file], selection, stems), age_s > GIVE_UP_S):
                taken[file] = version
                yield source
            arrived -= new and file not in taken
        stopped.wait(LOOK_S)


def _settled_files(
    folder: Path, taken: dict[Path, Version], first_look: dict[Path, tuple[Version, float]]
) -> list[tuple[Path, Version, float]]:
    """List complete files, not taken in this version: path, version, seconds since the last change.

    first_look  when each version of a file was first seen, by a clock that does not jump; it alone tells completeness.
    """
    try:
        files = drive_files(folder, ReadOptions())
    except InputError:
        if not folder.is_dir():
            raise
        return []  # none yet
    settled = []
    for file in files:
        try:
            status = file.stat()
        except FileNotFoundError:
            continue  # renamed or removed since
        version, now_s = (status.st_size, status.st_mtime_ns), time.monotonic()
        if taken.get(file) == version:
            continue
        if first_look.get(file, (None, 0.0))[0] != version:
            first_look[file] = version, now_s
        unchanged_s = now_s - first_look[file][1]
        if unchanged_s >= SETTLED_S:
            settled.append((file, version, max(unchanged_s, time.time() - status.st_mtime)))
    return settled


def _readable_sources(sources: Iterator[ScanSource], final: bool) -> Iterator[ScanSource]:
    """Yield the scans of a file, the first one decoded; none for an unreadable file, unless this is `final`."""
    for index, source in enumerate(sources):
        if index:
            yield source
            continue
        try:
            cloud = source.cloud()
        except InputError:
            if not final:
                return
            yield source
        else:
            yield replace(source, cloud=lambda cloud=cloud: cloud)
