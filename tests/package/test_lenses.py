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

K = np.array([[300.0, 0, 319.5], [0, 310, 199.5], [0, 0, 1]])
AHEAD = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]])
LENSES = [
    ("brown", (-0.3, 0.1, 0.001, -0.002, -0.01)),
    ("brown", (0.2, -0.05, 0.003, 0.002)),
    ("fisheye", (0.05, -0.01, 0.004, -0.001)),
    ("fisheye", (0.0, 0.0, 0.0, 0.0)),
]


def lens(model, distortion, size=(640, 400), focal=1.0) -> LensCalibration:
    scale = np.diag([focal, focal, 1.0])
    return LensCalibration(K=K @ scale, T_camera_lidar=AHEAD, size=size, model=model, distortion=distortion)


def project_slowly(ray, camera: LensCalibration) -> tuple[float, float]:
    """The pixel (u, v) of a direction, as OpenCV's documentation writes both models."""
    x, y, z = ray
    if camera.model == "fisheye":
        radius = np.hypot(x, y)
        theta = np.arctan2(radius, z)
        k1, k2, k3, k4 = camera.distortion
        theta_d = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
        scale = theta_d / radius if radius else 1.0
        xd, yd = x * scale, y * scale
    else:
        k1, k2, p1, p2, k3 = (*camera.distortion, 0.0)[:5]
        a, b = x / z, y / z
        r2 = a * a + b * b
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        xd = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
        yd = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
    u, v, _ = camera.K @ np.array([xd, yd, 1.0])
    return u, v


@pytest.mark.parametrize(("model", "distortion"), LENSES)
def test_rays_go_through_their_pixels(model, distortion):
    camera = lens(model, distortion)
    rays = camera.rays()
    assert rays.shape == (400, 640, 3) and np.isfinite(rays).all()
    np.testing.assert_allclose(np.linalg.norm(rays, axis=2), 1)
    for v, u in [(0, 0), (0, 639), (399, 639), (200, 319), (17, 500), (399, 3)]:
        np.testing.assert_allclose(project_slowly(rays[v, u], camera), (u, v), atol=1e-6)


@pytest.mark.parametrize(("model", "distortion"), LENSES)
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
    ("model", "distortion"), [("fisheye", (0.0,) * 5), ("brown", (0.0,) * 3), ("spline", (0.0,) * 4)]
)
def test_other_models_are_refused(model, distortion):
    with pytest.raises(ValueError, match="coefficients"):
        lens(model, distortion)
