"""The motion of a drive's sensor, and scans with their poses."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="recordings are read by the extra 'recordings'")

import lidar2pano
from lidar2pano.drives.drive_motion import DriveMotion, T_scan_cloud, city_motion
from lidar2pano.drives.reading import posed_scans
from lidar2pano.errors import InputError
from lidar2pano.formats.interpretation import Overrides, interpret
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.formats.scan_files import write_bin
from lidar2pano.geometry.motion import SensorMotion, Trajectory
from miniature import CALIB, street
from miniature_recordings import START_NS, STEP_NS, points, transform, write
from poses import fields_of, pose_of

pytestmark = pytest.mark.usefixtures("in_this_process")


def pose(number: int) -> tuple[float, ...]:
    return (1.5 * number, 0.2 * number, 0.0, 0.0, 0.0, np.sin(0.05 * number), np.cos(0.05 * number))


def drive(count: int = 6, **columns):
    for number in range(count):
        stamp = START_NS + number * STEP_NS
        yield points(street(number, 1500), stamp, **columns)
        yield transform(stamp, "odom", "velodyne", pose(number))


def test_scans_come_with_their_poses(tmp_path):
    path = write(tmp_path, "mcap", drive())
    found = list(posed_scans(path, every=2))
    assert len(found) == 3
    for number, (scan, T) in enumerate(found):
        np.testing.assert_allclose(T[:3, 3], pose(2 * number)[:3], atol=1e-5)
        np.testing.assert_allclose(T[:3, 0], [np.cos(0.2 * number), np.sin(0.2 * number), 0], atol=1e-6)
        np.testing.assert_array_equal(scan.xyz, street(2 * number, 1500).xyz)
    assert lidar2pano.posed_scans is posed_scans


def test_scans_without_recorded_poses_have_estimated_ones(tmp_path):
    pytest.importorskip("kiss_icp", reason="poses are estimated by KISS-ICP")
    path = write(tmp_path, "bag", [one for one in drive(3) if one.topic != "/tf"])
    poses = [T for _, T in posed_scans(path)]
    np.testing.assert_array_equal(poses[0], np.eye(4))
    (tmp_path / "in").mkdir()
    for number in range(3):
        write_bin(tmp_path / "in" / f"{number}.bin", street(number, 1500))
    np.testing.assert_allclose([T for _, T in posed_scans(tmp_path / "in")], poses)


def test_a_pose_far_from_the_recorded_ones_is_none(tmp_path):
    messages = [*drive(2), points(street(9, 1500), START_NS + 30 * STEP_NS)]
    assert [T is None for _, T in posed_scans(write(tmp_path, "bag", messages))] == [False, False, True]


def write_sequence(sequence, ending=".bin"):
    """A sequence of KITTI odometry with two scans and their poses; its Tr is the identity."""
    (sequence / "velodyne").mkdir(parents=True)
    (sequence / "calib.txt").write_text(CALIB.splitlines()[0] + "\nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    (sequence / "poses.txt").write_text("".join(f"1 0 0 {step} 0 1 0 0 0 0 1 0\n" for step in (0, 1.5)))
    for number in range(2):
        file = sequence / "velodyne" / f"{number:06d}.bin"
        write_bin(file, street(number, 1500))
        if ending == ".bin.gz":
            file.with_name(file.name + ".gz").write_bytes(gzip.compress(file.read_bytes()))
            file.unlink()
    return sequence / "velodyne"


@pytest.mark.parametrize("ending", [".bin", ".bin.gz"])
@pytest.mark.parametrize("inside", [False, True])
def test_poses_beside_velodyne_are_found_from_inside_and_for_packed_scans(tmp_path, monkeypatch, ending, inside):
    folder = write_sequence(tmp_path / "00", ending)
    if inside:
        monkeypatch.chdir(folder)
    assert [T[0, 3] for _, T in posed_scans("." if inside else folder)] == [0, 1.5]


@pytest.mark.parametrize(
    "overrides", [Overrides(), Overrides(forward="y"), Overrides(forward="-x"), Overrides(sensor_height_m=2.5)]
)
def test_poses_follow_how_a_cloud_was_read(overrides):
    """A point of the cloud is in one place of the world, whichever frame it is read into."""
    recorded = SensorMotion((Trajectory.of([(0, *pose(1)), (1, *pose(4))]),))
    cloud = PointCloud(xyz=street(0).xyz, intensity=street(0).remission)
    scan, found = interpret(cloud, overrides)
    _, T = DriveMotion(recorded, "/odom", estimate=False)(Path(), scan, replace(found, stamp_s=0.4))
    world = scan.xyz[:50] @ T[:3, :3].T + T[:3, 3]
    wanted = recorded.at(np.array([0.4]))[0]
    np.testing.assert_allclose(world, cloud.xyz[:50] @ wanted[:3, :3].T + wanted[:3, 3], atol=1e-3)
    assert (overrides == Overrides()) == np.allclose(T_scan_cloud(found), np.eye(4))


def test_an_estimated_motion_deskews_the_next_scan():
    pytest.importorskip("kiss_icp", reason="poses are estimated by KISS-ICP")
    from lidar2pano.drives.drive_motion import DriveMotion

    motion = DriveMotion(None, "", estimate=True)
    assert motion.origin == "KISS-ICP"
    scan, found = interpret(PointCloud(xyz=street(0).xyz))
    timed = replace(scan, time_s=np.linspace(0, 0.1, len(scan)))
    first, _ = motion(Path(), timed, replace(found, stamp_s=5.0))
    np.testing.assert_array_equal(first.xyz, scan.xyz)  # nothing is known yet
    delta = np.eye(4)
    delta[0, 3] = 2.0
    motion._estimated.last_delta = delta
    second, _ = motion(Path(), timed, replace(found, stamp_s=5.1))
    np.testing.assert_allclose(second.xyz[:, 0] - scan.xyz[:, 0], 20 * timed.time_s, atol=0.01)
    late, _ = motion(Path(), timed, replace(found, stamp_s=50.0))
    np.testing.assert_array_equal(late.xyz, scan.xyz)  # a gap: the motion before tells nothing


CITY = "city_SE3_egovehicle.feather"


def write_city(root, rows):
    """A log of Argoverse 2 whose poses are rows of nanoseconds, x y z in metres, and quaternions x y z w."""
    feather = pytest.importorskip("pyarrow.feather", reason="Argoverse is read by the extra 'formats'")
    import pyarrow

    folder = root / "log" / "sensors" / "lidar"
    folder.mkdir(parents=True)
    stamp_ns, x, y, z, qx, qy, qz, qw = map(list, zip(*rows, strict=True))
    table = {"timestamp_ns": stamp_ns, "qw": qw, "qx": qx, "qy": qy, "qz": qz, "tx_m": x, "ty_m": y, "tz_m": z}
    feather.write_feather(pyarrow.table(table), root / "log" / CITY)
    return folder


def test_city_poses_of_argoverse(tmp_path):
    T = [pose_of(30 * number, 5, -3, (1.5 * number, 0.2, 7)) for number in range(4)]
    rows = [(315966265259836000 + number * STEP_NS, *fields_of(pose)) for number, pose in enumerate(T)]
    motion, origin = city_motion(write_city(tmp_path, rows))
    assert origin.endswith(CITY)
    np.testing.assert_allclose(motion.pose(315966265.259836 + 0.2), T[2], atol=1e-4)
    assert city_motion(tmp_path) is None


def test_damaged_city_poses_are_one_line(tmp_path):
    folder = write_city(tmp_path, [(1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)])
    with pytest.raises(InputError, match="holds no poses that can be read"):
        city_motion(folder)
    (tmp_path / "log" / CITY).write_bytes(b"ARROW1")
    with pytest.raises(InputError, match="holds no poses that can be read"):
        city_motion(folder)
