"""Ouster's packets, decoded without the vendor's library, give the points that a slow definition gives."""

from __future__ import annotations

import gzip
import json
import math
import struct
from collections.abc import Container
from pathlib import Path

import numpy as np
import pytest

from lidar2pano.errors import InputError
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.recordings.playback import Playback
from lidar2pano.recordings.recorded_scans import frames

BEAMS, COLUMNS = 4, 64
ALTITUDES, AZIMUTHS = [15.0, 5.0, -5.0, -15.0], [3.0, -1.0, 3.0, -1.0]
ORIGIN_MM = 15.8
PROFILES = (
    "LEGACY",
    "RNG19_RFL8_SIG16_NIR16",
    "RNG19_RFL8_SIG16_NIR16_DUAL",
    "RNG15_RFL8_NIR8",
    "RNG15_RFL8_NIR8_DUAL",
    "FUSA_RNG15_RFL8_NIR8_DUAL",
)
TO_SENSOR = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36.18, 0, 0, 0, 1]


def metadata(profile: str) -> dict:
    return {
        "beam_altitude_angles": ALTITUDES,
        "beam_azimuth_angles": AZIMUTHS,
        "lidar_origin_to_beam_origin_mm": ORIGIN_MM,
        "lidar_to_sensor_transform": TO_SENSOR,
        "lidar_mode": "64x10",
        "data_format": {"columns_per_frame": COLUMNS, "columns_per_packet": 16, "udp_profile_lidar": profile},
    }


def newer(profile: str) -> dict:
    """The same, as firmware 3 writes it."""
    return {
        "beam_intrinsics": {
            "beam_altitude_angles": ALTITUDES,
            "beam_azimuth_angles": AZIMUTHS,
            "lidar_origin_to_beam_origin_mm": ORIGIN_MM,
        },
        "lidar_intrinsics": {"lidar_to_sensor_transform": TO_SENSOR},
        "lidar_data_format": {"columns_per_frame": COLUMNS, "columns_per_packet": 16, "udp_profile_lidar": profile},
        "config_params": {"lidar_mode": "64x10", "udp_profile_lidar": profile},
    }


def range_mm(turn: int, column: int, beam: int) -> int:
    return 0 if (column + beam) % 7 == 0 else 8 * (500 + 3 * column + 50 * beam + turn)


def second_mm(millimetres: int) -> int:
    """The range of the second return, of each third pixel."""
    return millimetres + 800 if millimetres // 8 % 3 == 1 else 0


def pixel(profile: str, millimetres: int, reflectivity: int) -> bytes:
    """Signal 7 and near-infrared light 9; every reserved bit is set."""
    further = second_mm(millimetres)
    match profile:
        case "LEGACY":
            return struct.pack("<IHHHH", millimetres | 0xFFF00000, reflectivity, 7, 9, 0xFFFF)
        case "RNG19_RFL8_SIG16_NIR16":
            return struct.pack("<IBBHHH", millimetres | 0xFFF80000, reflectivity, 0xFF, 7, 9, 0xFFFF)
        case "RNG19_RFL8_SIG16_NIR16_DUAL":
            words = (millimetres | 0x00F80000 | reflectivity << 24, further | 0x00F80000 | 77 << 24)
            return struct.pack("<IIHHHH", *words, 7, 8, 9, 0xFFFF)
    second = struct.pack("<HBB", further >> 3 | 0x8000, 77, 0xFF) if profile.endswith("DUAL") else b""
    return struct.pack("<HBB", millimetres >> 3 | 0x8000, reflectivity, 9) + second


def packet(profile: str, turn: int, first: int, lost: Container[int]) -> bytes:
    legacy = profile == "LEGACY"
    blocks = []
    for column in range(first, first + 16):
        stamp_ns = 10**12 + turn * 10**8 + column * 10**6
        valid = column not in lost
        pixels = b"".join(pixel(profile, range_mm(turn, column, beam), 10 * beam) for beam in range(BEAMS))
        if legacy:
            head = struct.pack("<QHHI", stamp_ns, column, turn, 0)
            blocks.append(head + pixels + (b"\xff" if valid else b"\0") * 4)
        else:
            blocks.append(struct.pack("<QHH", stamp_ns, column, int(valid)) + pixels)
    return b"".join(blocks) if legacy else bytes(32) + b"".join(blocks) + bytes(32)


