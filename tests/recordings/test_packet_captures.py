"""Packet captures of Velodyne sensors: made up here, decoded by velodyne-decoder, and by hand."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("velodyne_decoder", reason="packet captures are read by the extra 'recordings'")

from lidar2pano.errors import InputError
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.recordings.packet_captures import MOST_CAPTURED
from lidar2pano.recordings.recorded_scans import describe, frames, recording_reader

START_S, PACKET_S = 1_700_000_000.0, 1.327e-3  # of a VLP-16: 24 firings of 55.296 us
STEP_DEG = 0.4
PACKETS_A_TURN = 75  # 12 blocks of 2 firings of 0.2 degrees
RANGE_M, BLOCKS = 10.0, 12


def payload(number: int) -> bytes:
    """A data packet of a VLP-16: every return at 10 m, intensity the channel's number."""
    blocks = b""
    for block in range(BLOCKS):
        azimuth = round((number * BLOCKS + block) * STEP_DEG * 100) % 36000
        returns = b"".join(struct.pack("<HB", round(RANGE_M / 0.002), channel % 16) for channel in range(32))
        blocks += struct.pack("<HH", 0xEEFF, azimuth) + returns
    microseconds = round((START_S % 3600 + number * PACKET_S) * 1e6)
    return blocks + struct.pack("<IBB", microseconds, 0x37, 0x22)


def frame(data: bytes, last: int = 201, port: int = 2368) -> bytes:
    """Ethernet, IPv4 and UDP around a payload from 192.168.1.`last`."""
    udp = struct.pack(">HHHH", port, port, 8 + len(data), 0) + data
    address = bytes([192, 168, 1, last]) + bytes([255] * 4)
    ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0) + address + udp
    return bytes(12) + b"\x08\x00" + ip


def capture(path: Path, packets, order: str = "<", nano: bool = False) -> Path:
    """A pcap of (stamp_s, frame)."""
    magic = 0xA1B23C4D if nano else 0xA1B2C3D4
    data = struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, 65535, 1)
    for stamp_s, one in packets:
        fraction = round(stamp_s % 1 * (1e9 if nano else 1e6))
        data += struct.pack(order + "IIII", int(stamp_s), fraction, len(one), len(one)) + one
    path.write_bytes(data)
    return path


def turning(turns: float, last: int = 201):
    return [
        (START_S + number * PACKET_S, frame(payload(number), last)) for number in range(round(turns * PACKETS_A_TURN))
    ]


def clouds(path: Path, **options):
    return [frame.cloud() for frame in frames(path, ReadOptions(**options))]


def complaint(path: Path, **options) -> str:
    with pytest.raises(InputError) as caught:
        clouds(path, **options)
    text = str(caught.value)
    assert text.startswith(str(path)) and "\n" not in text
    return text


@pytest.mark.parametrize(("order", "nano"), [("<", False), (">", False), ("<", True), (">", True)])
def test_turns_become_scans(tmp_path, order, nano):
    path = capture(tmp_path / "drive.pcap", turning(3.5), order, nano)
    found = clouds(path)
    assert [cloud.name for cloud in found] == [f"drive-{number:06d}" for number in range(len(found))]
    assert 3 <= len(found) <= 4
    cloud = found[1]
    assert np.allclose(np.linalg.norm(cloud.xyz, axis=1), RANGE_M, atol=0.1)
    assert set(cloud.ring) == set(range(16)) and cloud.intensity.max() == 15
    elevation = np.degrees(np.arcsin(cloud.xyz[:, 2] / np.linalg.norm(cloud.xyz, axis=1)))
    for ring in range(16):  # the VLP-16's beams are 2 degrees apart
        assert np.allclose(elevation[cloud.ring == ring].mean(), -15 + 2 * ring, atol=0.3)
    assert cloud.time_s is not None and 0.05 < np.ptp(cloud.time_s) < 0.11
    assert found[1].stamp_s - found[0].stamp_s == pytest.approx(PACKETS_A_TURN * PACKET_S, abs=2 * PACKET_S)


def test_points_are_where_the_azimuth_says(tmp_path):
    """Azimuth counts clockwise from y in the packets; ours counter-clockwise from x."""
    cloud = clouds(capture(tmp_path / "a.pcap", turning(1.2)))[0]
    at_start = np.abs(cloud.time_s - cloud.time_s.min()) < 5e-5
    angle = math.degrees(math.atan2(*cloud.xyz[at_start].mean(0)[1::-1]))
    assert -2 < angle < 2


