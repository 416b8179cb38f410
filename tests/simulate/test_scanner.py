"""The simulated LiDAR: where its points lie, what they are called, and what is left out."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

from lidar2pano.simulate import scanner
from lidar2pano.simulate.scanner import Sweep, passing_time, sweep
from lidar2pano.simulate.scene import mesh
from lidar2pano.simulate.scene.mesh import Mesh
from lidar2pano.simulate.scene.random_streams import stream
from lidar2pano.simulate.scene.surfaces import MATERIALS
from lidar2pano.simulate.sensor_models import SENSOR_MODELS, SensorModel, blind_table

pytest.importorskip("embreex")

from lidar2pano.simulate.scene.raycast import Scene, SceneObject  # noqa: E402 needs embreex

HDL = SENSOR_MODELS["hdl64e"]
HALF = np.array([14.0, 9.0, 6.0])  # of the room's size, metres; its middle is the origin


def box(centre: tuple[float, ...], size: tuple[float, ...], material: str, object_type: str) -> Mesh:
    return mesh.merged([mesh.box(centre, size, material)], object_type)


def room(material: str = "concrete") -> Scene:
    return Scene([SceneObject(mesh=box((0, 0, 0), tuple(2 * HALF), material, "building"))])


def floor(size: float, material: str = "asphalt") -> Mesh:
    return box((0, 0, -1.93), (size, size, 0.4), material, "road")


def drive(speed: float = 0.0, yaw_rate: float = 0.0, at: tuple[float, float, float] = (0, 0, 0)) -> Callable:
    """Poses along x at `speed` m/s that turn by `yaw_rate` radians a second."""

    def pose(time: np.ndarray) -> np.ndarray:
        T = np.tile(np.eye(4), (len(time), 1, 1))
        c, s = np.cos(yaw_rate * time), np.sin(yaw_rate * time)
        T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = c, -s, s, c
        T[:, :3, 3] = at
        T[:, 0, 3] += speed * time
        return T

    return pose


def shot(
    scene: Scene, sensor: SensorModel = HDL, pose: Callable | None = None, *, clean: bool = False, number: int = 7
) -> Sweep:
    """One turn; `clean`: of a sensor without noise, lost returns and a car below it."""
    perfect = {"range_noise": 0.0, "range_step": 1e-6, "half_loss_range": 1e9, "blind_sectors": ()}
    perfect |= {"range_bias": (), "dropout": ()}
    with patch.object(scanner, "NO_EDGE", np.inf if clean else scanner.NO_EDGE):  # no mixed returns
        return sweep(scene, replace(sensor, **perfect) if clean else sensor, pose or drive(), stream(number, "test"))


def slow_point(sensor: SensorModel, beam: int, time: float, pose: Callable) -> np.ndarray:
    """Where one pulse meets the room: every turn and shift written out, for one beam."""
    azimuth = sensor.rotation * 360 * sensor.hz * time
    if sensor.encoder_step:
        azimuth = sensor.encoder_step * round(azimuth / sensor.encoder_step)
    head = math.radians(azimuth)
    left = head + math.radians(sensor.per_beam("azimuth")[beam])
    up = math.radians(sensor.elevation[beam])
    aside, rise = sensor.per_beam("origin_left")[beam], sensor.per_beam("origin_up")[beam]
    origin = np.array([-aside * math.sin(head), aside * math.cos(head), rise])
    direction = np.array([math.cos(up) * math.cos(left), math.cos(up) * math.sin(left), math.sin(up)])
    T = pose(np.array([time]))[0]
    origin, direction = T[:3, :3] @ origin + T[:3, 3], T[:3, :3] @ direction
    distance = min((math.copysign(half, w) - o) / w for half, o, w in zip(HALF, origin, direction, strict=True) if w)
    back = np.linalg.inv(pose(np.zeros(1))[0])
    return back[:3, :3] @ (origin + distance * direction) + back[:3, 3]


@pytest.mark.parametrize("name", SENSOR_MODELS)
def test_beams_agree_with_their_slow_definition(name: str) -> None:
    pose = drive(speed=12.0, yaw_rate=0.4, at=(1.0, -0.5, 0.3))
    scan = shot(room(), SENSOR_MODELS[name], pose, clean=True)
    assert len(scan.points) == len(SENSOR_MODELS[name]) * SENSOR_MODELS[name].firings
    some = stream(1, "some").choice(len(scan.points), 300, replace=False)
    slow = np.array([slow_point(SENSOR_MODELS[name], int(scan.ring[i]), float(scan.time[i]), pose) for i in some])
    away = np.linalg.norm(scan.points[some, :3] - slow, axis=1)
    # The encoder's rounding may fall to the other side where time is exactly between two steps (float32).
    assert np.quantile(away, 0.98) < 1e-3


def test_without_noise_points_lie_on_the_surface() -> None:
    scan = shot(room(), clean=True)
    off = np.abs(np.abs(scan.points[:, :3]) - HALF.astype(np.float32)).min(axis=1)
    assert np.median(off) < 1e-4
    assert off.max() < 2e-3


def test_the_turn_is_centred_on_straight_ahead() -> None:
    scan = shot(room(), clean=True)
    azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))
    assert np.abs(scan.time[np.abs(azimuth) < 1]).max() < 0.01 / HDL.hz
    left = (azimuth > 80) & (azimuth < 100)
    assert scan.time[left].mean() == pytest.approx(0.25 / HDL.hz, rel=0.02)  # KITTI's turns to the left
    other = shot(room(), replace(HDL, rotation=-1), clean=True)
    azimuth = np.degrees(np.arctan2(other.points[:, 1], other.points[:, 0]))
    assert other.time[(azimuth > 80) & (azimuth < 170)].max() < 0


def test_a_driving_sensor_sees_the_wall_that_a_standing_one_sees() -> None:
    for pose in (drive(), drive(speed=15.0, yaw_rate=0.5)):
        scan = shot(room(), pose=pose, clean=True)
        assert np.abs(np.abs(scan.points[:, :3]) - HALF.astype(np.float32)).min(axis=1).max() < 3e-3
    drawn = np.sort(scan.points[:, 0])
    assert drawn[-1] < HALF[0] + 3e-3


def test_a_moving_car_is_where_it_was_when_the_beam_passed() -> None:
    speed, azimuth = 30.0, np.radians([-170, -100, -40, 0, 40, 100, 170])
    middle = np.stack([12 * np.cos(azimuth), 12 * np.sin(azimuth), 0 * azimuth], axis=1)
    moment = passing_time(HDL, drive()(np.zeros(1))[0], middle)
    place = middle + np.stack([speed * moment, 0 * moment, 0 * moment], axis=1)
    cars = [box(tuple(xyz), (0.4, 0.4, 4.0), "paint", "car") for xyz in place]
    moving = [SceneObject(mesh=car, instance=number, moving=True) for number, car in enumerate(cars, start=1)]
    scene = Scene([SceneObject(mesh=floor(80))]).with_moving(moving)
    scan = shot(scene, clean=True, number=2)
    hit = scan.raw == 252
    assert set(scan.instance[hit]) == set(range(1, 8))
    expected = middle[scan.instance[hit] - 1, 0] + speed * scan.time[hit]
    assert np.abs(scan.points[hit, 0] - expected).max() < 0.2 + 0.15, "half a car, and its path in a part of the turn"
    assert np.ptp(speed * scan.time[hit]) > 2.5, "they are not seen at one moment"


def test_the_beam_passes_places_when_passing_says() -> None:
    scan, pose = shot(room(), clean=True), drive(at=(1.0, 2.0, 0.5), yaw_rate=0.3)
    frame = pose(np.zeros(1))[0]
    world = scan.points[:, :3] @ frame[:3, :3].T + frame[:3, 3]
    off = passing_time(HDL, frame, world.astype(np.float64)) - scan.time
    assert np.quantile(np.abs(off), 0.99) < 0.002 / HDL.hz  # 0.7 degrees: parallax and the encoder's steps


def test_labels_and_instances_are_those_of_what_was_met() -> None:
    things = [("car", 3, 10, 0.0), ("pole", 0, 80, 90.0), ("person", 7, 30, 180.0)]
    parts = [SceneObject(mesh=floor(60))]
    for object_type, instance, _, azimuth in things:
        x, y = 8 * math.cos(math.radians(azimuth)), 8 * math.sin(math.radians(azimuth))
        parts.append(SceneObject(mesh=box((x, y, 0), (1, 1, 3), "cloth", object_type), instance=instance))
    scan = shot(Scene(parts), clean=True)
    for _, instance, raw, azimuth in things:
        x, y = 8 * math.cos(math.radians(azimuth)), 8 * math.sin(math.radians(azimuth))
        at = (
            (np.abs(scan.points[:, 0] - x) < 0.49) & (np.abs(scan.points[:, 1] - y) < 0.49) & (scan.points[:, 2] > -1.6)
        )
        at |= (np.hypot(scan.points[:, 0] - x, scan.points[:, 1] - y) < 0.71) & (np.abs(scan.points[:, 2]) < 1)
        assert at.sum() > 50
        assert set(scan.raw[at].tolist()) == {raw}
        assert set(scan.instance[at].tolist()) == {instance}
    assert set(scan.raw.tolist()) == {40, 10, 80, 30}
    assert set(scan.instance[scan.raw == 40].tolist()) == {0}


def test_the_sky_and_what_is_too_far_or_too_near_send_nothing_back() -> None:
    scan = shot(Scene([SceneObject(mesh=floor(400))]))
    assert (scan.raw == 40).all()
    assert scan.points[:, 2].max() < -1.4
    distance = np.linalg.norm(scan.points[:, :3], axis=1)
    assert 70 < distance.max() < HDL.max_range + 0.5
    near = Scene([SceneObject(mesh=box((0, 0, 0), (2.2, 2.2, 2.2), "concrete", "building"))])
    assert np.linalg.norm(shot(near).points[:, :3], axis=1).min() > HDL.min_range - 0.3
    assert len(shot(near).points) < 0.3 * len(shot(room()).points)


def test_number_plates_are_near_one_and_glass_is_mostly_lost() -> None:
    plate = shot(room("plate"))
    assert np.median(plate.points[:, 3]) > 0.9
    assert plate.points[:, 3].max() == pytest.approx(0.99)
    assert np.median(shot(room("concrete")).points[:, 3]) == pytest.approx(MATERIALS["concrete"].remission, abs=0.06)
    assert len(shot(room("window")).points) < 0.25 * len(shot(room("concrete")).points)


def test_files_are_ordered_as_kittis() -> None:
    scan = shot(room())
    assert (np.diff(scan.ring.astype(int)) >= 0).all()
    azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0])) % 360
    assert (np.diff(azimuth) < -180).sum() == 63  # what readers of KITTI's files take for the next ring
    within = np.diff(scan.ring.astype(int)) == 0
    assert np.diff(azimuth)[within].min() > -1e-3
    assert set(np.unique(np.round(scan.points[:, 3] * 100, 3) % 1)) == {0}


def test_other_sensors_write_firing_by_firing() -> None:
    scan = shot(room(), SENSOR_MODELS["hdl32e"])
    assert (np.diff(scan.time) >= 0).all()
    assert (np.diff(scan.ring.astype(int))[np.diff(scan.time) == 0] > 0).all()


def test_the_same_generator_gives_the_same_bytes() -> None:
    once, again = shot(room()), shot(room())
    for name in ("points", "raw", "instance", "ring", "time"):
        assert getattr(once, name).tobytes() == getattr(again, name).tobytes()
    other = sweep(room(), HDL, drive(), stream(8, "test"))
    assert other.points.tobytes() != once.points.tobytes()


def test_beams_lose_what_the_table_says() -> None:
    sensor = replace(HDL, dropout=tuple(np.linspace(0.02, 0.3, 64).tolist()))
    scan = shot(room(), sensor)
    open_ = sensor.firings * (1 - blind_table(sensor).mean(axis=1))
    share = 1 - np.bincount(scan.ring, minlength=64) / open_
    assert np.abs(share - sensor.per_beam("dropout")).max() < 0.05
    assert np.abs(share - sensor.per_beam("dropout")).mean() < 0.01


def test_the_recording_car_hides_its_directions() -> None:
    scan = shot(room())
    azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0])) % 360
    for beam, spans in HDL.blind_sectors:
        for start, stop in spans:
            inside = (scan.ring == beam) & (azimuth > start + 0.8) & (azimuth < stop - 0.8)  # but for the parallax
            assert not inside.any()


def test_range_noise_and_bias_are_the_sensors() -> None:
    scan, clean = shot(room()), shot(room(), clean=True)
    error = np.abs(np.abs(scan.points[:, :3]) - HALF.astype(np.float32))
    ahead = (scan.points[:, 0] > 0) & (np.abs(scan.points[:, 1]) < 3) & (np.abs(scan.points[:, 2]) < 2)
    residual = scan.points[ahead, 0] - HALF[0]
    for beam in (5, 6, 20):
        of = residual[scan.ring[ahead] == beam]
        assert np.mean(of) == pytest.approx(HDL.range_bias[beam], abs=0.004)
        assert np.std(of) == pytest.approx(HDL.range_noise, rel=0.25)
    assert error.min(axis=1).max() < 0.3
    assert len(clean.points) > len(scan.points)


def test_a_place_keeps_its_reflectance() -> None:
    flat = replace(HDL, remission_noise=0.0, dark_offset=(), bright_offset=(), dropout=(), encoder_step=0.0)

    def brightness(number: int, at: tuple[float, float, float]) -> dict[tuple[int, int], float]:
        scan = sweep(room("brick"), flat, drive(at=at), stream(number, "test"))
        front = np.abs(scan.points[:, 0] + at[0] - HALF[0]) < 0.1
        place = np.round((scan.points[front, 1:3] + np.array(at)[1:]) / 0.1).astype(int)
        return dict(zip(map(tuple, place.tolist()), scan.points[front, 3].tolist(), strict=True))

    here, there = brightness(1, (0, 0, 0)), brightness(2, (-2.0, 0.4, 0.1))
    both = sorted(set(here) & set(there))
    assert len(both) > 500
    assert np.corrcoef([here[p] for p in both], [there[p] for p in both])[0, 1] > 0.4


def test_edges_have_points_between_their_sides() -> None:
    post = box((5, 0, 0), (0.3, 8, 12), "concrete", "wall")
    scene = Scene([SceneObject(mesh=box((0, 0, 0), (16, 16, 12), "concrete", "building")), SceneObject(mesh=post)])
    scan = shot(scene)
    between = (scan.points[:, 0] > 5.5) & (scan.points[:, 0] < 7.5) & (np.abs(scan.points[:, 1]) < 7.8)
    between &= np.abs(scan.points[:, 2]) < 2
    clean = shot(scene, clean=True)
    none = (clean.points[:, 0] > 5.5) & (clean.points[:, 0] < 7.5) & (np.abs(clean.points[:, 1]) < 7.8)
    assert not (none & (np.abs(clean.points[:, 2]) < 2)).any()
    assert 1 <= between.sum() < 60


def test_tables_have_a_number_per_beam() -> None:
    for sensor in SENSOR_MODELS.values():
        assert (np.diff(sensor.elevation) < 0).all()
        for name in ("azimuth", "origin_up", "origin_left", "range_bias", "dropout", "dark_offset", "bright_offset"):
            assert len(sensor.per_beam(name)) == len(sensor)
