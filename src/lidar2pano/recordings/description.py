"""The description of a recording, the choice of the scans' topic, and the interface of open recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from lidar2pano.errors import InputError, closest
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.recordings.point_messages import CLOUDS, DEFINITIONS, POINTS, SENSORS

MOST_TOPICS = 10_000  # of a recording; vehicles have some hundreds
# message type -> the package to turn its packets into points
PACKETS = {
    "velodyne_msgs/msg/VelodyneScan": "velodyne_pointcloud",
    "velodyne_msgs/msg/VelodynePacket": "velodyne_pointcloud",
    "ouster_ros/msg/PacketMsg": "ouster-ros",
    "ouster_sensor_msgs/msg/PacketMsg": "ouster-ros",
    "hesai_ros_driver/msg/UdpFrame": "HesaiLidar_ROS_2.0",
    "hesai_lidar/msg/PandarScan": "HesaiLidar_General_ROS",
    "pandar_msgs/msg/PandarScan": "nebula",
    "nebula_msgs/msg/NebulaPackets": "nebula",
    "rslidar_msgs/msg/rslidarScan": "rslidar_sdk",
    "rslidar_msg/msg/RslidarPacket": "rslidar_sdk",
}
# message type -> what makes a PointCloud2 of it
COMPRESSED = {
    "point_cloud_interfaces/msg/CompressedPointCloud2": "`ros2 run point_cloud_transport republish`",
    "foxglove.PointCloud (flatbuffer)": "the MCAP library of its recorder",
    "foxglove.CompressedPointCloud (protobuf)": "Draco",
    "sensor_msgs/msg/LaserScan": "laser_geometry (it is one plane, which makes no panorama)",
    "sensor_msgs/msg/MultiEchoLaserScan": "laser_geometry (it is one plane, which makes no panorama)",
}
ZSTD = b"\x28\xb5\x2f\xfd"  # of a message compressed by itself
MOST_CHUNK_BYTES = 1 << 28  # unpacked; recorders write chunks of about a megabyte, or of one message
TF = "tf2_msgs/msg/TFMessage"
ROS1, CDR = "ros1", "cdr"  # encodings of messages, by MCAP's names
MOST_NAMED = 12  # topics in a message; `inspect` lists all


@dataclass(frozen=True, slots=True, kw_only=True)
class Topic:
    """A topic of a ROS recording, or the stream of one sensor in a packet capture or an OSF.

    type   of its messages in ROS 2's form, "sensor_msgs/msg/PointCloud2"; of a sensor, "Velodyne packets".
    count  of messages.
    """

    name: str
    type: str
    count: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Description:
    """The topics and times of a recording.

    format   for people, e.g. "ROS 1 bag".
    topics   in order of their names.
    first_ns, last_ns  when its first and last message were recorded, nanoseconds since the epoch; 0 without messages.
    """

    format: str
    topics: tuple[Topic, ...]
    first_ns: int
    last_ns: int

    @classmethod
    def of_counts(
        cls, path: Path, format: str, counts: Mapping[tuple[str, str], int], first_ns: int, last_ns: int
    ) -> Self:
        """Return the description of topics by counts: (name, type) -> number of messages; InputError for too many."""
        if len(counts) > MOST_TOPICS:
            raise InputError(f"{path}: has {len(counts)} topics, at most {MOST_TOPICS} are read; filter it")
        topics = (Topic(name=name, type=type, count=counts[name, type]) for name, type in sorted(counts))
        return cls(format=format, topics=tuple(topics), first_ns=first_ns, last_ns=last_ns)

    @property
    def start_s(self) -> float:
        """Time of recording of its first message, seconds since the epoch."""
        return self.first_ns * 1e-9

    @property
    def duration_s(self) -> float:
        """From its first message to its last one, seconds."""
        return max(self.last_ns - self.first_ns, 0) * 1e-9

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        topics = [asdict(topic) for topic in self.topics]
        return {"format": self.format, "start_s": self.start_s, "duration_s": self.duration_s, "topics": topics}


class RawMessage(NamedTuple):
    """A message as it is recorded: its topic, the time of recording (nanoseconds since the epoch), and its bytes.

    content  of a message of no single topic of ROS: what its recording decodes.
    """

    topic: Topic
    stamp_ns: int
    data: bytes
    content: Any = None


class Recording:
    """An open recording of messages, or of the scans of sensors.

    path     for messages and names;  file: where it is read, of a packed one a copy;  files: closed with it.
    indexed  whether messages before a time are skipped without being read.
    """

    indexed = False
    description: Description

    def __init__(self, path: Path) -> None:
        self.path, self.file, self.files = path, path, ExitStack()

    def choose(self, topic: str) -> Topic:
        """Return the topic of the scans by its name, "" for the only one; InputError as `choose_topic`."""
        return choose_topic(self.path, self.description.topics, topic)

    def messages(
        self, topics: tuple[Topic, ...], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Return messages recorded from `start_ns` on and before `end_ns`, in order of time; InputError at damage."""
        raise NotImplementedError

    def origin_ns(self, topic: Topic) -> int:  # noqa: ARG002 but of one sensor's scans
        """Return the time of --from 0, nanoseconds since the epoch."""
        return self.description.first_ns

    def stamps_ns(self, topic: Topic) -> np.ndarray:
        """Return the times of recording of a topic's messages, int64 in order; by an index alone if there is one."""
        with damage(self.path, "record it again"):  # formats' numbers without a sign may be larger
            return np.array([message.stamp_ns for message in self.messages((topic,))], dtype=np.int64)

    def decode(self, message: RawMessage) -> Any:  # noqa: ANN401
        """Return the message as an object with ROS's attributes; raises the library's errors."""
        return message.content

    def cloud(self, message: RawMessage, title: str) -> PointCloud:
        """Return the points of a message; InputError with the title for damage."""
        with damage(Path(title), "record it again"):
            return CLOUDS[message.topic.type](self.decode(message), title)

    def close(self) -> None:
        """Close the files."""
        self.files.close()


