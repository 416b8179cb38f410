"""Scans of recordings: points, stamps, topics, times, memory, and what is wrong with a file."""

from __future__ import annotations

import gzip
import lzma
import sqlite3
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="recordings are read by the extra 'recordings'")

from lidar2pano.cli import main
from lidar2pano.errors import InputError
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.recordings import reading_process, recorded_scans
from lidar2pano.recordings.playback import Playback
from lidar2pano.recordings.point_messages import POINTS
from lidar2pano.recordings.recorded_scans import describe, read, recording_reader
from lidar2pano.scan import Scan
from miniature import street
from miniature_recordings import FORMATS, ROS2, START_NS, STEP_NS, Sent, cloud_message, message, odometry, points, write
from sample_files import zstd

DRIVE = [points(street(number, 300), START_NS + number * STEP_NS) for number in range(12)]
TRUNCATED = ("bag", "bag-bz2", "bag-lz4", "db3", "mcap", "mcap-lz4", "mcap-plain", "mcap-ros1")


def frames(path: Path, **options):
    return recorded_scans.frames(path, ReadOptions(**options))


def clouds(path: Path, **options):
    return [frame.cloud() for frame in frames(path, **options)]


def complaint(path: Path, **options) -> str:
    """The InputError of a recording that cannot be read to its end, which must be one line."""
    with pytest.raises(InputError) as caught:
        clouds(path, **options)
    text = str(caught.value)
    assert text.startswith(str(path)) and "\n" not in text and len(text) < 600
    return text


