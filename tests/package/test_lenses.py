"""Cameras with distorting lenses: the rays of their pixels, and the panorama through them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from lidar2pano.calibration import Calibration, LensCalibration
from lidar2pano.geometry.camera import at_camera, panorama_in_camera
from lidar2pano.geometry.projection import pixels
from lidar2pano.views import VIEWS
from slow_definitions import camera_pixel_slowly

K = np.array([[300.0, 0, 319.5], [0, 310, 199.5], [0, 0, 1]])
AHEAD = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]])
LENSES = [
    ("brown", (-0.3, 0.1, 0.001, -0.002, -0.01)),
    ("brown", (0.2, -0.05, 0.003, 0.002)),
    ("brown", (0.31, -0.12, 0.001, -0.002, 0.02, 0.45, -0.08, 0.01)),
    ("fisheye", (0.05, -0.01, 0.004, -0.001)),
    ("fisheye", (0.0, 0.0, 0.0, 0.0)),
    ("mei", (0.9, -0.1, 0.02, 0.001, -0.002)),
    ("mei", (1.0, 0.05, 0.0, 0.0, 0.0)),
]
# KITTI-360's two fisheye cameras, at a quarter of their 1400 x 1400 pixels
KITTI360 = [
    ((334.08, 333.95, 179.2, 176.4), (2.2134, 0.0168, 1.6549, 0.00042, 0.00042)),
    ((371.36, 371.24, 174.7, 174.5), (2.5535, 0.0494, 4.5068, 0.00135, -0.00070)),
]


def lens(model, distortion, size=(640, 400), focal=1.0) -> LensCalibration:
    scale = np.diag([focal, focal, 1.0])
    return LensCalibration(K=K @ scale, T_camera_lidar=AHEAD, size=size, model=model, distortion=distortion)


@pytest.mark.parametrize(("model", "distortion"), LENSES)
def test_rays_go_through_their_pixels(model, distortion):
    camera = lens(model, distortion)
    rays = camera.rays()
    assert rays.shape == (400, 640, 3) and np.isfinite(rays).all()
    np.testing.assert_allclose(np.linalg.norm(rays, axis=2), 1)
    for v, u in [(0, 0), (0, 639), (399, 639), (200, 319), (17, 500), (399, 3)]:
        np.testing.assert_allclose(camera_pixel_slowly(rays[v, u], camera), (u, v), atol=1e-6)


def kitti360(number: int, **changes) -> LensCalibration:
    (fx, fy, cx, cy), distortion = KITTI360[number]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    camera = LensCalibration(K=K, T_camera_lidar=AHEAD, size=(350, 350), model="mei", distortion=distortion)
    return replace(camera, **changes)


@pytest.mark.parametrize("number", [0, 1])
def test_rays_of_a_unified_projection_go_through_their_pixels(number):
    camera = kitti360(number)
    rays = camera.rays()
    known = np.isfinite(rays[..., 0])
    np.testing.assert_allclose(np.linalg.norm(rays[known], axis=1), 1)
    v, u = np.mgrid[0:350, 0:350]
    np.testing.assert_allclose(camera.project(rays)[known], np.stack([u, v], -1)[known], atol=1e-6)
    for row, column in np.argwhere(known)[::997]:
        np.testing.assert_allclose(camera_pixel_slowly(rays[row, column], camera), (column, row), atol=1e-6)
    widest = np.degrees(np.arccos(rays[known][:, 2].min()))
    xi = camera.distortion[0]
    assert 112 < widest <= np.degrees(np.arccos(-1 / xi)), "at that angle pixels no longer move outwards"
    assert known[175].all() and not known[0, 0] and not known[-1, -1]


@pytest.mark.parametrize(("model", "distortion"), [*LENSES, *(("mei", lens[1]) for lens in KITTI360)])
def test_projection_agrees_with_its_slow_definition(model, distortion):
    camera = lens(model, distortion)
    directions = np.random.default_rng(0).normal(size=(40, 50, 3)) + (0, 0, 1.5)
    found = camera.project(directions.astype(np.float32))
    assert found.shape == (40, 50, 2) and found.dtype == np.float64
    known = np.isfinite(found[..., 0])
    assert known.mean() > (0.5 if model == "brown" else 0.85)
    for at in np.argwhere(known)[::40]:
        direction = directions.astype(np.float32)[tuple(at)].astype(np.float64)
        np.testing.assert_allclose(found[tuple(at)], camera_pixel_slowly(direction, camera), atol=1e-6)
    assert (known[directions[..., 2] > 2]).all()
    if model == "brown":
        assert not known[directions[..., 2] <= 0].any()


def test_what_a_lens_does_not_project_has_no_pixel():
    nowhere = np.array([[0.0, 0, 0], [0, 0, -1], [np.nan, 0, 1], [np.inf, 0, 1]])
    for model, distortion in [*LENSES, ("mei", KITTI360[0][1])]:
        assert np.isnan(lens(model, distortion).project(nowhere)).all()
    turning = np.radians([0, 90, 116, 118, 150])  # xi = 2.2134 turns at 116.9 degrees
    directions = np.stack([np.sin(turning), 0 * turning, np.cos(turning)], -1)
    assert np.isfinite(kitti360(0).project(directions)[:, 0]).tolist() == [True, True, True, False, False]
    bent = lens("fisheye", (-0.3, 0.0, 0.0, 0.0))  # rises up to 1.054 radians
    aside = np.stack([np.sin([1.05, 1.06]), [0, 0], np.cos([1.05, 1.06])], -1)
    assert np.isfinite(bent.project(aside)[:, 0]).tolist() == [True, False]
    folded = lens("brown", (-1.0, 0.0, 0.0, 0.0, 0.1))  # falls from r = 0.59 on, and rises again from r = 1.37 on
    found = folded.project(np.array([[0.5, 0, 1], [0.9, 0, 1], [1.6, 0, 1]]))
    assert np.isfinite(found[:, 0]).tolist() == [True, False, False]


def test_beyond_the_image_circle_there_are_neither_rays_nor_pixels():
    camera, whole = kitti360(0, reach_deg=92.5), kitti360(0)
    rays, known = camera.rays(), np.isfinite(camera.rays()[..., 0])
    angle = np.degrees(np.arccos(whole.rays()[..., 2]))
    assert (known == (angle <= 92.5)).all() and (known < np.isfinite(angle)).any()
    np.testing.assert_array_equal(rays[known], whole.rays()[known])
    circle = np.argwhere(known)
    assert np.ptp(circle[:, 0]) == pytest.approx(2 * 166, abs=2) and np.ptp(circle[:, 1]) == pytest.approx(
        2 * 166, abs=2
    )
    directions = np.stack([np.sin(np.radians([92, 93])), [0, 0], np.cos(np.radians([92, 93]))], -1)
    assert np.isfinite(camera.project(directions)[:, 0]).tolist() == [True, False]
    assert np.isfinite(whole.project(directions)).all()
    for reach in (0.0, -1.0, 181.0, np.nan):
        with pytest.raises(ValueError, match="reach_deg must be above 0 and up to 180"):
            replace(camera, reach_deg=reach)


def test_a_unified_projection_of_a_pinhole_and_of_its_focal_length():
    rays = lens("mei", (0.0, -0.3, 0.1, 0.001, -0.002)).rays()
    np.testing.assert_allclose(rays, lens("brown", (-0.3, 0.1, 0.001, -0.002)).rays(), atol=1e-12)
    for model, distortion in [*LENSES, ("mei", KITTI360[0][1])]:
        camera = lens(model, distortion)
        steps = camera.project(np.array([[-1e-6, 0, 1], [1e-6, 0, 1]]))
        assert (steps[1, 0] - steps[0, 0]) / 2e-6 == pytest.approx(camera.focal_px, rel=1e-5)
    with pytest.raises(ValueError, match="xi, the first of 'mei', must be >= 0"):
        lens("mei", (-0.1, 0.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(("model", "distortion"), [one for one in LENSES if one[0] != "mei"])
def test_rays_agree_with_opencv(model, distortion):
    cv2 = pytest.importorskip("cv2", reason="OpenCV is the second implementation")
    camera = lens(model, distortion)
    rays, origin = camera.rays().reshape(1, -1, 3), np.zeros(3)
    project = cv2.fisheye.projectPoints if model == "fisheye" else cv2.projectPoints
    found = project(rays, origin, origin, camera.K, np.array(distortion))[0].reshape(400, 640, 2)
    v, u = np.mgrid[0:400, 0:640]
    np.testing.assert_allclose(found, np.stack([u, v], axis=2), atol=1e-6)


def test_a_fisheye_looks_beyond_90_degrees():
    camera = lens("fisheye", (0.0, 0.0, 0.0, 0.0), size=(1240, 400))
    moved = replace(camera, K=np.array([[300.0, 0, 619.5], [0, 310, 199.5], [0, 0, 1]]))
    rays = moved.rays()[199]
    assert rays[0, 2] < 0 and rays[-1, 2] < 0  # 619.5 / 300 radians: 118 degrees aside
    aside = np.degrees(np.arctan2(rays[0, 0], rays[0, 2]))
    assert aside == pytest.approx(-np.degrees(619.5 / 300), abs=0.01)


def test_pixels_that_no_light_reaches_have_no_ray():
    bent = lens("fisheye", (-0.3, 0.0, 0.0, 0.0))  # theta - 0.3 theta^3 rises up to 0.7027 only
    v, u = np.mgrid[0:400, 0:640]
    radius = np.hypot((u - 319.5) / 300, (v - 199.5) / 310)
    inside, outside = radius < 0.7025, radius > 0.7029
    assert np.isfinite(bent.rays()[inside]).all() and np.isnan(bent.rays()[outside]).all() and outside.any()
    narrow = lens("brown", (-1.5, 0.0, 0.0, 0.0))  # r (1 - 1.5 r^2) rises up to 0.314 only
    assert np.isfinite(narrow.rays()[200, 319]).all() and np.isnan(narrow.rays()[0, 0]).all()
    assert (np.isfinite(narrow.rays()[..., 0]) <= (radius < 0.315)).all()


def test_a_lens_without_distortion_is_the_pinhole():
    plain = Calibration(K=K, T_camera_lidar=AHEAD, size=(640, 400))
    same = lens("brown", (0.0, 0.0, 0.0, 0.0))
    assert same.centre == plain.centre
    view = at_camera(VIEWS["panorama"], same)
    ours, wanted = panorama_in_camera(view, same), panorama_in_camera(view, plain)
    assert (ours.valid != wanted.valid).sum() < 9  # on the border, where rounding decides
    both = ours.valid & wanted.valid
    torch.testing.assert_close(ours.row[both], wanted.row[both], atol=1e-3, rtol=0)
    torch.testing.assert_close(ours.column[both], wanted.column[both], atol=1e-3, rtol=0)


def test_the_panorama_through_a_fisheye_is_what_lies_in_each_direction():
    camera = lens("fisheye", (0.05, -0.01, 0.004, -0.001), focal=0.6)
    view = at_camera(VIEWS["panorama"].scaled(0.25), camera)
    lookup = panorama_in_camera(view, camera)
    for v, u in [(200, 320), (180, 5), (215, 630)]:
        ray = torch.from_numpy(AHEAD[:3, :3].T @ camera.rays()[v, u])
        row, column = pixels(*ray, view)
        assert lookup.valid[v, u]
        assert (float(lookup.row[v, u]), float(lookup.column[v, u])) == pytest.approx((float(row), float(column)))
    assert not lookup.valid[0, 320] and not lookup.valid[399, 320]


@pytest.mark.parametrize(
    ("model", "distortion"),
    [("fisheye", (0.0,) * 5), ("brown", (0.0,) * 3), ("mei", (0.0,) * 4), ("spline", (0.0,) * 4)],
)
def test_other_models_are_refused(model, distortion):
    with pytest.raises(ValueError, match="coefficients"):
        lens(model, distortion)
