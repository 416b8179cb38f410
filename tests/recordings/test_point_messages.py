"""Points in other messages than PointCloud2 are the same points."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="recordings are read by the extra 'recordings'")

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as Bag1
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from zstandard import ZstdCompressor

from lidar2pano.errors import InputError
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.recordings.point_messages import CLOUDS, DEFINITIONS
from lidar2pano.recordings.recorded_scans import frames
from miniature import street
from miniature_recordings import START_NS, points, write

SCAN = street(0, 300)
ROWS = np.zeros(300, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("pad", "u1"), ("intensity", "<u2")])
for axis, key in enumerate("xyz"):
    ROWS[key] = SCAN.xyz[:, axis]
ROWS["intensity"] = np.arange(300)
FIELDS = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 13, 3), ("beyond", 14, 8)]


def clouds(path: Path, **options) -> list[PointCloud]:
    return [frame.cloud() for frame in frames(path, ReadOptions(**options))]


def mcap(path: Path, encoding: str, schema: str, data: bytes, kind: str = "", definition: bytes = b"") -> Path:
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start()
        number = writer.register_schema(schema, kind or encoding, definition)
        channel = writer.register_channel("/lidar", encoding, number)
        writer.add_message(channel, START_NS, data, START_NS)
        writer.finish()
    return path


def foxglove_json() -> bytes:
    fields = [{"name": name, "offset": offset, "type": kind} for name, offset, kind in FIELDS]
    data = base64.b64encode(ROWS.tobytes()).decode()
    content = {"timestamp": {"sec": 17, "nsec": 5 * 10**8}, "frame_id": "LIDAR_TOP", "point_stride": 15}
    return json.dumps({**content, "pose": {}, "fields": fields, "data": data}).encode()


def foxglove_schema() -> descriptor_pb2.FileDescriptorSet:
    """Its files in an order in which one comes before what it depends on."""
    kinds = descriptor_pb2.FieldDescriptorProto
    stamp = descriptor_pb2.FileDescriptorProto(name="stamp.proto", package="foxglove", syntax="proto3")
    message = stamp.message_type.add(name="Stamp")
    message.field.add(name="seconds", number=1, type=kinds.TYPE_INT64, label=1)
    message.field.add(name="nanos", number=2, type=kinds.TYPE_INT32, label=1)
    cloud = descriptor_pb2.FileDescriptorProto(name="cloud.proto", package="foxglove", syntax="proto3")
    cloud.dependency.append("stamp.proto")
    field = cloud.message_type.add(name="PackedElementField")
    field.field.add(name="name", number=1, type=kinds.TYPE_STRING, label=1)
    field.field.add(name="offset", number=2, type=kinds.TYPE_FIXED32, label=1)
    field.field.add(name="type", number=3, type=kinds.TYPE_INT32, label=1)
    message = cloud.message_type.add(name="PointCloud")
    message.field.add(name="timestamp", number=1, type=kinds.TYPE_MESSAGE, type_name=".foxglove.Stamp", label=1)
    message.field.add(name="frame_id", number=2, type=kinds.TYPE_STRING, label=1)
    message.field.add(name="point_stride", number=4, type=kinds.TYPE_FIXED32, label=1)
    kind = ".foxglove.PackedElementField"
    message.field.add(name="fields", number=5, type=kinds.TYPE_MESSAGE, type_name=kind, label=3)
    message.field.add(name="data", number=6, type=kinds.TYPE_BYTES, label=1)
    return descriptor_pb2.FileDescriptorSet(file=[cloud, stamp])


def foxglove_protobuf() -> bytes:
    pool = descriptor_pool.DescriptorPool()
    for file in reversed(foxglove_schema().file):
        pool.AddSerializedFile(file.SerializeToString())
    message = message_factory.GetMessageClass(pool.FindMessageTypeByName("foxglove.PointCloud"))()
    message.timestamp.seconds, message.timestamp.nanos, message.frame_id = 17, 5 * 10**8, "LIDAR_TOP"
    message.point_stride, message.data = 15, ROWS.tobytes()
    for name, offset, kind in FIELDS:
        message.fields.add(name=name, offset=offset, type=kind)
    return message.SerializeToString()


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
def test_foxglove(tmp_path, encoding):
    if encoding == "json":
        path = mcap(tmp_path / "a.mcap", encoding, "foxglove.PointCloud", foxglove_json(), "jsonschema")
    else:
        schema = foxglove_schema().SerializeToString()
        path = mcap(tmp_path / "a.mcap", encoding, "foxglove.PointCloud", foxglove_protobuf(), definition=schema)
    (cloud,) = clouds(path)
    np.testing.assert_array_equal(cloud.xyz, SCAN.xyz)
    assert cloud.intensity is not None and np.array_equal(cloud.intensity, np.arange(300))
    assert (cloud.stamp_s, cloud.frame, cloud.fields) == (17.5, "LIDAR_TOP", ("x", "y", "z", "intensity"))


@pytest.mark.parametrize("change", [{"point_stride": 16}, {"point_stride": 0}, {"fields": []}, {"data": "A"}])
def test_damaged_foxglove(tmp_path, change):
    content = json.dumps(json.loads(foxglove_json()) | change).encode()
    with pytest.raises(InputError):
        clouds(mcap(tmp_path / "a.mcap", "json", "foxglove.PointCloud", content, "jsonschema"))


def livox(type: str) -> bytes:
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(DEFINITIONS[type], type))
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=17, nanosec=5 * 10**8)
    header = types["std_msgs/msg/Header"](seq=0, stamp=stamp, frame_id="livox")
    point = types[type.replace("Message", "Point").replace("CustomMsg", "CustomPoint")]
    values = [
        point(
            offset_time=number * 300_000,
            x=float(x),
            y=float(y),
            z=float(z),
            reflectivity=number % 256,
            tag=0,
            line=number % 6,
        )
        for number, (x, y, z) in enumerate(SCAN.xyz)
    ]
    message = types[type](
        header=header, timebase=0, point_num=300, lidar_id=0, rsvd=np.zeros(3, np.uint8), points=values
    )
    return bytes(store.serialize_ros1(message, type))


@pytest.mark.parametrize("package", ["livox_ros_driver", "livox_ros_driver2", "livox_interfaces"])
def test_livox(tmp_path, package):
    type = f"{package}/msg/CustomMsg"
    with Bag1(tmp_path / "a.bag") as bag:
        connection = bag.add_connection("/livox/lidar", type, msgdef=DEFINITIONS[type], md5sum="0" * 32)
        bag.write(connection, START_NS, livox(type))
    (cloud,) = clouds(tmp_path / "a.bag")
    np.testing.assert_array_equal(cloud.xyz, SCAN.xyz)
    assert cloud.ring is not None and cloud.ring.max() == 5 and cloud.frame == "livox" and cloud.stamp_s == 17.5
    assert cloud.time_s is not None and cloud.time_s[-1] == pytest.approx(0.0897)


def test_point_cloud_of_channels():
    header = SimpleNamespace(frame_id="laser", stamp=SimpleNamespace(sec=1, nanosec=0))
    xyz = [SimpleNamespace(x=x, y=y, z=z) for x, y, z in SCAN.xyz]
    channels = [SimpleNamespace(name="intensity", values=np.arange(300.0)), SimpleNamespace(name="bad", values=[1])]
    message = SimpleNamespace(header=header, points=xyz, channels=channels)
    cloud = CLOUDS["sensor_msgs/msg/PointCloud"](message, "a")
    np.testing.assert_array_equal(cloud.xyz, SCAN.xyz)
    assert cloud.fields == ("x", "y", "z", "intensity") and cloud.stamp_s == 1


def test_messages_compressed_one_by_one(tmp_path):
    plain = write(tmp_path, "mcap-raw", [points(SCAN, START_NS)])
    from mcap.reader import make_reader

    with plain.open("rb") as file:
        ((schema, channel, message),) = make_reader(file).iter_messages()
    data = ZstdCompressor().compress(message.data)
    path = mcap(tmp_path / "a.mcap", channel.message_encoding, schema.name, data, schema.encoding, schema.data)
    np.testing.assert_array_equal(clouds(path)[0].xyz, SCAN.xyz)


@pytest.mark.parametrize(
    ("schema", "encoding", "says"),
    [
        ("point_cloud_interfaces/msg/CompressedPointCloud2", "cdr", "point_cloud_transport republish"),
        ("foxglove.PointCloud", "flatbuffer", "make a PointCloud2 of it with the MCAP library"),
        ("sensor_msgs/msg/LaserScan", "cdr", "laser_geometry"),
        ("my_msgs/msg/Cloud", "cdr", r"it has /lidar of my_msgs/msg/Cloud"),
    ],
)
def test_what_is_not_read_is_named_by_its_type(tmp_path, schema, encoding, says):
    path = mcap(tmp_path / "a.mcap", encoding, schema, b"", "ros2msg")
    with pytest.raises(InputError, match=says) as caught:
        clouds(path)
    assert "damaged" not in str(caught.value)