@pytest.mark.parametrize("format", ["bag", "db3", "mcap"])
@pytest.mark.parametrize(("ending", "pack"), [(".gz", gzip.compress), (".xz", lzma.compress), (".zst", zstd)])
def test_packed_recordings_give_the_scans(tmp_path, monkeypatch, format, ending, pack):
    (tmp_path / "copies").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "copies"))
    path = write(tmp_path, format, DRIVE[:4])
    packed = path.with_name(path.name + ending)
    packed.write_bytes(pack(path.read_bytes()))
    found = clouds(packed)
    assert [np.array_equal(cloud.xyz, street(number, 300).xyz) for number, cloud in enumerate(found)] == [True] * 4
    assert describe(packed) == describe(path)
    opened = Playback(packed)
    assert opened.frame(2).title == f"{packed}, scan 2" and opened.path == packed
    opened.close()
    packed.write_bytes(pack(path.read_bytes()[: path.stat().st_size // 2]))
    complaint(packed)
    packed.write_bytes(pack(path.read_bytes())[:-200])
    assert "damaged or cut off" in complaint(packed)
    assert not list((tmp_path / "copies").iterdir())


@pytest.mark.parametrize("format", FORMATS)
def test_every_format_gives_the_scans(tmp_path, format):
    path = write(tmp_path, format, DRIVE)
    found = clouds(path)
    assert [cloud.name for cloud in found] == [f"drive-{number:06d}" for number in range(12)]
    for number, cloud in enumerate(found):
        scan = street(number, 300)
        np.testing.assert_array_equal(cloud.xyz, scan.xyz)
        np.testing.assert_array_equal(cloud.intensity, scan.remission)
        assert cloud.stamp_s == pytest.approx(1.7e9 + 0.1 * number, abs=1e-6)
        assert cloud.frame == "velodyne" and cloud.time_s is None and cloud.xyz.dtype == np.float32
    about = describe(path)
    assert about is not None and sum(topic.count for topic in about.topics) == 12 and about.start_s == 1.7e9
    assert about.duration_s == pytest.approx(1.1, abs=1e-6)
    assert [(topic.name, topic.type, topic.count) for topic in about.topics] == [("/points", POINTS, 12)]


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize(
    ("options", "numbers"),
    [
        ({"every": 5}, [0, 5, 10]),
        ({"start_s": 0.3}, list(range(3, 12))),
        ({"start_s": 0.25, "end_s": 0.5}, [3, 4]),
        ({"start_s": 0.3, "every": 4}, [3, 7, 11]),
        ({"end_s": 0.3}, [0, 1, 2]),
        ({"end_s": 0.000_000_001}, [0]),
        ({"topic": "/points", "end_s": 0.15}, [0, 1]),
        ({"topic": "points", "end_s": 0.15}, [0, 1]),
    ],
)
def test_scans_are_chosen(tmp_path, format, options, numbers):
    path = write(tmp_path, format, [odometry(START_NS, (0, 0, 0, 0, 0, 0, 1)), *DRIVE])
    assert [frame.number for frame in frames(path, **options)] == numbers


@pytest.mark.parametrize("format", ["bag", "db3", "mcap"])
def test_a_recording_behind_a_linked_folder_is_read(tmp_path, format):
    (tmp_path / "there").mkdir()
    path = write(tmp_path / "there", format, DRIVE[:2])
    (tmp_path / "here").symlink_to(tmp_path / "there")
    assert len(clouds(tmp_path / "here" / path.name)) == 2


def test_a_wrong_suffix_is_no_error(tmp_path):
    path = write(tmp_path, "bag", DRIVE[:2]).rename(tmp_path / "drive #1?.mcap")
    assert len(clouds(path)) == 2
    path = write(tmp_path, "db3", DRIVE[:2]).rename(tmp_path / "a%20b?c#d.bag")
    assert len(clouds(path)) == 2


def test_one_of_several_topics_is_named(tmp_path):
    other = [points(street(5, 10), START_NS + 5, topic="/left/points")]
    path = write(tmp_path, "mcap", [*DRIVE, *other])
    assert "holds points on /left/points, /points; choose one with --topic" in complaint(path)
    assert len(clouds(path, topic="/left/points")) == 1
    assert "has no topic '/left'; there is /left/points, /points" in complaint(path, topic="/left")


def test_a_topic_without_messages_is_not_chosen(tmp_path):
    path = write(tmp_path, "db3", DRIVE[:3])
    with sqlite3.connect(path) as database:
        database.execute("INSERT INTO topics SELECT 9, '/empty', type, 'cdr', '', '' FROM topics LIMIT 1")
    assert len(clouds(path)) == 3
    assert "topic /empty holds no message" in complaint(path, topic="/empty")
    with sqlite3.connect(path) as database:
        database.execute("DELETE FROM messages")
    assert "holds points on /empty, /points" in complaint(path)
    with sqlite3.connect(path) as database:
        database.execute("DELETE FROM topics WHERE name = '/empty'")
    assert "topic /points holds no message" in complaint(path)


def test_times_without_scans_are_an_error(tmp_path):
    path = write(tmp_path, "bag", DRIVE)
    assert "has no scan between --from and --to; it lasts 1.1 s" in complaint(path, start_s=7.0)


@pytest.mark.parametrize("format", ["bag", "db3", "mcap"])
def test_what_holds_no_points(tmp_path, format):
    path = write(tmp_path, format, [odometry(START_NS, (0, 0, 0, 0, 0, 0, 1))])
    assert "holds no sensor_msgs/PointCloud2 topic (it has /odom of nav_msgs/msg/Odometry)" in complaint(path)
    assert "topic /odom holds nav_msgs/msg/Odometry, not points" in complaint(path, topic="/odom")


def test_packets_are_named(tmp_path):
    path = write(tmp_path, "db3", DRIVE[:1])
    with sqlite3.connect(path) as database:
        database.execute("UPDATE topics SET type = 'velodyne_msgs/msg/VelodyneScan'")
    said = complaint(path)
    assert "holds packets, not points" in said and "decode with velodyne_pointcloud" in said
    assert "holds packets, not points" in complaint(path, topic="/points")


# --- messages -------------------------------------------------------------------------------------------------------


def odd_rows(order: str) -> np.ndarray:
    """Points whose fields are unaligned, out of order, with gaps between and NaN among them."""
    dtype = np.dtype(
        {
            "names": ["ring", "z", "intensity", "x", "t", "y"],
            "formats": [f"{order}u2", f"{order}f4", "u1", f"{order}f4", f"{order}u4", f"{order}f8"],
            "offsets": [1, 3, 7, 9, 17, 21],
            "itemsize": 37,
        }
    )
    generator = np.random.default_rng(3)
    rows = np.zeros(50, dtype)
    for name in "xyz":
        rows[name] = generator.normal(0, 10, 50)
    rows["ring"], rows["intensity"] = generator.integers(0, 64, 50), generator.integers(0, 255, 50)
    rows["t"] = np.arange(50) * 2_000_000
    rows["x"][7] = np.nan
    return rows


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("format", ["bag", "mcap"])
def test_any_fields_offsets_and_byte_orders(tmp_path, order, format):
    rows = odd_rows(order)
    (cloud,) = clouds(write(tmp_path, format, [cloud_message(rows, START_NS)]))
    np.testing.assert_array_equal(cloud.xyz, np.stack([rows["x"], rows["y"], rows["z"]], 1).astype(np.float64))
    np.testing.assert_array_equal(cloud.ring, rows["ring"])
    np.testing.assert_array_equal(cloud.intensity, rows["intensity"])
    np.testing.assert_allclose(cloud.time_s, np.arange(50) * 0.002, atol=1e-12)
    assert cloud.fields == ("ring", "z", "intensity", "x", "t", "y")


@pytest.mark.parametrize("format", ["mcap", "mcap-ros1"])
def test_points_equal_those_of_another_library(tmp_path, format):
    """mcap-ros1-support and mcap-ros2-support decode messages on their own; struct reads each point's bytes."""
    reader = pytest.importorskip("mcap.reader")
    support = pytest.importorskip("mcap_ros1.decoder" if format == "mcap-ros1" else "mcap_ros2.decoder")
    path = write(tmp_path, format, [cloud_message(odd_rows(">"), START_NS), *DRIVE[1:]])
    with path.open("rb") as file:
        others = [
            one.decoded_message
            for one in reader.make_reader(file, decoder_factories=[support.DecoderFactory()]).iter_decoded_messages()
        ]
    for cloud, other in zip(clouds(path), others, strict=True):
        order = ">" if other.is_bigendian else "<"
        codes = {7: "f", 8: "d"}
        wanted = [
            [
                struct.unpack_from(order + codes[field.datatype], other.data, start + field.offset)[0]
                for name in "xyz"
                for field in other.fields
                if field.name == name
            ]
            for start in range(0, len(other.data), other.point_step)
        ]
        np.testing.assert_array_equal(cloud.xyz, wanted)


@pytest.mark.parametrize("format", ["bag", "db3", "mcap"])
@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"width": 400}, "1 x 400 points of"),
        ({"width": 0, "data": np.zeros(0, np.uint8)}, "holds no points"),
        ({"fields": []}, "has no field 'x'"),
        ({"fields": [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 14, 7, 1)]}, "field 'z' begins at byte 14 of points of"),
    ],
)
def test_wrong_counts_name_the_scan(tmp_path, format, changed, says):
    good = DRIVE[1]
    bad = good._replace(fields=good.fields | changed)
    path = write(tmp_path, format, [DRIVE[0], bad, DRIVE[2]])
    assert f"{path}, scan 1: " in complaint(path) and says in complaint(path)
    kept = []
    for frame in frames(path):  # the others can be read
        try:
            kept.append(frame.cloud().name)
        except InputError:
            continue
    assert kept == ["drive-000000", "drive-000002"]


