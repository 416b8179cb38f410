"""Recordings as targets: small bags, MCAP files and packet captures, read as the program reads them."""

from __future__ import annotations

import base64
import itertools
import json
import struct
from collections.abc import Callable
from contextlib import closing, suppress
from functools import partial
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as Bag1

import miniature_recordings as recordings
from lidar2pano.cli.inspect import described
from lidar2pano.errors import InputError
from lidar2pano.formats.interpretation import Overrides, interpret
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.recordings.playback import Playback
from lidar2pano.recordings.point_messages import DEFINITIONS
from lidar2pano.recordings.recorded_scans import describe, frames, recorded_motion
from lidar2pano.scan import Scan

FORMATS = ("bag", "bag-bz2", "bag-lz4", "db3", "mcap", "mcap-lz4", "mcap-raw", "mcap-plain", "mcap-ros1")
OPTIONS = (ReadOptions(), ReadOptions(start_s=0.05, every=2))
MOST_SCANS = 5  # of a mutant
POINTS, PACKETS = 8, 14  # of a scan; of a capture: a little more than two turns


def seeds(folder: Path) -> dict[str, bytes]:
    """A recording of each format, of two scans, two poses and a transform; by its file's name."""
    xyz = np.random.default_rng(0).uniform(-20, 20, (POINTS, 3)).astype(np.float32)
    scan = Scan(xyz=xyz, remission=np.full(POINTS, 0.5, np.float32))
    sent = [recordings.transform(recordings.START_NS, "base", "velodyne", (0, 0, 1, 0, 0, 0, 1), "/tf_static")]
    for number in range(2):
        stamp_ns = recordings.START_NS + number * recordings.STEP_NS
        sent.append(recordings.points(scan, stamp_ns))
        sent.append(recordings.odometry(stamp_ns, (number, 0, 0, 0, 0, 0, 1)))
    found = {}
    for format in FORMATS:
        path = recordings.write(folder, format, sent, stem=f"seed-{format}")
        found[f"{format}{path.suffix}"] = path.read_bytes()
    found["capture.pcap"] = _capture()
    found["ouster.osf"] = (Path(__file__).parents[1] / "recordings" / "dual_returns.osf").read_bytes()
    found["foxglove.mcap"] = _foxglove(folder / "seed-foxglove.mcap", xyz)
    found["livox.bag"] = _livox(folder / "seed-livox.bag", xyz)
    return found


def _foxglove(path: Path, xyz: np.ndarray) -> bytes:
    """A foxglove.PointCloud in JSON."""
    fields = [{"name": name, "offset": 4 * place, "type": 7} for place, name in enumerate("xyz")]
    content = {"timestamp": {"sec": 17, "nsec": 5}, "frame_id": "top", "point_stride": 12, "fields": fields}
    content["data"] = base64.b64encode(xyz.tobytes()).decode()
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start()
        schema = writer.register_schema("foxglove.PointCloud", "jsonschema", b"{}")
        channel = writer.register_channel("/lidar", "json", schema)
        writer.add_message(channel, recordings.START_NS, json.dumps(content).encode(), recordings.START_NS)
        writer.finish()
    return path.read_bytes()


def _livox(path: Path, xyz: np.ndarray) -> bytes:
    """A livox_ros_driver/CustomMsg in a ROS 1 bag."""
    type = "livox_ros_driver/msg/CustomMsg"
    message = struct.pack("<IIII5sQIB3x", 0, 17, 5, 5, b"livox", 17, len(xyz), 0) + struct.pack("<I", len(xyz))
    message += b"".join(struct.pack("<IfffBBB", 1000 * n, *point, 9, 0, n % 6) for n, point in enumerate(xyz))
    with Bag1(path) as bag:
        connection = bag.add_connection("/livox/lidar", type, msgdef=DEFINITIONS[type], md5sum="0" * 32)
        bag.write(connection, recordings.START_NS, message)
    return path.read_bytes()


def _capture() -> bytes:
    """Packets of a VLP-16 in a pcap."""
    content = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
    for number in range(PACKETS):
        blocks = b"".join(
            struct.pack("<HH", 0xEEFF, (number * 12 + block) * 500 % 36000) + struct.pack("<HB", 5000, 9) * 32
            for block in range(12)
        )
        data = blocks + struct.pack("<IBB", number * 13270, 0x37, 0x22)
        udp = struct.pack(">HHHH", 2368, 2368, 8 + len(data), 0) + data
        ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0) + bytes([192, 168, 1, 9]) + b"\xff" * 4
        frame = bytes(12) + b"\x08\x00" + ip + udp
        content += struct.pack("<IIII", 1_700_000_000, number * 13270, len(frame), len(frame)) + frame
    return content


def _all_of(path: Path, data: bytes) -> None:
    """Describe a recording, read its scans as `bulk` and as `translate` do, and its poses."""
    path.write_bytes(data)
    if describe(path) is None:
        return
    for topic in ("", "all"):
        with suppress(InputError), closing(Playback(path, topic)) as opened:
            for number in opened.numbers(OPTIONS[1])[:MOST_SCANS]:
                opened.frame(number)
    for options in OPTIONS:
        for frame in itertools.islice(frames(path, options), MOST_SCANS):
            described(*interpret(frame.cloud(), Overrides()))
    motion = recorded_motion(path, OPTIONS[0], "velodyne")
    assert motion is None or motion[1]


def recording_runs(folder: Path) -> dict[str, tuple[bytes, Callable[[bytes], object]]]:
    """(a good recording, the function that reads a mutant of it) by name."""
    return {name: (data, partial(_all_of, folder / f"mutant-{name}")) for name, data in seeds(folder).items()}