def ethernet(payload: bytes, number: int, most: int, source: int) -> list[bytes]:
    """An UDP datagram as Ethernet frames of IPv4, in fragments of at most `most` bytes, the last one first."""
    body = struct.pack(">HHHH", 7502, 7502, len(payload) + 8, 0) + payload
    sent = []
    for start in range(0, len(body), most):
        part = body[start : start + most]
        flags = start // 8 | (0x2000 if start + most < len(body) else 0)
        head = struct.pack(
            ">BBHHHBBH4s4s", 0x45, 0, 20 + len(part), number, flags, 64, 17, 0, bytes([10, 0, 0, source]), bytes(4)
        )
        sent.append(bytes(14) + head + part)
    return sent[::-1]


def capture(
    path: Path,
    profile: str,
    turns: int = 3,
    most: int = 65000,
    sources=(5,),
    first: int = 0,
    lost: Container[int] = (20,),
) -> Path:
    places = [(turn, column) for turn in range(turns) for column in range(0, COLUMNS, 16)][first:]
    payloads = [packet(profile, turn, column, lost) for turn, column in places]
    sent = [
        frame
        for number, payload in enumerate(payloads)
        for source in sources
        for frame in [*ethernet(payload, number, most, source), *ethernet(bytes(48), 999, most, source)]
    ]
    records = b"".join(struct.pack("<IIII", 1, n, len(frame), len(frame)) + frame for n, frame in enumerate(sent))
    path.write_bytes(b"\xd4\xc3\xb2\xa1" + bytes(16) + struct.pack("<I", 1) + records)
    return path


def clouds(path: Path, **options) -> list[PointCloud]:
    return [frame.cloud() for frame in frames(path, ReadOptions(**options))]


def place(column: int, beam: int, millimetres: int) -> list[float]:
    """Ouster's firmware manual, "XYZ calculation"."""
    encoder = 2 * math.pi * (1 - column / COLUMNS)
    azimuth, altitude = -math.radians(AZIMUTHS[beam]), math.radians(ALTITUDES[beam])
    along = millimetres - ORIGIN_MM
    x = along * math.cos(encoder + azimuth) * math.cos(altitude) + ORIGIN_MM * math.cos(encoder)
    y = along * math.sin(encoder + azimuth) * math.cos(altitude) + ORIGIN_MM * math.sin(encoder)
    return [-x / 1000, -y / 1000, (along * math.sin(altitude) + 36.18) / 1000]


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize(("describe", "most"), [(metadata, 65000), (newer, 600)])
def test_points_of_each_profile(tmp_path, profile, describe, most):
    path = capture(tmp_path / "drive.pcap", profile, most=most)
    (tmp_path / "drive_0.json").write_text(json.dumps(describe(profile)))
    found = clouds(path)
    assert len(found) == 3 and found[0].frame == "os_sensor"
    for turn, cloud in enumerate(found):
        columns = [column for column in range(COLUMNS) if column != 20]
        rows = [(column, beam) for beam in range(BEAMS) for column in columns]
        ranges = [range_mm(turn, *row) for row in rows]
        expected = [place(*row, value) if value else [0, 0, 0] for row, value in zip(rows, ranges, strict=True)]
        intensity = [10 * beam for _, beam in rows]
        if profile.endswith("DUAL"):
            behind = [(row, second_mm(value)) for row, value in zip(rows, ranges, strict=True) if second_mm(value)]
            assert len(behind) > 50
            expected += [place(*row, value) for row, value in behind]
            intensity += [77] * len(behind)
            rows = rows + [row for row, _ in behind]
        np.testing.assert_allclose(cloud.xyz, expected, atol=1e-5)
        assert cloud.intensity is not None and cloud.intensity.tolist() == intensity
        assert cloud.near_infrared is not None and (cloud.near_infrared == 9).all()
        assert cloud.ring is not None and cloud.ring.tolist() == [beam for _, beam in rows]
        assert cloud.time_s is not None and cloud.time_s == pytest.approx([column * 1e-3 for column, _ in rows])
        assert cloud.stamp_s == pytest.approx(1000 + 0.1 * turn)