class SensorRecording(Recording):
    """A recording of sensors' scans, read from its beginning; --from and --to count from the first scan."""

    def scans(self, topic: Topic) -> Iterator[tuple[int, bytes, Callable[[str], PointCloud]]]:
        """Yield (nanoseconds since the epoch, content, title for messages -> points) of a sensor's scans."""
        raise NotImplementedError

    def messages(
        self, topics: tuple[Topic, ...], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """See Recording."""
        for topic in topics:
            for stamp_ns, content, decode in self.scans(topic):
                if end_ns is not None and stamp_ns >= end_ns:
                    break
                if start_ns is None or stamp_ns >= start_ns:
                    yield RawMessage(topic, stamp_ns, content, decode)

    def origin_ns(self, topic: Topic) -> int:
        """See Recording."""
        return next((message.stamp_ns for message in self.messages((topic,))), 0)


def choose_topic(path: Path, topics: Sequence[Topic], name: str) -> Topic:
    """Return the topic of the scans, messages of one of CLOUDS: the one called `name`, or the only one.

    Raises InputError with the topics if none or several are possible, or it holds no message.
    """
    names = [topic.name for topic in topics]
    clouds = [topic for topic in topics if topic.type in CLOUDS]
    if name:
        named = [topic for topic in topics if topic.name in {name, f"/{name}"}]
        if not named:
            raise InputError(f"{path}: has no topic {name!r}{closest(name, names[:MOST_NAMED])}")
        candidates = [topic for topic in named if topic.type in CLOUDS] or named[:1]
    else:
        candidates = [topic for topic in clouds if topic.count] or clouds
        usual = [topic for topic in candidates if topic.type == POINTS]
        candidates = usual or candidates  # a driver that sends several forms sends the same points in each
    if not candidates:
        raise InputError(_no_points(path, topics))
    if len(candidates) > 1:
        alternative = "" if candidates[0].type in SENSORS else ", or name all"
        raise InputError(f"{path}: holds points on {_listed(candidates)}; choose one with --topic{alternative}")
    (topic,) = candidates
    if topic.type in PACKETS or topic.type in COMPRESSED:
        raise InputError(_undecoded(path, topic))
    if topic.type not in CLOUDS:
        choice = f"--topic can be {_listed(clouds)}" if clouds else "it has no topic of points"
        raise InputError(f"{path}: topic {topic.name} holds {topic.type}, not points; {choice}")
    if not topic.count:
        raise InputError(f"{path}: topic {topic.name} holds no message; record it again")
    return topic


def _no_points(path: Path, topics: Sequence[Topic]) -> str:
    for types in (PACKETS, COMPRESSED):
        if undecoded := [topic for topic in topics if topic.type in types and topic.count]:
            return _undecoded(path, max(undecoded, key=lambda topic: topic.count))
    if not topics:
        return f"{path}: holds no topic at all; record it again"
    held = _listed([replace(topic, name=f"{topic.name} of {topic.type}") for topic in topics])
    return f"{path}: holds no sensor_msgs/PointCloud2 topic (it has {held}); name a recording of points"


def _undecoded(path: Path, topic: Topic) -> str:
    if topic.type in PACKETS:
        return (
            f"{path}: {topic.name} holds packets, not points ({topic.type});"
            f" decode with {PACKETS[topic.type]} and record the PointCloud2 topic"
        )
    return (
        f"{path}: {topic.name} holds {topic.type}, which is not read; make a PointCloud2 of it with"
        f" {COMPRESSED[topic.type]}, and record that"
    )


def _listed(topics: Sequence[Topic]) -> str:
    more = f" and {len(topics) - MOST_NAMED} more" if len(topics) > MOST_NAMED else ""
    return ", ".join(topic.name for topic in topics[:MOST_NAMED]) + more


@contextmanager
def damage(path: Path, repair: str) -> Iterator[None]:
    """Turn any error of a library on a damaged file into an InputError with the file and the repair."""
    try:
        yield
    except InputError:
        raise
    except MemoryError as error:
        raise InputError(f"{path}: claims more bytes than there is memory, it is damaged; {repair}") from error
    except Exception as error:  # of struct, zlib, lz4, zstd, SQLite and the libraries themselves
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(f"{path}: is damaged or cut short ({reason}); {repair}") from error


@cache
def deserializer(encoding: str) -> Callable[[bytes, str], Any]:
    """Return (bytes, type) -> message, for the standard types, unchanged in ROS 1 and ROS 2, and for DEFINITIONS."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if encoding == ROS1:
        store = get_typestore(Stores.ROS1_NOETIC)
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))  # missing there
    else:
        store = get_typestore(Stores.ROS2_HUMBLE)
    for type, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, type))
    if encoding == ROS1:
        return store.deserialize_ros1
    return lambda data, type: store.deserialize_cdr(_plain_message(data), type)


def _plain_message(data: bytes) -> bytes:
    """Return a message, unpacked if it was compressed by itself (rosbag2's compression mode "message")."""
    if data[:4] != ZSTD:
        return data
    from zstandard import ZstdDecompressor

    with ZstdDecompressor().stream_reader(data) as stream:
        plain = stream.read(MOST_CHUNK_BYTES + 1)
    if len(plain) > MOST_CHUNK_BYTES:
        raise ValueError(f"a message of more than {MOST_CHUNK_BYTES} bytes, unpacked")
    return plain