def test_points_equal_those_of_the_library(tmp_path):
    import velodyne_decoder

    path = capture(tmp_path / "a.pcap", turning(3.2))
    wanted = list(velodyne_decoder.read_pcap(path, as_pcl_structs=True))
    for cloud, (stamp, points) in zip(clouds(path), wanted, strict=True):
        np.testing.assert_array_equal(cloud.xyz, np.stack([points["x"], points["y"], points["z"]], 1))
        np.testing.assert_array_equal(cloud.intensity, points["intensity"])
        assert cloud.stamp_s == stamp.host


def test_scans_of_the_real_capture():
    path = Path(__file__).resolve().parents[3] / "shared/realdata/formats/sample_velodyne_vlp16_gps.pcap"
    if not path.exists():
        pytest.skip("the real capture is not here")
    found = clouds(path)
    assert [len(cloud) for cloud in found] == [18790, 18701, 18678, 17317]
    assert describe(path).duration_s == pytest.approx(0.3875, abs=1e-3)
    for cloud in found[:3]:
        assert set(cloud.ring) == set(range(16)) and np.ptp(cloud.time_s) == pytest.approx(0.1, abs=0.005)
        assert np.percentile(cloud.xyz[:, 2], 1) == pytest.approx(-0.37, abs=0.02), "the ground"
        fullest = cloud.ring == np.bincount(cloud.ring).argmax()
        x, y, _ = cloud.xyz[fullest][np.argsort(cloud.time_s[fullest])].T
        clockwise = -np.diff(np.arctan2(y, x)) % math.tau
        assert clockwise.sum() == pytest.approx(math.tau, abs=0.2), "once around"


def test_turns_are_chosen(tmp_path):
    path = capture(tmp_path / "a.pcap", turning(6.5))
    numbers = [frame.number for frame in frames(path, ReadOptions(start_s=0.15, every=2))]
    assert numbers == [2, 4, 6]
    assert len(clouds(path, end_s=0.15)) == 2
    assert "has no scan between --from and --to" in complaint(path, start_s=60.0)


def test_one_of_two_sensors_is_named(tmp_path):
    both = [one for pair in zip(turning(2.2), turning(2.2, last=202), strict=True) for one in pair]
    path = capture(tmp_path / "a.pcap", both)
    assert "192.168.1.201:2368, 192.168.1.202:2368; choose one with --topic" in complaint(path)
    alone = clouds(capture(tmp_path / "b.pcap", turning(2.2)))
    for cloud, other in zip(clouds(path, topic="192.168.1.202:2368"), alone, strict=True):
        np.testing.assert_array_equal(cloud.xyz, other.xyz)
    assert [topic.count for topic in describe(path).topics] == [165, 165]


def test_every_truncation_is_found_or_ends_between_packets(tmp_path):
    path = capture(tmp_path / "a.pcap", turning(1.2))
    whole = path.read_bytes()
    ends = {24 + number * (16 + len(frame(payload(0)))) for number in range(100)}
    for length in np.linspace(0, len(whole) - 1, 51).astype(int):
        path.write_bytes(whole[:length])
        reader = recording_reader(path)
        if reader is None:
            assert length < 4
        elif length not in ends:
            with pytest.raises(InputError, match=r"is damaged or cut short"):
                next(frames(path, ReadOptions()))


def test_a_packet_of_too_many_bytes(tmp_path):
    path = capture(tmp_path / "a.pcap", turning(0.1))
    data = bytearray(path.read_bytes())
    data[24 + 8 : 24 + 12] = struct.pack("<I", MOST_CAPTURED + 1)
    path.write_bytes(data)
    assert f"a packet of {MOST_CAPTURED + 1} bytes" in complaint(path)


def test_packets_of_other_sensors_are_named(tmp_path):
    path = capture(tmp_path / "a.pcap", [(START_S, frame(bytes(8448), port=7502))] * 3)
    assert "holds packets of another sensor (3 of 8490 bytes)" in complaint(path)
    assert "holds no packet" in complaint(capture(tmp_path / "b.pcap", []))


def test_a_newer_capture_is_read_too(tmp_path):
    def block(number: int, body: bytes) -> bytes:
        body += bytes(-len(body) % 4)
        return struct.pack("<II", number, len(body) + 12) + body + struct.pack("<I", len(body) + 12)

    data = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)) + block(1, struct.pack("<HHI", 1, 0, 65535))
    for stamp_s, one in turning(2.2):
        stamp = round(stamp_s * 1e6)
        data += block(6, struct.pack("<IIIII", 0, stamp >> 32, stamp & 0xFFFFFFFF, len(one), len(one)) + one)
    (tmp_path / "a.pcapng").write_bytes(data)
    plain = clouds(capture(tmp_path / "a.pcap", turning(2.2)))
    for cloud, other in zip(clouds(tmp_path / "a.pcapng"), plain, strict=True):
        np.testing.assert_array_equal(cloud.xyz, other.xyz)
        assert cloud.stamp_s == pytest.approx(other.stamp_s, abs=1e-5)
