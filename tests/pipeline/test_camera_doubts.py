"""Cameras that are of no use, and why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lidar2pano.calibration import Calibration
from lidar2pano.geometry.stitching import Camera
from lidar2pano.pipeline.composition import UPSIDE_DOWN, sound_cameras
from lidar2pano.scan import Scan
from miniature_surround import FOCAL, SIZE, camera, camera_view, sweep

AHEAD = camera(0.0, (0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def scan() -> Scan:
    xyz, _ = sweep(32, 600)
    return Scan(xyz=xyz, remission=np.zeros(len(xyz), dtype=np.float32))


@pytest.fixture(scope="module")
def photo() -> Camera:
    return Camera(camera_view(AHEAD), AHEAD, name="front")


def up() -> Calibration:
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    return Calibration(K=AHEAD.K, T_camera_lidar=T, size=SIZE)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"image": np.full((300, 480, 3), 3, np.uint8)}, "black"),
        ({"image": np.full((300, 480, 3), 254, np.uint8)}, "burnt out"),
        ({"time_s": 3600.0}, "3.6e+03 s after the scan"),
        ({"time_s": -0.2}, "0.2 s before the scan"),
        ({"calibration": up()}, "looks away from all points"),
    ],
)
def test_a_useless_camera_is_left_out_with_one_line_and_the_others_stay(scan, photo, change, says):
    kept, (doubt,) = sound_cameras([photo, replace(photo, name="bad", **change)], scan, edges=True)
    assert [one.name for one in kept] == ["front"]
    assert doubt.startswith("camera bad is left out: ") and says in doubt and "\n" not in doubt


def test_an_image_may_be_read_only(scan, photo):
    """As np.asarray(Image.open(...)) is; PyTorch warns where it takes such memory as its own."""
    image = photo.image.copy()
    image.setflags(write=False)
    kept, _ = sound_cameras([replace(photo, image=image)], scan, edges=True)
    assert len(kept) == 1


@pytest.mark.parametrize("change", [{"time_s": 0.09}, {"image": None}])
def test_a_night_and_a_small_delay_are_no_doubt(scan, photo, change):
    if change.get("image", 0) is None:
        night = np.zeros_like(photo.image)
        night[:30, :80] = 200  # a lamp and what it lights: 2 %
        change = {"image": night}
    kept, doubts = sound_cameras([replace(photo, **change)], scan, edges=True)
    assert len(kept) == 1 and not doubts


def boards() -> tuple[Scan, np.ndarray]:
    """A scan of boards before a wall that ends at half its height, and the image ahead: boards are bright."""
    azimuth = np.radians(np.arange(-180, 180, 360 / 1024) + 0.1)
    elevation = np.radians(np.linspace(2, -24, 64))
    a, e = np.meshgrid(azimuth, elevation)
    board = (np.floor(np.degrees(a) / 3) % 2 == 0) & (np.degrees(e) < -4)
    distance = np.where(board, 6.0, 15.0)
    ray = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1)
    xyz = (distance[..., None] * ray).reshape(-1, 3).astype(np.float32)
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    side = np.degrees(np.arctan2(SIZE[0] / 2 - u, FOCAL))
    drop = np.degrees(np.arctan2(SIZE[1] / 2 - 6 - v, np.hypot(FOCAL, SIZE[0] / 2 - u)))
    bright = (np.floor(side / 3) % 2 == 0) & (drop < -4)
    image = np.where(bright, 200, 60).astype(np.uint8)
    return Scan(xyz=xyz, remission=np.zeros(len(xyz), np.float32)), np.repeat(image[..., None], 3, 2)


def test_an_upside_down_pose_is_noticed_by_its_edges():
    scan, image = boards()
    right = Camera(image, AHEAD, name="front")
    wrong = replace(right, calibration=replace(AHEAD, T_camera_lidar=UPSIDE_DOWN @ AHEAD.T_camera_lidar))
    assert sound_cameras([right], scan, edges=True) == ([right], ())
    kept, (doubt,) = sound_cameras([wrong], scan, edges=True)
    assert kept == [wrong], "a warning: the picture is the user's to judge"
    assert "turned by 180 degrees" in doubt
    assert sound_cameras([wrong], scan, edges=False) == ([wrong], ())
