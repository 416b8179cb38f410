"""Poses that recordings hold: odometry and tf, of the sensor's own frame or of what carries it."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="recordings are read by the extra 'recordings'")

from lidar2pano.formats.readers import ReadOptions
from lidar2pano.recordings.recorded_scans import open_recording, recorded_motion
from lidar2pano.recordings.transforms import fixed_poses
from miniature import street
from miniature_recordings import START_NS, STEP_NS, odometry, points, transform, write
from poses import fields_of, pose_of, somewhere

NONE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
MOUNT = (1.0, 0.0, 1.7, 0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))  # turned left by 90 degrees
SCAN = [points(street(0, 50), START_NS)]


def moving(number: int) -> tuple[float, ...]:
    return (0.5 * number, 0.1 * number, 0.0, 0.0, 0.0, 0.0, 1.0)


def drive(make, count: int = 11):
    return [make(START_NS + number * STEP_NS, moving(number)) for number in range(count)]


def motion(folder, sent, frame: str = "velodyne", format: str = "bag", **options):
    return recorded_motion(write(folder, format, sent), ReadOptions(**options), frame)


@pytest.mark.parametrize("format", ["bag", "db3", "mcap", "mcap-ros1"])
def test_odometry_of_the_sensor(tmp_path, format):
    found, origin = motion(tmp_path, [*SCAN, *drive(odometry)], format=format)
    assert origin == "/odom"
    np.testing.assert_allclose(found.pose(1.7e9 + 0.45)[:3, 3], [2.25, 0.45, 0], atol=1e-5)
    assert found.pose(1.7e9 + 5) is None


def test_odometry_of_the_vehicle_needs_the_mount(tmp_path):
    sent = drive(lambda stamp, pose: odometry(stamp, pose, child="base_link"))
    assert motion(tmp_path, [*SCAN, *sent]) is None
    static = [transform(START_NS, "base_link", "/velodyne", MOUNT, "/tf_static")]
    (tmp_path / "b").mkdir()
    found, origin = motion(tmp_path / "b", [*static, *SCAN, *sent])
    pose = found.pose(1.7e9 + 0.4)
    assert origin == "/odom"
    np.testing.assert_allclose(pose[:3, 3], [3, 0.4, 1.7], atol=1e-5)
    np.testing.assert_allclose(pose[:3, 0], [0, 1, 0], atol=1e-12)  # the sensor's x points to the vehicle's left


@pytest.mark.parametrize("format", ["bag", "db3", "mcap", "mcap-plain"])
def test_tf_comes_first_and_ends_at_odom(tmp_path, format):
    sent = [
        transform(START_NS, "base_link", "velodyne", MOUNT, "/tf_static"),
        *drive(lambda stamp, pose: transform(stamp, "odom", "base_link", pose)),
        *drive(lambda stamp, pose: transform(stamp, "map", "odom", (9 * pose[0], *pose[1:]))),
        *drive(lambda stamp, pose: odometry(stamp, NONE)),
    ]
    found, origin = motion(tmp_path, [*SCAN, *sorted(sent, key=lambda one: one.stamp_ns)], format=format)
    assert origin == "tf from odom to velodyne"
    np.testing.assert_allclose(found.pose(1.7e9 + 0.4)[:3, 3], [3, 0.4, 1.7], atol=1e-5)


def test_without_odom_the_chain_goes_to_the_top(tmp_path):
    sent = [
        transform(START_NS, "base_link", "velodyne", MOUNT, "/tf_static"),
        *drive(lambda stamp, pose: transform(stamp, "map", "base_link", pose)),
    ]
    assert motion(tmp_path, [*SCAN, *sent])[1] == "tf from map to velodyne"


def test_a_tree_that_does_not_move_or_goes_round_is_none(tmp_path):
    sent = [
        transform(START_NS, "a", "velodyne", NONE, "/tf_static"),
        transform(START_NS, "velodyne", "a", NONE, "/tf_static"),
        *drive(lambda stamp, pose: transform(stamp, "odom", "wheel", pose)),
    ]
    assert motion(tmp_path, [*SCAN, *sent]) is None
    (tmp_path / "b").mkdir()
    assert motion(tmp_path / "b", SCAN) is None


def test_what_is_no_pose_is_left_out(tmp_path):
    sent = drive(odometry)
    sent[4] = odometry(sent[4].stamp_ns, (np.nan, 0, 0, 0, 0, 0, 1))
    sent[5] = odometry(sent[5].stamp_ns, (99, 0, 0, 0, 0, 0, 0))
    found, _ = motion(tmp_path, [*SCAN, *sent])
    np.testing.assert_allclose(found.pose(1.7e9 + 0.45)[:3, 3], [2.25, 0.45, 0], atol=1e-5)


def test_poses_are_read_for_the_wanted_time_only(tmp_path):
    found, _ = motion(tmp_path, [*SCAN, *drive(odometry, 60)], start_s=2.0, end_s=3.0)
    (link,) = found.links
    assert 1.7e9 + 0.95 < link.stamp_s[0] < 1.7e9 + 1.05 and 1.7e9 + 3.85 < link.stamp_s[-1] < 1.7e9 + 4.05


@pytest.mark.parametrize("make", [odometry, lambda stamp, pose: transform(stamp, "odom", "velodyne", pose)])
def test_poses_are_of_their_stamps_and_not_of_when_they_were_recorded(tmp_path, make):
    sent = [one._replace(stamp_ns=one.stamp_ns + STEP_NS // 2) for one in drive(make)]
    found, _ = motion(tmp_path, [*SCAN, *sent])
    np.testing.assert_allclose(found.pose(1.7e9 + 0.45)[:3, 3], [2.25, 0.45, 0], atol=1e-5)


def mounts(folder, links, frames):
    """The fixed poses of frames by links (parent, child, pose)."""
    sent = [transform(START_NS, parent, child, fields_of(T), "/tf_static") for parent, child, T in links]
    path = write(folder, "bag", [*SCAN, *sent])
    recording = open_recording(path)
    found = fixed_poses(recording, frames)
    recording.close()
    return found


def test_fixed_poses_are_products_from_the_root_down(tmp_path):
    T_root_a, T_a_b = somewhere(), pose_of(-60, 20, 5, (1, 2, 3))
    found = mounts(tmp_path, [("a", "b", T_a_b), ("root", "a", T_root_a)], ("b", "/a", "root"))
    np.testing.assert_allclose(found["b"], T_root_a @ T_a_b, atol=1e-9)
    np.testing.assert_allclose(found["/a"], T_root_a, atol=1e-9)
    np.testing.assert_array_equal(found["root"], np.eye(4))


def test_frames_below_two_roots_have_no_fixed_poses(tmp_path):
    links = [("root", "a", somewhere()), ("other", "b", somewhere())]
    assert mounts(tmp_path, links, ("a", "b")) is None
