"""Rasters of other programs, by their own conventions."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidar2pano.geometry.camera import cube_faces, equirectangular, lookups, panorama_in_view
from lidar2pano.geometry.projection import directions
from lidar2pano.views import VIEWS, View
from slow_definitions import look_up_slowly

VIEW = VIEWS["panorama"].scaled(1 / 16)  # 24 x 288


def sphere_ray(row: int, column: int, full_columns: int) -> tuple[float, float, float]:
    """Direction of a pixel of a full equirectangular image: ahead in the middle, left of it to the left, up on top."""
    azimuth = math.pi - (column + 0.5) / full_columns * 2 * math.pi
    elevation = math.pi / 2 - (row + 0.5) / (full_columns / 2) * math.pi
    return math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)


def resample(image: np.ndarray, lookup) -> np.ndarray:
    return lookup.linear(torch.from_numpy(image).movedim(2, 0)).movedim(0, 2).numpy()


@pytest.fixture
def image() -> np.ndarray:
    return np.random.default_rng(4).uniform(0, 255, (VIEW.rows, VIEW.columns, 3)).astype(np.float32)


def test_an_equirectangular_image_is_that_of_the_slow_definition(image):
    (lookup,) = lookups(VIEW, "equirectangular").values()
    target, colour = equirectangular(VIEW), resample(image, lookup)
    top = round((90 - target.up) / 360 * VIEW.columns)
    assert colour.shape == (target.rows, VIEW.columns, 3) and lookup.valid.all()
    assert target.rows == pytest.approx((math.atan(0.24) + math.atan(0.2836)) * VIEW.focal_px, abs=1)
    for row in (0, 5, target.rows - 1):
        for column in (0, 71, 144, 287):
            wanted = look_up_slowly(image, VIEW, sphere_ray(top + row, column, VIEW.columns))
            assert colour[row, column] == pytest.approx(wanted, abs=0.05)


def test_an_equirectangular_image_has_ahead_in_its_middle_and_left_at_its_left():
    rays = directions(equirectangular(VIEW))
    middle = rays[:, VIEW.columns // 2 - 1 : VIEW.columns // 2 + 1].mean((0, 1))
    assert middle[0] > 0.9 and abs(middle[1]) < 1e-3
    assert rays[0, VIEW.columns // 4, 1] > 0.9 and rays[0, 3 * VIEW.columns // 4, 1] < -0.9
    assert rays[0, 0, 2] > 0 > rays[-1, 0, 2]


@pytest.mark.parametrize(
    "view",
    [
        VIEW,
        VIEWS["panorama"],
        replace(VIEW, left=45.0, right=-45.0, columns=72),
        replace(VIEW, left=200.0, right=100.0, columns=80),
        View(rows=40, columns=100, up=95.0, down=-95.0),
        View(rows=3, columns=101, up=0.001, down=-0.001, kind="cylinder"),
    ],
)
def test_an_equirectangular_view_is_whole_pixels_of_a_sphere_and_within_the_view(view):
    target = equirectangular(view)
    step = (target.left - target.right) / target.columns
    full = round(360 / step)
    assert full % 2 == 0 and full * step == pytest.approx(360)
    assert (target.up - target.down) / target.rows == pytest.approx(step)
    for border in ((90 - target.up) / step, (180 - target.left) / step):
        assert border == pytest.approx(round(border), abs=1e-6) and border >= -1e-6
    assert -90 - 1e-9 <= target.down < target.up <= 90 + 1e-9
    if view.left <= 180 and view.rows > 3:
        assert panorama_in_view(view, target).valid.all()


# Middles of faces, and directions just beyond the edges of the face ahead, by hand: x forward, y left, z up
@pytest.mark.parametrize(
    ("face", "row", "column", "ray"),
    [
        ("front", 0.5, 0.5, (1, 0, 0)),
        ("right", 0.5, 0.5, (0, -1, 0)),
        ("back", 0.5, 0.5, (-1, 0, 0)),
        ("left", 0.5, 0.5, (0, 1, 0)),
        ("up", 0.5, 0.5, (0, 0, 1)),
        ("down", 0.5, 0.5, (0, 0, -1)),
        ("front", 0.5, 0.0, (1, 1, 0)),
        ("left", 0.5, 1.0, (1, 1, 0)),
        ("front", 0.5, 1.0, (1, -1, 0)),
        ("right", 0.5, 0.0, (1, -1, 0)),
        ("back", 0.5, 0.0, (-1, -1, 0)),
        ("front", 0.0, 0.5, (1, 0, 1)),
        ("up", 1.0, 0.5, (1, 0, 1)),
        ("up", 0.5, 0.0, (0, 1, 1)),
        ("front", 1.0, 0.5, (1, 0, -1)),
        ("down", 0.0, 0.5, (1, 0, -1)),
        ("down", 0.5, 0.0, (0, 1, -1)),
    ],
)
def test_faces_of_a_cube(face, row, column, ray):
    camera = cube_faces(VIEW)[face]
    size = camera.size[0]
    pixel = np.array([column * size - 0.5, row * size - 0.5, 1.0])
    direction = camera.T_camera_lidar[:3, :3].T @ np.linalg.inv(camera.K) @ pixel
    assert direction / np.linalg.norm(direction) == pytest.approx(np.array(ray) / np.linalg.norm(ray), abs=1e-9)
    assert camera.centre == pytest.approx(VIEW.origin) and np.linalg.det(camera.T_camera_lidar) == pytest.approx(1)
    assert size / 2 == pytest.approx(VIEW.focal_px, abs=1)


def test_a_cube_has_the_colours_of_the_slow_definition_and_is_black_beyond_the_panorama(image):
    faces = lookups(VIEW, "cubemap")
    assert list(faces) == [".front", ".right", ".back", ".left", ".up", ".down"]
    size = 2 * round(VIEW.focal_px)
    colour = resample(image, faces[".left"])
    for row, column in ((size // 2, 3), (size // 2 + 5, size - 2), (size // 2 - 4, 40)):
        ray = ((column + 0.5) * 2 / size - 1, 1.0, 1 - (row + 0.5) * 2 / size)  # to its right lies ahead
        assert colour[row, column] == pytest.approx(look_up_slowly(image, VIEW, ray), abs=0.05)
    assert not colour[0].any() and not faces[".up"].valid.any()
