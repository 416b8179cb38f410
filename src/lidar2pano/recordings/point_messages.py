"""Messages of points: PointCloud2, PointCloud, Livox's CustomMsg, Foxglove's PointCloud in each of its encodings."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from lidar2pano.errors import InputError, require_extra
from lidar2pano.formats.arrays import cloud_of_message
from lidar2pano.formats.point_cloud import MOST_POINTS, PointCloud, cloud_of_columns

POINTS = "sensor_msgs/msg/PointCloud2"
CUSTOM_POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
CUSTOM_MESSAGE = "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
# Definitions of messages outside ROS's own packages, by type
DEFINITIONS = {
    **{
        f"{package}/msg/CustomMsg": f"{CUSTOM_MESSAGE}{package}/CustomPoint[] points\n{'=' * 80}\n"
        f"MSG: {package}/CustomPoint\n{CUSTOM_POINT}"
        for package in ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
    },
    "foxglove_msgs/msg/PointCloud": "builtin_interfaces/Time timestamp\nstring frame_id\ngeometry_msgs/Pose pose\n"
    f"uint32 point_stride\nfoxglove_msgs/PackedElementField[] fields\nuint8[] data\n{'=' * 80}\n"
    "MSG: foxglove_msgs/PackedElementField\nstring name\nuint32 offset\nuint8 type\n",
}
NUMERIC = {1: "u1", 2: "i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<f4", 8: "<f8"}  # foxglove.NumericType


def _stamp_s(stamp: Any) -> float | None:  # noqa: ANN401
    """Return a stamp of ROS, of JSON or of protobuf in seconds; None without one."""
    for whole, parts in (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos")):
        if hasattr(stamp, whole) and hasattr(stamp, parts):
            return getattr(stamp, whole) + getattr(stamp, parts) * 1e-9
    return None


def _cloud_of_livox(message: Any, name: str) -> PointCloud:  # noqa: ANN401
    fields = ("x", "y", "z", "reflectivity", "offset_time", "line", "tag")
    dtypes = ("f4", "f4", "f4", "u1", "u4", "u1", "u1")
    columns = {
        field: np.array([getattr(point, field) for point in message.points], dtype)
        for field, dtype in zip(fields, dtypes, strict=True)
    }
    return _cloud(columns, "Livox CustomMsg", name, message.header.frame_id, _stamp_s(message.header.stamp))


def _cloud_of_channels(message: Any, name: str) -> PointCloud:  # noqa: ANN401
    xyz = np.array([(point.x, point.y, point.z) for point in message.points], np.float32).reshape(-1, 3)
    columns = dict(zip("xyz", xyz.T, strict=True))
    channels = {channel.name: np.asarray(channel.values) for channel in message.channels}
    columns |= {key: values for key, values in channels.items() if len(values) == len(xyz)}
    return _cloud(columns, "PointCloud", name, message.header.frame_id, _stamp_s(message.header.stamp))


def _cloud_of_foxglove(message: Any, name: str) -> PointCloud:  # noqa: ANN401
    """Return the points in their own coordinates: the message's pose tells where their origin, the sensor, is."""
    stride, fields = int(message.point_stride), {}
    data = base64.b64decode(message.data) if isinstance(message.data, str) else bytes(message.data)
    for field in message.fields:
        dtype = np.dtype(NUMERIC.get(int(getattr(field, "type", 0)), "u1"))
        offset = int(getattr(field, "offset", 0))
        if int(getattr(field, "type", 0)) in NUMERIC and 0 <= offset <= stride - dtype.itemsize:
            fields[field.name] = (dtype, offset)
    if stride < 1 or len(data) % stride or len(data) // stride > MOST_POINTS:
        raise InputError(f"{name}: {len(data)} bytes are no whole number of points of {stride} bytes; record it again")
    layout = {"names": list(fields), "formats": [dtype for dtype, _ in fields.values()]}
    layout |= {"offsets": [offset for _, offset in fields.values()], "itemsize": stride}
    rows = np.frombuffer(data, np.dtype(layout))  # pyright: ignore[reportArgumentType, reportCallIssue]
    columns = {key: rows[key] for key in fields}
    return _cloud(columns, "foxglove.PointCloud", name, str(message.frame_id), _stamp_s(message.timestamp))


def _cloud(columns: dict[str, np.ndarray], format: str, name: str, frame: str, stamp_s: float | None) -> PointCloud:
    return cloud_of_columns(columns, format=format, name=name, frame=frame, stamp_s=stamp_s)


FOXGLOVE = "foxglove.PointCloud"
JOINED = "points of several sensors"  # decoded to a PointCloud
VELODYNE, OUSTER = SENSORS = "Velodyne packets", "Ouster scans"  # not of ROS; decoded to: title for messages -> points
# type, with the encoding if it is not ROS's -> (decoded message, title for messages) -> its points
CLOUDS: dict[str, Callable[[Any, str], PointCloud]] = {
    POINTS: cloud_of_message,
    JOINED: lambda cloud, _: cloud,
    **dict.fromkeys(SENSORS, lambda decode, title: decode(title)),
    "sensor_msgs/msg/PointCloud": _cloud_of_channels,
    **dict.fromkeys([name for name in DEFINITIONS if name.endswith("CustomMsg")], _cloud_of_livox),
    **dict.fromkeys(["foxglove_msgs/msg/PointCloud"], _cloud_of_foxglove),
    **dict.fromkeys([f"{FOXGLOVE} (protobuf)", f"{FOXGLOVE} (json)"], _cloud_of_foxglove),
}


def decode_json(data: bytes) -> Any:  # noqa: ANN401
    """Return a message in JSON as an object with attributes."""
    return json.loads(data, object_hook=lambda fields: SimpleNamespace(**fields))


def decode_protobuf(data: bytes, name: str, descriptors: bytes) -> Any:  # noqa: ANN401
    """Return a message in protobuf; `descriptors` is its schema, a FileDescriptorSet."""
    return _message_class(name, descriptors).FromString(data)


@lru_cache(maxsize=8)
def _message_class(name: str, descriptors: bytes) -> Any:  # noqa: ANN401
    with require_extra("recordings", name):
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    pool = descriptor_pool.DescriptorPool()
    waiting = {file.name: file for file in descriptor_pb2.FileDescriptorSet.FromString(descriptors).file}
    while waiting:  # each file behind those it depends on
        ready = [file for file in waiting.values() if not any(other in waiting for other in file.dependency)]
        if not ready:
            raise ValueError("its schema depends on itself")
        for file in ready:
            pool.AddSerializedFile(waiting.pop(file.name).SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
