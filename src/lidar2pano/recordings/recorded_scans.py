"""Recordings: their contents, their scans in time, selected by topic, time and number."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

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
from lidar2pano.recordings.description import MOST_NAMED, Description, RawMessage, Recording, choose_topic, damage
from lidar2pano.recordings.joined_topics import join_topics
from lidar2pano.recordings.mcap_files import MAGIC, McapFile
from lidar2pano.recordings.osf_files import OsfFile, is_osf
from lidar2pano.recordings.ouster_packets import metadata_files, ouster_turns
from lidar2pano.recordings.packet_captures import (
    PCAP,
    PCAPNG,
    VELODYNE,
    PacketCapture,
    cloud_of_turn,
    packets,
)
from lidar2pano.recordings.point_messages import CLOUDS
from lidar2pano.recordings.ros_bags import METADATA, ROSBAG, SQLITE, open_folder, open_ros1, open_sqlite
from lidar2pano.scan import Scan

ENDINGS = (".bag", ".db3", ".mcap", ".pcap", ".pcapng", ".osf")  # of recordings among a folder's files
Decode = Callable[[str], PointCloud]  # title for messages -> points


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """A scan of a recording, not decoded yet.

    path     of the recording;  number: of the scan among all of its topic, from 0.
    stamp_s  when it was recorded, seconds since the epoch.
    decode   (title for messages) -> its points; raises InputError for damaged or missing points.
    content  the source of its points: the bytes of its message, or an array of its packets' measurements.
    digest   SHA-256 of the content, if it is known already.
    """

    path: Path
    number: int
    stamp_s: float
    decode: Decode
    content: bytes | np.ndarray = b""
    digest: str = ""

    @property
    def name(self) -> str:
        """The recording's stem and the scan's number: the name of its outputs."""
        return f"{self.path.stem}-{self.number:06d}"

    @property
    def title(self) -> str:
        """The recording's path and the scan's number, for messages."""
        return f"{self.path}, scan {self.number}"

    def sha256(self) -> str:
        """Return the SHA-256 of its content, in hexadecimal."""
        content = self.content if isinstance(self.content, bytes) else self.content.tobytes()
        return self.digest or hashlib.sha256(content).hexdigest()

    def cloud(self) -> PointCloud:
        """Return the points, with the time of recording for a scan without a stamp of its own.

        Raises NoPointsError without any.
        """
        cloud = self.decode(self.title)
        cloud.require_points(self.title)
        return replace(cloud, name=self.name, stamp_s=cloud.stamp_s or self.stamp_s)


@dataclass(frozen=True)
class RecordingReader:
    """Reader of a format for a drive in a file or folder.

    accepts   (first bytes, path) -> whether the file is of this format.
    describe  path -> its contents;  frames: (path, options) -> its scans, in time.
    open      path -> the open recording, of ROS messages; None for others.
    """

    name: str
    accepts: Callable[[bytes, Path], bool]
    describe: Callable[[Path], Description]
    frames: Callable[[Path, ReadOptions], Iterator[Frame]]
    open: Callable[[Path], Recording] | None = None

    def clouds(self, path: Path, options: ReadOptions) -> Iterator[PointCloud]:
        """Yield the clouds of the recording, one at a time; InputError at the first damaged one.

        Scans without points are passed over; NoPointsError if there are no others.
        """
        empty, count = None, 0
        for frame in self.frames(path, options):
            try:
                yield frame.cloud()
                count += 1
            except NoPointsError as error:
                empty = error
        if empty and not count:
            raise empty


def ros_reader(name: str, accepts: Callable[[bytes, Path], bool], open: Callable[[Path], Recording]) -> RecordingReader:
    """Return the reader of a recording of ROS messages."""

    def describe(path: Path) -> Description:
        with closing(open(path)) as recording:
            return recording.description

    def frames(path: Path, options: ReadOptions) -> Iterator[Frame]:
        with closing(join_topics(open(path), options.topic)) as recording:
            yield from _ros_frames(recording, options)

    return RecordingReader(name, accepts, describe, frames, open)


def _ros_frames(recording: Recording, options: ReadOptions) -> Iterator[Frame]:
    path, about = recording.path, recording.description
    topic = choose_topic(path, about.topics, options.topic)
    start_ns, end_ns = span_ns(about, options)
    first = 0 if start_ns is None else int(np.count_nonzero(recording.stamps_ns(topic) < start_ns))
    number = first - 1
    for number, message in enumerate(recording.messages((topic,), start_ns, end_ns), first):
        if (number - first) % options.every == 0:
            yield ros_frame(recording, number, message)
    if number < first:
        raise none_within(path, about.duration_s)


def ros_frame(recording: Recording, number: int, message: RawMessage) -> Frame:
    """Return a message as the scan of a number."""
    return Frame(
        path=recording.path,
        number=number,
        stamp_s=message.stamp_ns * 1e-9,
        decode=partial(_ros_cloud, recording, message),
        content=message.data,
    )


def _ros_cloud(recording: Recording, message: RawMessage, title: str) -> PointCloud:
    with damage(Path(title), "record it again"):
        decoded = recording.decode(message)
        return CLOUDS[message.topic.type](decoded, title)


def span_ns(about: Description, options: ReadOptions) -> tuple[int | None, int | None]:
    """Return --from and --to in nanoseconds since the epoch."""
    start_ns, end_ns = (
        None if offset_s is None else about.first_ns + round(offset_s * 1e9)
        for offset_s in (options.start_s, options.end_s)
    )
    return start_ns, end_ns


def _captured_frames(path: Path, options: ReadOptions) -> Iterator[Frame]:
    """Yield the turns of a Velodyne in a packet capture, or the scans of an Ouster."""
    capture = PacketCapture(path)
    about = capture.description
    if not any(topic.type == VELODYNE for topic in about.topics):
        if not metadata_files(path):
            raise InputError(_other_packets(path, about))
        yield from _ouster_captured_frames(path, options)
        return
    topic = choose_topic(path, about.topics, options.topic, (VELODYNE,))
    turns = (
        (stamp_s, partial(cloud_of_turn, stamp_s, points), _without_padding(points))
        for stamp_s, points in capture.turns(topic)
    )
    yield from _selected(path, turns, options)


def _without_padding(points: np.ndarray) -> np.ndarray:
    """Return the bytes of structured points, field after field, without the bytes between the fields."""
    return np.concatenate([np.ascontiguousarray(points[name]).view(np.uint8) for name in points.dtype.names or ()])


def _other_packets(path: Path, about: Description) -> str:
    sizes = ", ".join(f"{topic.count} of {topic.name}" for topic in about.topics[:MOST_NAMED])
    return (
        f"{path}: holds packets of another sensor ({sizes}); Velodyne's are decoded, and Ouster's with their .json"
        " beside them; record points instead (a bag, PCD)"
    )


def _ouster_captured_frames(path: Path, options: ReadOptions) -> Iterator[Frame]:
    sensor, turns = ouster_turns(path, (packet.frame for packet in packets(path)), options.topic)
    scans = (
        (int(rows["stamp_ns"].min()) * 1e-9, partial(sensor.cloud, rows), np.ascontiguousarray(rows["pixels"]["range"]))
        for rows in turns
    )
    yield from _selected(path, scans, options)


def _osf_frames(path: Path, options: ReadOptions) -> Iterator[Frame]:
    yield from _selected(path, OsfFile(path).scans(options.topic), options)


def _selected(
    path: Path, scans: Iterable[tuple[float, Decode, bytes | np.ndarray]], options: ReadOptions
) -> Iterator[Frame]:
    """Yield the selected frames among (stamp_s, decode, content); --from and --to count from the first scan."""
    first = origin_s = None
    after_s = 0.0
    for number, (stamp_s, decode, content) in enumerate(scans):
        origin_s = stamp_s if origin_s is None else origin_s
        after_s = stamp_s - origin_s
        if options.end_s is not None and after_s >= options.end_s:
            break
        if after_s >= (options.start_s or 0.0):
            first = number if first is None else first
            if (number - first) % options.every == 0:
                yield Frame(path=path, number=number, stamp_s=stamp_s, decode=decode, content=content)
    if first is None:
        raise none_within(path, after_s)


class UnpackedRecording:
    """An open recording in a temporary copy, which goes when it is closed."""

    def __init__(self, recording: Recording, path: Path, copy: ExitStack) -> None:
        self._recording, self._copy = recording, copy
        recording.path = path  # for messages and names

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        """Return what the recording has."""
        return getattr(self._recording, name)

    def close(self) -> None:
        """Close the files and remove the copy."""
        self._recording.close()
        self._copy.close()


def unpacking_reader(reader: RecordingReader) -> RecordingReader:
    """Return the reader of a whole recording packed by gzip or zstd: of its unpacked copy."""

    def describe(path: Path) -> Description:
        with unpacked_copy(path) as copy:
            return reader.describe(copy)

    def frames(path: Path, options: ReadOptions) -> Iterator[Frame]:
        with unpacked_copy(path) as copy:
            for frame in reader.frames(copy, options):
                yield replace(frame, path=path)

    def open(path: Path) -> Recording:
        with ExitStack() as stack:
            recording = reader.open(stack.enter_context(unpacked_copy(path)))  # pyright: ignore[reportOptionalCall]
            return cast(Recording, UnpackedRecording(recording, path, stack.pop_all()))
        raise AssertionError

    return RecordingReader(f"{reader.name}, packed", reader.accepts, describe, frames, open if reader.open else None)


def none_within(path: Path, duration_s: float) -> InputError:
    """Return the error for --from and --to without any scan between them."""
    return InputError(f"{path}: has no scan between --from and --to; it lasts {duration_s:.1f} s")


RECORDINGS: tuple[RecordingReader, ...] = (
    ros_reader("ROS 1 bag", lambda head, _: head.startswith(ROSBAG), open_ros1),
    ros_reader("ROS 2 bag (db3)", lambda head, _: head.startswith(SQLITE), open_sqlite),
    ros_reader("MCAP", lambda head, _: head.startswith(MAGIC), McapFile),
    RecordingReader(
        "packet capture",
        lambda head, _: head[:4] in {*PCAP, PCAPNG},
        lambda path: PacketCapture(path).description,
        _captured_frames,
    ),
    RecordingReader("OSF", lambda head, _: is_osf(head), lambda path: OsfFile(path).description, _osf_frames),
)
FOLDER = ros_reader("ROS 2 bag", lambda _, path: (path / METADATA).is_file(), open_folder)


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
    return unpacking_reader(reader) if packed and reader else reader


def describe(path: str | Path) -> Description | None:
    """Return the contents of a recording; None for anything else. Raises InputError for a damaged one."""
    reader = recording_reader(Path(path))
    return reader.describe(Path(path)) if reader else None


def frames(path: Path, options: ReadOptions) -> Iterator[Frame]:
    """Return the scans of a recording in time, not decoded yet. Raises InputError for a damaged one, or none."""
    reader = recording_reader(path)
    if reader is None:
        raise InputError(f"{path}: is no recording ({', '.join(reader.name for reader in RECORDINGS)}); name one")
    return reader.frames(path, options)


def read(source: Any, overrides: Overrides | None = None) -> Scan:  # noqa: ANN401
    """Read one scan.

    source     path of a file of a known format, whatever its name; of a recording the first scan is read; or an array
               (N, 3 or more) of x y z [intensity [ring]]; or a cloud of Open3D or PyVista; or a PointCloud2 of ROS.
    overrides  known facts; None: everything is found out.
    Raises InputError for a missing or damaged file, an unknown format, and for anything but a single sweep.
    """
    if isinstance(source, str | Path) and (reader := recording_reader(Path(source))):
        cloud = next(reader.clouds(Path(source), ReadOptions()))
        try:
            return interpret(cloud, overrides)[0]
        except InputError as error:
            raise InputError(f"{source}: {error}") from None
    return readers.read(source, overrides)


def recorded_motion(path: Path, options: ReadOptions, frame: str) -> tuple[SensorMotion, str] | None:
    """Return the motion of a coordinate frame in a recording, and the name of its origin; None without one.

    Poses are read for the times of `options` only. Raises InputError at damage.
    """
    reader = recording_reader(path)
    if reader is None or reader.open is None:
        return None
    with closing(reader.open(path)) as recording:
        return transforms.recorded_motion(recording, frame, *span_ns(recording.description, options))
