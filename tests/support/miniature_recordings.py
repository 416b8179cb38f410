"""Made-up recordings of a drive: one ROS 1 bag, ROS 2 bags in both storages, MCAP files with and without an index."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.rosbag1 import Writer as Bag1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Bag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from lidar2pano.scan import Scan

POINTS, ODOMETRY, TF = "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
START_NS, STEP_NS = 1_700_000_000_000_000_000, 100_000_000
FORMATS = (
    "bag",
    "bag-bz2",
    "bag-lz4",
    "db3",
    "folder",
    "folder-mcap",
    "mcap",
    "mcap-lz4",
    "mcap-raw",
    "mcap-plain",
    "mcap-ros1",
)
DTYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


class Sent(NamedTuple):
    """A message on its way into a recording: when (nanoseconds), where, of which type, with which fields."""

    stamp_ns: int
    topic: str
    type: str
    fields: dict[str, Any]


def points(scan: Scan, stamp_ns: int, topic: str = "/points", frame: str = "velodyne", **columns: np.ndarray) -> Sent:
    """A PointCloud2 of x y z intensity, and of further columns."""
    columns = {**dict(zip("xyz", scan.xyz.T, strict=True)), "intensity": scan.remission, **columns}
    dtype = np.dtype([(name, values.dtype) for name, values in columns.items()])
    rows = np.empty(len(scan), dtype)
    for name, values in columns.items():
        rows[name] = values
    return cloud_message(rows, stamp_ns, topic, frame)


def cloud_message(rows: np.ndarray, stamp_ns: int, topic: str = "/points", frame: str = "velodyne") -> Sent:
    """A PointCloud2 of structured rows (N,), in the byte order and layout of their dtype."""
    layout = rows.dtype.fields or {}
    big = any(part[0].byteorder == ">" for part in layout.values())
    fields = [(name, part[1], DTYPES[part[0].str[1:]], 1) for name, part in layout.items()]
    data = np.frombuffer(rows.tobytes(), np.uint8)
    step = rows.dtype.itemsize
    content = {"height": 1, "width": len(rows), "fields": fields, "is_bigendian": big, "point_step": step}
    content |= {"row_step": step * len(rows), "data": data, "is_dense": False, "frame": frame, "stamp_ns": stamp_ns}
    return Sent(stamp_ns, topic, POINTS, content)


def odometry(stamp_ns: int, pose: Sequence[float], child: str = "velodyne", topic: str = "/odom") -> Sent:
    """An Odometry of a pose x y z qx qy qz qw."""
    return Sent(stamp_ns, topic, ODOMETRY, {"stamp_ns": stamp_ns, "frame": "odom", "child": child, "pose": pose})


def transform(stamp_ns: int, parent: str, child: str, pose: Sequence[float], topic: str = "/tf") -> Sent:
    """A TFMessage of one pose x y z qx qy qz qw."""
    return Sent(stamp_ns, topic, TF, {"stamp_ns": stamp_ns, "frame": parent, "child": child, "pose": pose})


def image(stamp_ns: int, pixels: np.ndarray, topic: str, encoding: str = "rgb8", frame: str = "camera") -> Sent:
    """An Image of pixels (h, w) or (h, w, c) uint8 as they are; its rows end with three bytes more."""
    rows = np.pad(pixels.reshape(len(pixels), -1), ((0, 0), (0, 3)))
    content = {"height": pixels.shape[0], "width": pixels.shape[1], "encoding": encoding, "is_bigendian": 0}
    content |= {"step": rows.shape[1], "data": rows.ravel(), "frame": frame, "stamp_ns": stamp_ns}
    return Sent(stamp_ns, topic, IMAGE, content)


def compressed_image(stamp_ns: int, data: bytes, topic: str, frame: str = "camera") -> Sent:
    """A CompressedImage of a JPEG or PNG file."""
    content = {"format": "jpeg", "data": np.frombuffer(data, np.uint8), "frame": frame, "stamp_ns": stamp_ns}
    return Sent(stamp_ns, topic, COMPRESSED_IMAGE, content)


def camera_info(stamp_ns: int, K: np.ndarray, size: tuple[int, int], topic: str, **fields: Any) -> Sent:
    """A CameraInfo of a pinhole, or with fields distortion_model, d, p of others."""
    P = np.hstack([K, np.zeros((3, 1))])
    content = {"width": size[0], "height": size[1], "distortion_model": "plumb_bob", "d": np.zeros(5), "k": K.ravel()}
    content |= {"r": np.eye(3).ravel(), "p": P.ravel(), "frame": "camera", "stamp_ns": stamp_ns, **fields}
    return Sent(stamp_ns, topic, CAMERA_INFO, content)


def _picture(sent: Sent, header: Any, store: Any) -> Any:
    """An Image, a CompressedImage or a CameraInfo."""
    fields = {name: value for name, value in sent.fields.items() if name not in ("frame", "stamp_ns")}
    if sent.type == CAMERA_INFO:
        region = {"x_offset": 0, "y_offset": 0, "width": 0, "height": 0, "do_rectify": False} | fields.get("roi", {})
        fields = {"binning_x": 0, "binning_y": 0} | fields
        fields["roi"] = store.types["sensor_msgs/msg/RegionOfInterest"](**region)
        if store is ROS1:
            fields = {name.upper() if name in "dkrp" else name: value for name, value in fields.items()}
    return store.types[sent.type](header=header, **fields)


def message(sent: Sent, store: Any) -> Any:
    """The message as an object of a typestore."""
    types, fields = store.types, sent.fields
    seconds, nanoseconds = divmod(fields["stamp_ns"], 10**9)
    stamp = types["builtin_interfaces/msg/Time"](seconds, nanoseconds)
    sequence = (0,) if store is ROS1 else ()
    header = types["std_msgs/msg/Header"](*sequence, stamp, fields["frame"])
    if sent.type == POINTS:
        field = types["sensor_msgs/msg/PointField"]
        names = ("height", "width", "is_bigendian", "point_step", "row_step", "data", "is_dense")
        layout = [field(*one) for one in fields["fields"]]
        return types[POINTS](header=header, fields=layout, **{name: fields[name] for name in names})
    if sent.type in (IMAGE, COMPRESSED_IMAGE, CAMERA_INFO):
        return _picture(sent, header, store)
    place = types["geometry_msgs/msg/Vector3"](*fields["pose"][:3])
    turn = types["geometry_msgs/msg/Quaternion"](*fields["pose"][3:])
    if sent.type == TF:
        pose = types["geometry_msgs/msg/Transform"](place, turn)
        return types[TF]([types["geometry_msgs/msg/TransformStamped"](header, fields["child"], pose)])
    none = types["geometry_msgs/msg/Vector3"](0, 0, 0)
    place = types["geometry_msgs/msg/Point"](*fields["pose"][:3])
    pose = types["geometry_msgs/msg/PoseWithCovariance"](types["geometry_msgs/msg/Pose"](place, turn), np.zeros(36))
    twist = types["geometry_msgs/msg/TwistWithCovariance"](types["geometry_msgs/msg/Twist"](none, none), np.zeros(36))
    return types[ODOMETRY](header, fields["child"], pose, twist)


def write(folder: Path, format: str, sent: Iterable[Sent], stem: str = "drive") -> Path:
    """Write messages as a recording of one of FORMATS; returns the file or folder."""
    name, _, variant = format.partition("-")
    if name == "bag":
        return _write_bag(folder / f"{stem}.bag", sent, variant)
    if name == "mcap":
        return _write_mcap(folder / f"{stem}.mcap", sent, variant)
    plugin = StoragePlugin.MCAP if variant == "mcap" else StoragePlugin.SQLITE3
    target = folder / (stem if name == "folder" else f".{stem}-whole")
    with Bag2(target, version=9, storage_plugin=plugin) as bag:
        connections: dict[str, Any] = {}
        for one in sent:
            if one.topic not in connections:
                connections[one.topic] = bag.add_connection(one.topic, one.type, typestore=ROS2)
            bag.write(connections[one.topic], one.stamp_ns, ROS2.serialize_cdr(message(one, ROS2), one.type))
    if name == "folder":
        return target
    (bare,) = target.glob("*.db3")
    return bare.rename(folder / f"{stem}.db3")


def _write_bag(path: Path, sent: Iterable[Sent], compression: str) -> Path:
    bag = Bag1(path)
    if compression:
        bag.set_compression(Bag1.CompressionFormat[compression.upper()])
    with bag:
        connections: dict[str, Any] = {}
        for one in sent:
            if one.topic not in connections:
                connections[one.topic] = bag.add_connection(one.topic, one.type, typestore=ROS1)
            bag.write(connections[one.topic], one.stamp_ns, ROS1.serialize_ros1(message(one, ROS1), one.type))
    return path


def _write_mcap(path: Path, sent: Iterable[Sent], variant: str) -> Path:
    """Indexed, with zstd; "lz4"; "raw": not packed; "plain": neither chunks nor index; "ros1": messages of ROS 1."""
    from mcap.writer import CompressionType, IndexType, Writer

    packers = {"lz4": CompressionType.LZ4, "raw": CompressionType.NONE}
    compression = packers.get(variant, CompressionType.ZSTD)
    ros1, plain = variant == "ros1", variant == "plain"
    index = IndexType.NONE if plain else IndexType.ALL
    with path.open("wb") as file:
        mcap = Writer(
            file,
            20_000,
            compression,
            index,
            repeat_channels=not plain,
            use_chunking=not plain,
            use_statistics=not plain,
        )
        mcap.start(profile="ros1" if ros1 else "ros2")
        store = ROS1 if ros1 else ROS2
        channels: dict[str, int] = {}
        for one in sent:
            if one.topic not in channels:
                text, _ = store.generate_msgdef(one.type, ros_version=1 if ros1 else 2)
                name = one.type.replace("/msg/", "/") if ros1 else one.type
                schema = mcap.register_schema(name, "ros1msg" if ros1 else "ros2msg", text.encode())
                channels[one.topic] = mcap.register_channel(one.topic, "ros1" if ros1 else "cdr", schema)
            encode = store.serialize_ros1 if ros1 else store.serialize_cdr
            data = bytes(encode(message(one, store), one.type))
            mcap.add_message(channels[one.topic], one.stamp_ns, data, one.stamp_ns)
        mcap.finish()
    return path
