"""Poses between recorded ones, and scans without the skew of a moving sensor."""

from __future__ import annotations

import numpy as np
import pytest

from lidar2pano.geometry.motion import SensorMotion, Trajectory, deskewed, quaternion, rotation_matrices
from slow_definitions import deskewed_slowly, pose_between


def turned(degrees: float, axis=(0.0, 0.0, 1.0)) -> tuple[float, ...]:
    half = np.radians(degrees) / 2
    return (*(np.sin(half) * np.asarray(axis) / np.linalg.norm(axis)), np.cos(half))


def some_trajectory(seed: int = 0, count: int = 6) -> Trajectory:
    generator = np.random.default_rng(seed)
    rows = []
    for number in range(count):
        rotation = generator.normal(size=4)
        rows.append((10 + 0.1 * number, *generator.normal(0, 5, 3), *rotation / np.linalg.norm(rotation)))
    return Trajectory.of(rows)


@pytest.mark.parametrize("seed", range(3))
def test_poses_agree_with_their_definition(seed):
    trajectory = some_trajectory(seed)
    stamps = np.random.default_rng(seed).uniform(9.9, 10.7, 200)
    wanted = np.stack([pose_between(trajectory, stamp) for stamp in stamps])
    np.testing.assert_allclose(trajectory.at(stamps), wanted, atol=1e-9)


def test_half_way_is_half_the_turn():
    trajectory = Trajectory.of([(0, 0, 0, 0, *turned(0)), (2, 4, 0, 0, *turned(90))])
    T = trajectory.at(np.array([1.0]))[0]
    np.testing.assert_allclose(T[:3, 3], [2, 0, 0])
    np.testing.assert_allclose(T[:3, :3], rotation_matrices(np.array([turned(45)]))[0], atol=1e-12)


def test_the_shorter_way_is_taken():
    trajectory = Trajectory.of([(0, 0, 0, 0, *turned(10)), (1, 0, 0, 0, *(-value for value in turned(30)))])
    found = trajectory.at(np.array([0.5]))[0, :3, :3]
    np.testing.assert_allclose(found, rotation_matrices(np.array([turned(20)]))[0], atol=1e-12)


def test_rows_are_sorted_and_the_last_of_a_stamp_counts():
    rows = [(2, 2, 0, 0, *turned(0)), (1, 1, 0, 0, *turned(0)), (2, 5, 0, 0, *turned(0))]
    trajectory = Trajectory.of(rows)
    assert trajectory.stamp_s.tolist() == [1, 2] and trajectory.translation[:, 0].tolist() == [1, 5]


def test_one_pose_holds_always():
    trajectory = Trajectory.of([(3, 1, 2, 3, *turned(90))])
    for stamp in (0.0, 3.0, 9.0):
        np.testing.assert_allclose(trajectory.at(np.array([stamp]))[0, :3, 3], [1, 2, 3])


@pytest.mark.parametrize("row", [(0, 0, 0, 0, 0, 0, 0, 0), (0, np.nan, 0, 0, 0, 0, 0, 1), (0, 0, 0, 0, 0, 0, 0, 2)])
def test_what_is_no_pose_is_refused(row):
    with pytest.raises(ValueError, match="not a pose"):
        Trajectory.of([row])
    with pytest.raises(ValueError, match="not a pose"):
        Trajectory.of([])


def test_quaternions_there_and_back():
    rotation = some_trajectory(4).rotation
    for wanted, R in zip(rotation, rotation_matrices(rotation), strict=True):
        assert abs(quaternion(R) @ wanted) == pytest.approx(1)


def test_a_motion_is_the_product_of_its_links():
    first, second = some_trajectory(1), some_trajectory(2)
    mount = np.eye(4)
    mount[:3, 3] = 1, 2, 3
    stamp = np.array([10.23])
    motion = SensorMotion((first, mount, second))
    np.testing.assert_allclose(motion.at(stamp)[0], first.at(stamp)[0] @ mount @ second.at(stamp)[0])
    assert motion.pose(10.9) is not None and motion.pose(9.6) is not None
    assert motion.pose(11.1) is None and motion.pose(9.4) is None


def test_deskewing_agrees_with_its_definition():
    rows = [(10 + 0.1 * number, 2.0 * number, 0.3 * number, 0.0, *turned(7.0 * number)) for number in range(5)]
    motion = SensorMotion((Trajectory.of(rows),))
    generator = np.random.default_rng(0)
    xyz = generator.normal(0, 20, (500, 3)).astype(np.float32)
    time_s = generator.uniform(-0.1, 0.1, 500)
    time_s[3] = np.nan
    found = deskewed(xyz, time_s, 10.2, motion)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, deskewed_slowly(xyz, time_s, 10.2, motion), atol=0.02)
    np.testing.assert_array_equal(found[3], xyz[3])


def test_a_wall_measured_while_driving_is_flat_again():
    """A sensor drives at 20 m/s along x, and measures a wall at x = 50 during 0.1 s."""
    motion = SensorMotion((Trajectory.of([(0, 0, 0, 0, *turned(0)), (1, 20, 0, 0, *turned(0))]),))
    time_s = np.linspace(0, 0.1, 101)
    wall = np.stack([50 - 20 * (0.5 + time_s), np.linspace(-5, 5, 101), np.zeros(101)], 1)
    found = deskewed(wall, time_s, 0.5, motion)
    np.testing.assert_allclose(found[:, 0], 40, atol=0.003)
    assert np.ptp(wall[:, 0]) == pytest.approx(2)


@pytest.mark.parametrize("time_s", [np.full(5, np.nan), np.full(5, 3e9), np.full(5, -np.inf)])
def test_times_of_no_sweep_change_nothing(time_s):
    xyz = np.ones((5, 3), np.float32)
    np.testing.assert_array_equal(deskewed(xyz, time_s, 10.2, SensorMotion((some_trajectory(),))), xyz)
