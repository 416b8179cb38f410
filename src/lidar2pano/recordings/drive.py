"""A drive: the scans of a recording in time, chosen by topic, time and number; what a recording holds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

from lidar2pano.errors import InputError
from lidar2pano.formats.file_contents import head_of
from lidar2pano.formats.messages import cloud_of_message
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.recordings import ouster, packet_captures
from lidar2pano.recordings.description import Description, choose_topic, damage
from lidar2pano.recordings.mcap_files import MAGIC, McapFile
from lidar2pano.recordings.packet_captures import PCAP, PCAPNG, VelodyneCapture
from lidar2pano.recordings.ros_bags import ROSBAG, SQLITE, open_folder, open_ros1, open_sqlite
from lidar2pano.recordings.ros_messages import RawMessage, Recording

ENDINGS = (".bag", ".db3", ".mcap", ".pcap", ".pcapng", ".osf")  # of recordings among a folder's files
METADATA = "metadata.yaml"  # of a ROS 2 bag's folder


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """A scan of a recording, not decoded yet.

    path     of the recording;  number: of the scan among all of its topic, from 0.
    stamp_s  when it was recorded, seconds since the epoch.
    decode   gives its points; raises InputError where the message is damaged or holds no point.
    """

    path: Path
    number: int
    stamp_s: float
    decode: Callable[[], PointCloud]

    @property
    def name(self) -> str:
        """The recording's stem and the scan's number: its outputs are called so."""
        return f"{self.path.stem}-{self.number:06d}"

    @property
    def title(self) -> str:
        """The recording's path and the scan's number, for messages."""
        return f"{self.path}, scan {self.number}"

    def cloud(self) -> PointCloud:
        """The points, with the time of recording where the scan has no stamp of its own."""
        cloud = self.decode()
        return replace(cloud, name=self.name, stamp_s=cloud.stamp_s or self.stamp_s)


@dataclass(frozen=True)
class RecordingReader:
    """The reader of a format that keeps a drive in a file or folder.

    accept  (first bytes, path) -> whether the file is of this format.
    describe  path -> what it holds;  frame  (path, options) -> its scans, in time.
    """

    name: str
    accept: Callable[[bytes, Path], bool]
    describe: Callable[[Path], Description]
    frames: Callable[[Path, ReadOptions], Iterator[Frame]]

    def accepts(self, head: bytes, path: Path) -> bool:
        """Whether the file is of this format."""
        return self.accept(head, path)

    def clouds(self, path: Path, options: ReadOptions) -> Iterator[PointCloud]:
        """The clouds of the recording, one at a time; InputError at the first that is damaged."""
        for frame in self.frames(path, options):
            yield frame.cloud()


def ros_reader(name: str, accept: Callable[[bytes, Path], bool], open: Callable[[Path], Recording]) -> RecordingReader:
    """The reader of a recording of ROS messages."""

    def describe(path: Path) -> Description:
        with closing(open(path)) as recording:
            return recording.description

    def frames(path: Path, options: ReadOptions) -> Iterator[Frame]:
        with closing(open(path)) as recording:
            yield from _ros_frames(recording, options)

    return RecordingReader(name, accept, describe, frames)


def _ros_frames(recording: Recording, options: ReadOptions) -> Iterator[Frame]:
    path, about = recording.path, recording.description
    topic = choose_topic(path, about.topics, options.topic)
    start_ns, end_ns = (
        None if offset_s is None else round(((about.start_s or 0.0) + offset_s) * 1e9)
        for offset_s in (options.start_s, options.end_s)
    )
    first = recording.count_before(topic, start_ns) if start_ns is not None else 0
    number = first - 1
    for number, message in enumerate(recording.messages((topic,), start_ns, end_ns), first):
        if (number - first) % options.every == 0:
            title = f"{path}, scan {number}"

            def decode(message: RawMessage = message, title: str = title) -> PointCloud:
                with damage(Path(title), "record it again"):
                    return cloud_of_message(recording.decode(message), title)

            yield Frame(path=path, number=number, stamp_s=message.stamp_ns * 1e-9, decode=decode)
    if number < first:
        raise none_within(path, about.duration_s)


def _velodyne_frames(path: Path, options: ReadOptions) -> Iterator[Frame]:
    capture = VelodyneCapture(path)
    about = capture.description
    topic = choose_topic(path, about.topics, options.topic, packet_captures.TYPE)
    start_s = (about.start_s or 0.0) + (options.start_s or 0.0)
    end_s = math.inf if options.end_s is None else (about.start_s or 0.0) + options.end_s
    first = None
    for number, (stamp_s, points) in enumerate(capture.turns(topic)):
        if stamp_s >= end_s:
            break
        if stamp_s >= start_s:
            first = number if first is None else first
            if (number - first) % options.every == 0:
                title = f"{path}, scan {number}"
                yield Frame(
                    path=path,
                    number=number,
                    stamp_s=stamp_s,
                    decode=lambda stamp_s=stamp_s, points=points, title=title: packet_captures.cloud_of_turn(
                        stamp_s, points, title
                    ),
                )
    if first is None:
        raise none_within(path, about.duration_s)


def none_within(path: Path, duration_s: float) -> InputError:
    """The error for --from and --to that leave no scan."""
    return InputError(f"{path}: has no scan between --from and --to; it lasts {duration_s:.1f} s")


RECORDINGS: tuple[RecordingReader, ...] = (
    ros_reader("ROS 1 bag", lambda head, _: head.startswith(ROSBAG), open_ros1),
    ros_reader("ROS 2 bag (db3)", lambda head, _: head.startswith(SQLITE), open_sqlite),
    ros_reader("MCAP", lambda head, _: head.startswith(MAGIC), McapFile),
)
FOLDER = ros_reader("ROS 2 bag", lambda _, path: (path / METADATA).is_file(), open_folder)


def recording_reader(path: Path) -> RecordingReader | None:
    """The reader of a recording, which is a file or a ROS 2 bag's folder; None for any other file or folder.

    Raises InputError where the file cannot be read.
    """
    if path.is_dir():
        return FOLDER if FOLDER.accepts(b"", path) else None
    head = head_of(path)
    return next((reader for reader in RECORDINGS if reader.accepts(head, path)), None)


def describe(path: str | Path) -> Description | None:
    """What a recording holds; None for what is no recording. Raises InputError where it is damaged."""
    reader = recording_reader(Path(path))
    return reader.describe(Path(path)) if reader else None
