"""Surfaces in a camera's axes, against their slow definition, and the exposure of a camera without an image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from lidar2pano.geometry.projection import directions
from lidar2pano.geometry.stitching import Camera, homogeneous, metered_gain, points_in, surfaces_in
from lidar2pano.views import VIEWS
from miniature_surround import camera


@pytest.mark.parametrize(
    "view", [VIEWS["panorama"].scaled(1 / 32), replace(VIEWS["hdl64e"].scaled(1 / 8), origin=(1, 2, 3))]
)
def test_surfaces_are_rays_times_depths_in_the_axes_of_a_camera(view):
    calibration = camera(50.0, (0.7, -0.3, 0.2))
    one = Camera(np.zeros((300, 480, 3), np.uint8), calibration)
    depth_m = torch.rand(view.rows, view.columns, generator=torch.Generator().manual_seed(2)) * 50 + 1
    depth_m[0], depth_m[1, 2] = torch.inf, 0.0
    T = torch.from_numpy(calibration.T_camera_lidar)
    rays, place = directions(view).double(), torch.tensor(view.origin, dtype=torch.float64)
    expected = (rays * depth_m.double()[..., None] + place) @ T[:3, :3].T + T[:3, 3]
    expected[0] = rays[0] @ T[:3, :3].T
    expected[1, 2] = torch.nan
    points = surfaces_in(one, view, homogeneous(depth_m))
    torch.testing.assert_close(points[:3].movedim(0, 2), expected.float(), equal_nan=True, atol=1e-4, rtol=1e-6)
    assert (points[3, 0] == 0).all() and points[3, 1, 2].isnan() and (points[3, 2:] == 1).all()
    rows, columns = slice(1, None, 3), torch.tensor([5, 2])
    part = surfaces_in(one, view, homogeneous(depth_m[rows][:, columns]), rows, columns)
    torch.testing.assert_close(part, points[:, rows][:, :, columns], equal_nan=True)


def test_points_are_moved_to_the_axes_of_a_camera():
    calibration = camera(-20.0, (0.7, -0.3, 0.2))
    xyz = torch.rand(3, 20, generator=torch.Generator().manual_seed(3)) * 20
    points = points_in(Camera(np.zeros((300, 480, 3), np.uint8), calibration), xyz)
    expected = calibration.T_camera_lidar @ np.vstack([xyz.numpy(), np.ones(20)])
    np.testing.assert_allclose(points, expected, atol=1e-5)


def with_gains(*gains: float) -> list[Camera]:
    image = np.full((300, 480, 3), 100, dtype=np.uint8)
    return [Camera(image, camera(0.0, (0.0, 0.0, 0.0)), gain=(gain, gain, gain)) for gain in gains]


def test_cameras_that_meter_tell_the_level():
    assert metered_gain(50.0, with_gains(0.5, 1.0, 2.0), [100.0] * 3) == pytest.approx(2.0)


def test_cameras_of_one_exposure_leave_the_level():
    assert metered_gain(50.0, with_gains(1.0, 1.0, 1.0), [60.0, 100.0, 140.0]) == 1.0
    assert metered_gain(50.0, with_gains(0.99, 1.0, 1.01), [60.0, 100.0, 140.0]) == pytest.approx(1.0, abs=0.01)


def test_both_guesses_are_averaged_by_their_inverse_variances():
    spread = np.log(2)
    levels = np.exp(np.log(100) + spread * np.array([-1, 0, 1]))
    gains = np.exp(2 * spread * np.array([1, -1, 0]))  # four times the variance
    assert metered_gain(50.0, with_gains(*gains), list(levels)) == pytest.approx(2 ** (4 / 5))
    brighter = metered_gain(50.0, with_gains(*(3 * gains)), list(levels))
    assert brighter == pytest.approx(2 ** (4 / 5) * 3 ** (-1 / 5)), "the panorama is three times as bright as they are"


def test_too_little_tells_nothing():
    assert metered_gain(50.0, with_gains(2.0), [100.0]) == 1.0
    assert metered_gain(50.0, [], []) == 1.0
    assert metered_gain(0.0, with_gains(0.5, 2.0), [100.0] * 2) == 1.0
    assert metered_gain(50.0, with_gains(0.5, 2.0), [0.0, 100.0]) == 1.0