def test_a_message_of_other_bytes_names_the_scan(tmp_path):
    path = write(tmp_path, "db3", DRIVE[:3])
    with sqlite3.connect(path) as database:
        database.execute("UPDATE messages SET data = x'00010000ffffffff00' WHERE id = 2")
    assert f"{path}, scan 1: is damaged or cut short" in complaint(path)


# --- damage ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("format", TRUNCATED)
def test_every_truncation_is_found_before_the_first_scan(tmp_path, format):
    path = write(tmp_path, format, DRIVE)
    whole = path.read_bytes()
    for length in np.linspace(0, len(whole) - 1, 51).astype(int):
        path.write_bytes(whole[:length])
        try:
            reader = recording_reader(path)
        except InputError:
            continue
        if reader is None:
            assert length < 16
            continue
        with pytest.raises(InputError) as caught:
            next(recorded_scans.frames(path, ReadOptions()))
        assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


@pytest.mark.parametrize("format", TRUNCATED)
def test_changed_bytes_are_one_line_or_read(tmp_path, format):
    """Whatever is damaged, the error is an InputError, with no warning and not much memory."""
    path = write(tmp_path, format, DRIVE[:3])
    whole, generator = path.read_bytes(), np.random.default_rng(1)
    for _ in range(40):
        damaged = bytearray(whole)
        for place in generator.integers(16, len(whole), 4):
            damaged[place] = generator.integers(0, 256)
        path.write_bytes(damaged)
        try:
            for frame in frames(path):
                frame.cloud()
        except InputError as error:
            assert "\n" not in str(error)


def test_a_bag_that_is_not_indexed(tmp_path):
    path = write(tmp_path, "bag", DRIVE)
    data = bytearray(path.read_bytes())
    place = data.index(b"index_pos=") + len("index_pos=")
    data[place : place + 8] = bytes(8)
    path.write_bytes(data)
    assert "not indexed" in complaint(path) and "rosbag reindex" in complaint(path)


@pytest.mark.parametrize("format", ["bag-lz4", "mcap-lz4"])
def test_an_unknown_compression(tmp_path, format):
    path = write(tmp_path, format, DRIVE)
    path.write_bytes(path.read_bytes().replace(b"lz4", b"xz9"))
    assert "xz9" in complaint(path)


