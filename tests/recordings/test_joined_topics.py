"""Several LiDARs of one vehicle are one scan."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="recordings are read by the extra 'recordings'")

from lidar2pano.errors import InputError
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.recordings.mcap_files import McapFile
from lidar2pano.recordings.playback import Playback
from lidar2pano.recordings.recorded_scans import frames
from miniature import street
from miniature_recordings import START_NS, STEP_NS, points, transform, write
from poses import fields_of, pose_of

T_BASE_TOP = pose_of(20, 5, -3, (1.1, -0.2, 2))
T_TOP_SIDE = np.array([[0.0, -1, 0, 0.5], [1, 0, 0, 0.8], [0, 0, 1, -1], [0, 0, 0, 1]])  # turned left by 90 degrees
LATER_NS = 30_000_000


def drive(count: int = 4):
    """Clouds of both sensors: the one at the side begins later and measures a fixed corner of its own."""
    sent = [
        transform(START_NS, "base_link", "top", fields_of(T_BASE_TOP), "/tf_static"),
        transform(START_NS, "base_link", "/side", fields_of(T_BASE_TOP @ T_TOP_SIDE), "/tf_static"),
    ]
    for number in range(count):
        stamp_ns = START_NS + number * STEP_NS
        sent.append(
            points(street(number, 300), stamp_ns, "/top/points", "top", ring=(np.arange(300) % 16).astype(np.uint16))
        )
        side = street(100 + number, 50)
        side.xyz[0] = 0  # no return
        sent.append(
            points(side, stamp_ns + LATER_NS, "/side/points", "side", ring=(np.arange(50) % 4).astype(np.uint16))
        )
    return sorted(sent, key=lambda one: one.stamp_ns)


def clouds(path, **options):
    return [frame.cloud() for frame in frames(path, ReadOptions(topic="all", **options))]


@pytest.mark.parametrize("format", ["bag", "db3", "mcap", "mcap-plain"])
def test_clouds_are_joined_in_the_topmost_sensors_frame(tmp_path, format):
    path = write(tmp_path, format, drive())
    found = clouds(path)
    assert [len(cloud) for cloud in found] == [350] * 4 and found[0].frame == "top"
    for number, cloud in enumerate(found):
        np.testing.assert_array_equal(cloud.xyz[:300], street(number, 300).xyz)
        side = street(100 + number, 50).xyz
        x, y, z = side[1:].T
        np.testing.assert_allclose(cloud.xyz[301:], np.stack([0.5 - y, 0.8 + x, z - 1], 1), atol=1e-5)
        assert np.isnan(cloud.xyz[300]).all()
        assert cloud.ring is not None and cloud.ring[:300].max() == 15 and cloud.ring[300:].max() == 19
        assert cloud.time_s is not None and np.allclose(cloud.time_s, np.repeat([0, 0.03], [300, 50]), atol=1e-6)
    assert [round(cloud.stamp_s - 1.7e9, 6) for cloud in clouds(path, start_s=0.05, every=2)] == [0.1, 0.3]
    opened = Playback(path, "all")
    assert list(opened.numbers(ReadOptions())) == [0, 1, 2, 3] and len(opened.frame(2).cloud()) == 350
    opened.close()


def test_a_sensor_that_fails_is_left_out(tmp_path):
    sent = [one for one in drive() if not (one.topic == "/side/points" and one.stamp_ns > START_NS + STEP_NS)]
    assert [len(cloud) for cloud in clouds(write(tmp_path, "mcap", sent))] == [350, 350, 300, 300]


def test_without_links_one_has_to_be_chosen(tmp_path):
    sent = [one for one in drive() if one.topic != "/tf_static"]
    with pytest.raises(InputError, match="its tf_static does not link side, top; choose one LiDAR with --topic"):
        clouds(write(tmp_path, "bag", sent))


def test_one_lidar_is_all(tmp_path):
    sent = [one for one in drive() if one.topic != "/side/points"]
    assert [len(cloud) for cloud in clouds(write(tmp_path, "bag", sent))] == [300] * 4


def test_a_topic_that_lacks_its_messages_is_damage(tmp_path, monkeypatch):
    path = write(tmp_path, "mcap", drive())
    monkeypatch.setattr(McapFile, "messages", lambda *_: iter(()))  # its statistics count some
    with pytest.raises(InputError, match=r"drive.mcap: is damaged or cut short"):
        clouds(path)
    with pytest.raises(InputError, match=r"drive.mcap: is damaged or cut short"):
        Playback(path, "all")