def test_turns_that_are_cut_are_left_out(tmp_path):
    path = capture(tmp_path / "a.pcap", "LEGACY", first=3)
    (tmp_path / "a.json").write_text(json.dumps(metadata("LEGACY")))
    assert [round(cloud.stamp_s or 0, 3) for cloud in clouds(path)] == [1000.1, 1000.2]
    path = capture(tmp_path / "a.pcap", "LEGACY", turns=1, first=3)
    assert [len(cloud) for cloud in clouds(path)] == [16 * BEAMS]  # better than nothing


@pytest.mark.parametrize(
    ("options", "says"), [({}, "a.pcap: holds no scan; record it again"), ({"end_s": 9.0}, "--from and --to")]
)
def test_a_capture_whose_columns_are_all_lost(tmp_path, options, says):
    path = capture(tmp_path / "a.pcap", "LEGACY", lost=range(COLUMNS))
    (tmp_path / "a.json").write_text(json.dumps(metadata("LEGACY")))
    with pytest.raises(InputError, match=says):
        clouds(path, **options)


def test_a_packed_capture_has_its_metadata_beside_it(tmp_path):
    path = capture(tmp_path / "a.pcap", "LEGACY")
    (tmp_path / "a.json").write_text(json.dumps(metadata("LEGACY")))
    packed = tmp_path / "a.pcap.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert [cloud.xyz.tolist() for cloud in clouds(packed)] == [cloud.xyz.tolist() for cloud in clouds(path)]


def test_several_sensors(tmp_path):
    path = capture(tmp_path / "a.pcap", "LEGACY", sources=(5, 6))
    (tmp_path / "a.json").write_text(json.dumps(metadata("LEGACY")))
    with pytest.raises(InputError, match=r"packets of 10.0.0.5:7502, 10.0.0.6:7502; choose one with --topic"):
        clouds(path)
    assert len(clouds(path, topic="10.0.0.6:7502")) == 3
    with pytest.raises(InputError, match=r"a.pcap: has no topic '10.0.0.6'; did you mean '10.0.0.6:7502'"):
        clouds(path, topic="10.0.0.6")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{}", "is no metadata of an Ouster"),
        ("[]", "is no metadata of an Ouster"),
        (json.dumps(metadata("RNG99")), "packets of profile RNG99 are not decoded; there is LEGACY"),
        (json.dumps(metadata("RNG15_RFL8_NIR8")), "holds no packets of 512 bytes, which a.json tells of"),
        (json.dumps(metadata("LEGACY") | {"beam_altitude_angles": ["a"]}), "is no metadata of an Ouster"),
        (json.dumps(metadata("LEGACY") | {"lidar_to_sensor_transform": [1]}), "is no metadata of an Ouster"),
        (json.dumps(metadata("LEGACY") | {"data_format": {"columns_per_packet": "x"}}), "is no metadata of an Ouster"),
        (json.dumps(metadata("LEGACY") | {"data_format": {"columns_per_packet": {}}}), "is no metadata of an Ouster"),
        (json.dumps(metadata("LEGACY") | {"data_format": {"columns_per_frame": -64}}), "is no metadata of an Ouster"),
        (json.dumps(metadata(["LEGACY"])), r"packets of profile \['LEGACY'\] are not decoded; there is LEGACY"),
    ],
)
def test_metadata_that_are_none(tmp_path, content, says):
    path = capture(tmp_path / "a.pcap", "LEGACY")
    (tmp_path / "a.json").write_text(content)
    with pytest.raises(InputError, match=says):
        clouds(path)


def test_times_beyond_the_largest_are_damage(tmp_path):
    path = capture(tmp_path / "a.pcap", "LEGACY")
    (tmp_path / "a.json").write_text(json.dumps(metadata("LEGACY")))
    data = path.read_bytes()
    for column in range(COLUMNS):
        data = data.replace(struct.pack("<Q", 10**12 + column * 10**6), b"\xff" * 8)
    path.write_bytes(data)
    with pytest.raises(InputError, match="a.pcap: is damaged or cut short"):
        Playback(path)