@pytest.mark.parametrize("name", ["bz2", "lz4"])
def test_a_bag_that_unpacks_to_too_much(tmp_path, monkeypatch, name):
    path = write(tmp_path, f"bag-{name}", DRIVE)
    monkeypatch.setattr("lidar2pano.recordings.ros_bags.MOST_CHUNK_BYTES", 4000)
    path.write_bytes(path.read_bytes())
    assert "4000" in complaint(path)


def test_an_mcap_that_unpacks_to_something_else(tmp_path, monkeypatch):
    path = write(tmp_path, "mcap", DRIVE)
    monkeypatch.setattr("lidar2pano.recordings.mcap_files.MOST_CHUNK_BYTES", 4000)
    assert "unpacked" in complaint(path)


def test_a_changed_byte_of_a_chunk_is_found(tmp_path):
    path = write(tmp_path, "mcap-raw", DRIVE)
    data = bytearray(path.read_bytes())
    data[data.index(street(3, 300).xyz[:2, 0].tobytes()[:4])] ^= 1
    path.write_bytes(data)
    assert "crc validation failed" in complaint(path)


def test_a_database_that_is_still_written(tmp_path):
    path = write(tmp_path, "db3", DRIVE)
    path.with_name("drive.db3-wal").write_bytes(b"1")
    assert "is still being written" in complaint(path)


def test_a_database_of_something_else(tmp_path):
    path = tmp_path / "other.db3"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE numbers (n)")
    assert "missing tables" in complaint(path)


def test_a_folder_with_metadata_of_something_else(tmp_path):
    (tmp_path / "metadata.yaml").write_text("a: [1, 2")
    assert "is damaged or cut short" in complaint(tmp_path)
    (tmp_path / "metadata.yaml").write_text("a: 1")
    assert "is damaged or cut short" in complaint(tmp_path)


@pytest.mark.parametrize("format", ["bag", "db3", "mcap", "mcap-plain"])
def test_memory_does_not_grow_with_messages(tmp_path, format):
    def peak(count: int) -> int:
        folder = tmp_path / str(count)
        folder.mkdir()
        scan = street(0, 20_000)
        path = write(folder, format, (points(scan, START_NS + n * STEP_NS) for n in range(count)))
        tracemalloc.start()
        try:
            for frame in frames(path):
                frame.cloud()
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    clouds(write(tmp_path, format, DRIVE))  # libraries are loaded
    assert peak(30) < 1.5 * peak(6)


def test_a_message_object_can_be_read():
    import lidar2pano

    scan = lidar2pano.read(message(DRIVE[0], ROS2))
    np.testing.assert_array_equal(scan.xyz, street(0, 300).xyz)


def test_what_is_no_recording(tmp_path):
    (tmp_path / "a.bin").write_bytes(bytes(16))
    assert recording_reader(tmp_path / "a.bin") is None and recording_reader(tmp_path) is None
    assert describe(tmp_path / "a.bin") is None
    with pytest.raises(InputError, match="cannot be read"):
        recording_reader(tmp_path / "missing.bag")
    assert isinstance(DRIVE[0], Sent)


@pytest.mark.parametrize("format", ["bag", "mcap"])
@pytest.mark.parametrize("empty", [0, 500])
def test_scans_without_points_before_the_first_are_passed_over(tmp_path, format, empty):
    """Drivers send them, of no points or all at the origin, before their sensor turns."""
    none = Scan(xyz=np.zeros((empty, 3), np.float32), remission=np.zeros(empty, np.float32))
    sent = [points(scan, START_NS + number * STEP_NS) for number, scan in enumerate([none, none, street(1), street(2)])]
    path = write(tmp_path, format, sent)
    assert np.array_equal(read(path).xyz, street(1).xyz)
    first, second = reading_process.frames(path, ReadOptions())
    assert (first.number, second.number) == (2, 3)
    assert first.cloud().doubts == ("2 of the recording's scans before it hold no points, and are passed over",)
    assert not second.cloud().doubts
    assert main(["inspect", str(path), "--json"]) == 0


def test_a_recording_of_no_points_at_all_says_so(tmp_path):
    none = Scan(xyz=np.zeros((500, 3), np.float32), remission=np.zeros(500, np.float32))
    path = write(tmp_path, "mcap", [points(none, START_NS)])
    with pytest.raises(InputError, match="scan 0: none of its 500 points has a place"):
        read(path)
    (frame,) = reading_process.frames(path, ReadOptions())
    with pytest.raises(InputError, match="scan 0: none of its 500 points has a place"):
        frame.cloud()
