"""Recordings: their contents, their scans in time, selected by topic, time and number."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano.bounded_files import open_regular
from lidar2pano.errors import InputError
from lidar2pano.formats import readers
from lidar2pano.formats.file_contents import HEAD_BYTES, head_of, is_packed, unpacked_copy
from lidar2pano.formats.interpretation import Overrides, interpret
from lidar2pano.formats.point_cloud import NoPointsError, PointCloud
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.geometry.motion import SensorMotion
from lidar2pano.recordings import transforms
from lidar2pano.recordings.description import Description, RawMessage, Recording
from lidar2pano.recordings.joined_topics import join_topics
from lidar2pano.recordings.mcap_files import MAGIC, McapFile
from lidar2pano.recordings.osf_files import OsfFile, is_osf
from lidar2pano.recordings.packet_captures import PCAP, PCAPNG, PacketCapture
from lidar2pano.recordings.ros_bags import METADATA, ROSBAG, SQLITE, open_folder, open_ros1, open_sqlite
from lidar2pano.scan import Scan

ENDINGS = (".bag", ".db3", ".mcap", ".pcap", ".pcapng", ".osf")  # of recordings among a folder's files


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """A scan of a recording.

    path     of the recording;  number: of the scan among all of its topic, from 0.
    stamp_s  when it was recorded, seconds since the epoch.
    sha256   of its content as recorded, in hexadecimal.
    decoded  its points, or the error of a damaged or empty one.
    """

    path: Path
    number: int
    stamp_s: float
    sha256: str
    decoded: PointCloud | InputError

    @classmethod
    def of(cls, recording: Recording, number: int, message: RawMessage) -> Frame:
        """Return a message as the scan of a number, with the time of recording for one without a stamp of its own."""
        path, stamp_s, sha256 = recording.path, message.stamp_ns * 1e-9, hashlib.sha256(message.data).hexdigest()
        frame = cls(path=path, number=number, stamp_s=stamp_s, sha256=sha256, decoded=InputError())
        try:
            cloud = recording.cloud(message, frame.title)
            cloud.require_points(frame.title)
        except InputError as error:
            return replace(frame, decoded=error)
        return replace(frame, decoded=replace(cloud, name=frame.name, stamp_s=cloud.stamp_s or stamp_s))

    @property
    def name(self) -> str:
        """The recording's stem and the scan's number: the name of its outputs."""
        return f"{self.path.stem}-{self.number:06d}"

    @property
    def title(self) -> str:
        """The recording's path and the scan's number, for messages."""
        return f"{self.path}, scan {self.number}"

    def cloud(self) -> PointCloud:
        """Return the points; InputError for damaged or missing ones, NoPointsError without any."""
        if isinstance(self.decoded, InputError):
            raise self.decoded
        return self.decoded


@dataclass(frozen=True)
class RecordingReader:
    """Reader of a format for a drive in a file or folder.

    accepts  (first bytes, path) -> whether the file is of this format.
    opens    path -> the open recording;  packed: by gzip or zstd as a whole; a copy is opened.
    """

    name: str
    accepts: Callable[[bytes, Path], bool]
    opens: Callable[[Path], Recording]
    packed: bool = False

    def open(self, path: Path) -> Recording:
        """Return the open recording; InputError if it is damaged."""
        if not self.packed:
            return self.opens(path)
        with ExitStack() as stack:
            recording = self.opens(stack.enter_context(unpacked_copy(path)))
            stack.callback(recording.files.close)
            recording.path, recording.files = path, stack.pop_all()
        return recording


def span_ns(origin_ns: int, options: ReadOptions) -> tuple[int | None, int | None]:
    """Return --from and --to in nanoseconds since the epoch."""
    start_ns, end_ns = (
        None if offset_s is None else origin_ns + round(offset_s * 1e9) for offset_s in (options.start_s, options.end_s)
    )
    return start_ns, end_ns


def none_selected(path: Path, duration_s: float, selection: ReadOptions) -> InputError:
    """Return the error for a selection of scans in which there is none."""
    if selection.start_s is None and selection.end_s is None:
        return InputError(f"{path}: holds no scan; record it again")
    return InputError(f"{path}: has no scan between --from and --to; it lasts {duration_s:.1f} s")


RECORDINGS: tuple[RecordingReader, ...] = (
    RecordingReader("ROS 1 bag", lambda head, _: head.startswith(ROSBAG), open_ros1),
    RecordingReader("ROS 2 bag (db3)", lambda head, _: head.startswith(SQLITE), open_sqlite),
    RecordingReader("MCAP", lambda head, _: head.startswith(MAGIC), McapFile),
    RecordingReader("packet capture", lambda head, _: head[:4] in {*PCAP, PCAPNG}, PacketCapture),
    RecordingReader("OSF", lambda head, _: is_osf(head), OsfFile),
)
FOLDER = RecordingReader("ROS 2 bag", lambda _, path: (path / METADATA).is_file(), open_folder)


def recording_reader(path: Path) -> RecordingReader | None:
    """Return the reader of a recording, a file or a ROS 2 bag's folder; None for any other file or folder.

    Raises InputError if the file cannot be read.
    """
    if path.is_dir():
        return FOLDER if FOLDER.accepts(b"", path) else None
    try:
        with open_regular(path) as file:
            head = file.read(HEAD_BYTES)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); name a file that exists") from error
    packed = is_packed(head)
    head = head_of(path) if packed else head
    reader = next((reader for reader in RECORDINGS if reader.accepts(head, path)), None)
    return replace(reader, packed=True) if packed and reader else reader


def open_recording(path: Path) -> Recording:
    """Return a recording, opened; InputError if it is damaged, or none."""
    reader = recording_reader(path)
    if reader is None:
        raise InputError(f"{path}: is no recording ({', '.join(reader.name for reader in RECORDINGS)}); name one")
    return reader.open(path)


def describe(path: Path) -> Description | None:
    """Return the contents of a recording; None for anything else. Raises InputError for a damaged one."""
    if recording_reader(path) is None:
        return None
    with closing(open_recording(path)) as recording:
        return recording.description


def frames(path: Path, options: ReadOptions) -> Iterator[Frame]:
    """Yield the selected scans of a recording in time; InputError for a damaged one, and without any.

    Scans without points before the first one with some are passed over and are its doubt: drivers send them before
    their sensor turns. If there are no others, they fail.
    """
    empty: list[Frame] | None = []
    for frame in _all_frames(path, options):
        if empty is not None and isinstance(frame.decoded, NoPointsError):
            empty.append(frame)
        else:
            yield _after_empty(frame, len(empty)) if empty else frame
            empty = None
    yield from empty or ()


def _after_empty(frame: Frame, count: int) -> Frame:
    """Return a scan with a doubt about so many before it."""
    if isinstance(frame.decoded, InputError):
        return frame
    doubt = f"{count} of the recording's scans before it hold no points, and are passed over"
    return replace(frame, decoded=replace(frame.decoded, doubts=(*frame.decoded.doubts, doubt)))


def _all_frames(path: Path, options: ReadOptions) -> Iterator[Frame]:
    with closing(join_topics(open_recording(path), options.topic)) as recording:
        topic = recording.choose(options.topic)
        start_ns, end_ns = span_ns(recording.origin_ns(topic), options)
        skipped_ns = start_ns if recording.indexed else None
        first = 0 if skipped_ns is None else int(np.count_nonzero(recording.stamps_ns(topic) < skipped_ns))
        start = None
        for number, message in enumerate(recording.messages((topic,), skipped_ns, end_ns), first):
            if start_ns is None or message.stamp_ns >= start_ns:
                start = number if start is None else start
                if (number - start) % options.every == 0:
                    yield Frame.of(recording, number, message)
        if start is None:
            raise none_selected(path, recording.description.duration_s, options)


def read(source: Any, overrides: Overrides | None = None) -> Scan:  # noqa: ANN401
    """Read one scan.

    source     path of a file of a known format, whatever its name; of a recording the first scan is read; or an array
               (N, 3 or more) of x y z [intensity [ring]]; or a cloud of Open3D or PyVista; or a PointCloud2 of ROS.
    overrides  known facts; None: everything is found out.
    Raises InputError for a missing or damaged file, an unknown format, and for anything but a single sweep.
    """
    if isinstance(source, str | Path) and recording_reader(Path(source)):
        cloud = next(frames(Path(source), ReadOptions())).cloud()
        try:
            return interpret(cloud, overrides)[0]
        except InputError as error:
            raise InputError(f"{source}: {error}") from None
    return readers.read(source, overrides)


def recorded_motion(path: Path, options: ReadOptions, frame: str) -> tuple[SensorMotion, str] | None:
    """Return the motion of a coordinate frame in a recording, and the name of its origin; None without one.

    Poses are read for the times of `options` only. Raises InputError at damage.
    """
    with closing(open_recording(path)) as recording:
        return transforms.recorded_motion(recording, frame, *span_ns(recording.description.first_ns, options))
