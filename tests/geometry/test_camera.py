from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from lidar2pano.calibration import Calibration, read_calib
from lidar2pano.formats.readers import read
from lidar2pano.geometry.camera import (
    Lookup,
    at_camera,
    camera_in_panorama,
    panorama_in_camera,
    points_in_camera,
)
from lidar2pano.geometry.projection import pixels, project
from lidar2pano.views import VIEWS, View

AXES = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # x ahead, y left, z up -> camera


def camera(width: int = 310, height: int = 94, focal: float = 180.0, turn: float = 0.0) -> Calibration:
    """A camera near the sensor that looks ahead, turned to the left by `turn` radians."""
    cos, sin = np.cos(turn), np.sin(turn)
    T = AXES @ np.array([[cos, sin, 0, 0], [-sin, cos, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    T[:3, 3] = 0.1, -0.2, 0.3
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return Calibration(K=K, T_camera_lidar=T, size=(width, height))


def kitti(root: Path, sequence: str = "drive") -> Calibration:
    return read_calib(root / "sequences" / sequence / "calib.txt", (1242, 375))


def panorama(calibration: Calibration, factor: float = 0.5) -> View:
    return at_camera(VIEWS["panorama"].scaled(factor), calibration)


def smooth(height: int, width: int) -> Tensor:
    """Three channels in [0, 1] that change slowly."""
    v, u = torch.meshgrid(torch.linspace(0, 6, height), torch.linspace(0, 9, width), indexing="ij")
    return torch.stack([u.sin(), v.cos(), (u + 2 * v).sin()]) / 2 + 0.5


def there_and_back(image: Tensor, calibration: Calibration, view: View) -> tuple[Tensor, Tensor]:
    """Camera -> panorama -> camera; and where the picture came back from inside of both."""
    into, back = camera_in_panorama(view, calibration), panorama_in_camera(view, calibration)
    returned, came = back.linear(into.linear(image)), back.linear(into.valid.float())
    return returned, came > 0.999


@pytest.mark.parametrize("turn", [0.0, 2.0, np.pi])
def test_a_smooth_image_survives_the_way_to_the_panorama_and_back(turn):
    calibration = camera(turn=turn, focal=220.0)
    image = smooth(94, 310)
    returned, valid = there_and_back(image, calibration, panorama(calibration, 0.25))
    assert valid.float().mean() > 0.9
    inner = valid[2:-2, 2:-2]  # the image's outer half pixel has no neighbour to mix with
    assert (returned - image)[:, 2:-2, 2:-2].abs()[:, inner].max() < 0.005


def test_a_real_image_survives_the_way_to_the_panorama_and_back(kitti_mini: Path):
    with Image.open(kitti_mini / "sequences" / "00" / "image_2" / "000000.png") as image:
        colours = torch.from_numpy(np.array(image.convert("RGB"))).movedim(2, 0).float()
    calibration = read_calib(kitti_mini / "sequences" / "00" / "calib.txt", (colours.shape[2], colours.shape[1]))
    returned, valid = there_and_back(colours, calibration, panorama(calibration, 1.0))
    assert valid.float().mean() > 0.85
    assert (returned - colours).abs()[:, valid].mean() < 8, "levels out of 255: two interpolations blur"
    shifted = (returned[..., 1:] - colours[..., :-1]).abs()[:, valid[:, 1:]].mean()
    assert shifted > 1.3 * (returned - colours).abs()[:, valid].mean(), "half a pixel of offset would not be better"


@pytest.mark.parametrize("turn", [0.0, 1.0, np.pi, 4.0])
def test_a_point_falls_into_the_same_place_both_ways(turn):
    calibration = camera(turn=turn)
    view = panorama(calibration, 0.5)
    generator = np.random.default_rng(0)
    u, v, depth = generator.uniform([[2], [2], [1]], [[307], [91], [50]], (3, 400))
    rays = np.linalg.inv(calibration.K) @ np.stack([u, v, np.ones(400)]) * depth
    xyz = torch.from_numpy(np.linalg.inv(calibration.T_camera_lidar)[:3] @ np.vstack([rays, np.ones(400)])).T
    found = points_in_camera(xyz, calibration)
    for ours, wanted in zip(found, (u, v, depth), strict=True):
        np.testing.assert_allclose(ours.numpy(), wanted, atol=1e-9)
    row, column = pixels(*(xyz - torch.tensor(view.origin, dtype=torch.float64)).unbind(1), view)
    inside = (row >= 0) & (row < view.rows)
    assert inside.sum() > 200
    lookup = camera_in_panorama(view, calibration)  # panorama pixel -> image position
    pixel = row[inside].long(), column[inside].long()
    assert lookup.valid[pixel].all()
    step = calibration.K[0, 0] / view.focal_px * 1.6  # a panorama pixel in image pixels, towards the image's corners
    np.testing.assert_allclose(lookup.column[pixel] - 0.5, u[inside], atol=step)
    np.testing.assert_allclose(lookup.row[pixel] - 0.5, v[inside], atol=step)
    lookup = panorama_in_camera(view, calibration)  # image pixel -> panorama position
    near = torch.from_numpy(v[inside]).round().long(), torch.from_numpy(u[inside]).round().long()
    reached = lookup.valid[near]
    assert reached.float().mean() > 0.95
    step = view.focal_px / calibration.K[0, 0]  # half an image pixel in panorama pixels is at most this
    np.testing.assert_allclose(lookup.row[near][reached], row[inside][reached], atol=step)
    np.testing.assert_allclose(lookup.column[near][reached], column[inside][reached], atol=step)


def test_real_points_land_on_the_labels_that_the_camera_sees(kitti_mini: Path):
    """The scan on the panorama and the camera's picture on the panorama agree with the scan on the image itself."""
    calibration = kitti(kitti_mini)
    view = panorama(calibration, 1.0)
    scan = read(kitti_mini / "sequences" / "drive" / "velodyne" / "000000.bin")
    image = project(scan, view)
    v, u = torch.meshgrid(torch.arange(375.0), torch.arange(1242.0), indexing="ij")
    resampled = camera_in_panorama(view, calibration).linear(torch.stack([u, v]))
    owner = image.index[image.valid]
    x, y, depth = points_in_camera(torch.from_numpy(scan.xyz)[owner], calibration)
    inside = (depth > 0) & (x > 1) & (x < 1240) & (y > 1) & (y < 373)
    assert inside.sum() > 10_000
    away = torch.hypot(resampled[0][image.valid][inside] - x[inside], resampled[1][image.valid][inside] - y[inside])
    assert away.max() < 1.1 and away.mean() < 0.5, "image pixels: the point is anywhere in its panorama pixel"


def test_ids_are_resampled_by_the_nearest_pixel():
    calibration = camera()
    ids = torch.arange(94 * 310).view(94, 310)
    lookup = camera_in_panorama(panorama(calibration, 0.25), calibration)
    resampled = lookup.nearest(ids, empty=-1)
    assert resampled.dtype == torch.int64 and torch.equal(resampled >= 0, lookup.valid)
    found = resampled[lookup.valid]
    row, column = found // 310, found % 310
    assert ((lookup.row[lookup.valid] - 0.5 - row).abs() <= 0.5001).all()
    assert ((lookup.column[lookup.valid] - 0.5 - column).abs() <= 0.5001).all()
    assert lookup.nearest(torch.full((94, 310), 3, dtype=torch.uint8), empty=255).unique().tolist() == [3, 255]


def test_linear_mixes_by_distance():
    image = torch.tensor([[[0.0, 4.0], [8.0, 12.0]]])
    row, column = torch.tensor([[1.0, 0.5, 1.5, 0.0]]), torch.tensor([[1.0, 0.75, 1.5, 0.2]])
    lookup = Lookup(row=row, column=column, valid=torch.tensor([[True, True, False, True]]), circular=False)
    assert lookup.linear(image).flatten().tolist() == [6, 1, 0, 0]
    assert lookup.nearest(image).flatten().tolist() == [12, 0, 0, 0]


def test_a_circular_image_is_mixed_across_its_seam():
    image = torch.tensor([[[0.0, 1.0, 2.0, 10.0]]])
    column = torch.tensor([[0.0, 3.75, 4.0]])
    around, flat = (
        Lookup(row=torch.full((1, 3), 0.5), column=column, valid=torch.ones(1, 3, dtype=torch.bool), circular=circular)
        for circular in (True, False)
    )
    assert around.linear(image).flatten().tolist() == [5, 7.5, 5]
    assert flat.linear(image).flatten().tolist() == [0, 10, 10]
    assert around.nearest(image).flatten().tolist() == [0, 10, 0]


def test_nothing_from_outside_leaks_in():
    calibration = camera()
    lookup = camera_in_panorama(panorama(calibration, 0.25), calibration)
    image = torch.full((1, 94, 310), torch.nan)
    assert not lookup.valid.all() and not lookup.linear(image)[:, ~lookup.valid].any()


def test_the_camera_sees_its_own_sector_only():
    calibration = camera()
    view = panorama(calibration, 0.5)
    valid = camera_in_panorama(view, calibration).valid
    columns = valid.any(0).nonzero()[:, 0]
    reach = 2 * np.degrees(np.arctan(155 / 180))  # the image's edges, half a pixel outside of the outer centres
    assert abs(len(columns) * 360 / view.columns - reach) < 2 * 360 / view.columns
    assert columns.double().mean() == pytest.approx((view.columns - 1) / 2, abs=0.5)


def test_the_mask_is_exact_at_the_images_border():
    """Panorama pixels are valid exactly where points in their direction fall into the image."""
    calibration = camera(turn=0.3)
    view = panorama(calibration, 0.25)
    column, row = np.arange(view.columns) + 0.5, np.arange(view.rows) + 0.5
    azimuth = np.pi - column / view.columns * 2 * np.pi
    slope = view.up - row / view.rows * (view.up - view.down)
    ray = np.stack(np.broadcast_arrays(np.cos(azimuth), np.sin(azimuth), slope[:, None]), axis=-1)
    x, y, depth = points_in_camera(torch.from_numpy(20 * ray + np.array(view.origin)).view(-1, 3), calibration)
    wanted = (depth > 0) & (x >= -0.5) & (x < 309.5) & (y >= -0.5) & (y < 93.5)
    assert 0 < wanted.sum() < wanted.numel()
    assert torch.equal(camera_in_panorama(view, calibration).valid.flatten(), wanted)


def test_the_image_is_valid_where_the_panorama_reaches():
    calibration = camera(focal=100.0)  # tangents up to 0.465: beyond the panorama's 0.24 and -0.2836
    view = panorama(calibration, 0.25)
    valid = panorama_in_camera(view, calibration).valid
    v, u = np.mgrid[0:94, 0:310]
    slope = -(v - 46.5) / np.hypot(u - 154.5, 100.0)
    np.testing.assert_array_equal(valid.numpy(), (slope <= 0.24) & (slope > -0.2836))


def test_an_image_straight_behind_is_whole():
    calibration = camera(width=311, focal=220.0, turn=np.pi)  # its middle column looks exactly straight behind
    lookup = panorama_in_camera(panorama(calibration, 0.5), calibration)
    assert lookup.valid.all()
    columns = lookup.nearest(torch.arange(2304).expand(192, -1))[47]
    assert (columns[:155] > 2000).all() and (columns[156:] < 300).all() and int(columns[155]) in {0, 2303}


def test_a_scaled_calibration_sees_the_same():
    calibration = camera()
    for factor in (0.5, 2.0):
        scaled = calibration.scaled(factor)
        assert scaled.size == (310 * factor, 94 * factor)
        xyz = torch.tensor([[10.0, 2.0, -1.0], [20.0, -5.0, 0.5]])
        (u, v, depth), (u2, v2, depth2) = (points_in_camera(xyz, c) for c in (calibration, scaled))
        torch.testing.assert_close((u + 0.5) * factor - 0.5, u2)
        torch.testing.assert_close((v + 0.5) * factor - 0.5, v2)
        torch.testing.assert_close(depth, depth2)
    assert calibration.K[0, 2] == 154.5, "the calibration itself stays"


def test_points_behind_the_camera_have_no_pixel():
    u, v, depth = points_in_camera(torch.tensor([[-5.0, 0, 0], [5.0, 0.1, -0.2]]), camera())
    assert u.isnan().tolist() == v.isnan().tolist() == [True, False]
    np.testing.assert_allclose([*depth, u[1], v[1]], [-4.7, 5.3, 154.5, 46.5], rtol=1e-6)


def test_at_camera_puts_the_origin_into_the_optical_centre(kitti_mini: Path):
    calibration = kitti(kitti_mini)
    origin = at_camera(VIEWS["panorama"], calibration).origin
    inside = calibration.T_camera_lidar @ np.array([*origin, 1.0])
    np.testing.assert_allclose(inside, [0, 0, 0, 1], atol=1e-12)


def test_a_lookup_moves_to_another_device():
    calibration = camera()
    moved = panorama_in_camera(panorama(calibration, 0.25), calibration).to("meta")
    assert {moved.row.device.type, moved.column.device.type, moved.valid.device.type} == {"meta"}
    assert moved.circular
    assert moved.linear(torch.zeros(3, 96, 1152, device="meta")).shape == (3, 94, 310)
    assert moved.nearest(torch.zeros(96, 1152, device="meta")).shape == (94, 310)


def linear_slowly(image: Tensor, row: float, column: float, *, circular: bool) -> float:
    """One bilinear sample of (H, W) at raster coordinates."""
    rows, columns = image.shape
    row, column = row - 0.5, column - 0.5
    top, left = math.floor(row), math.floor(column)
    value = 0.0
    for i, down in ((top, 1 - (row - top)), (top + 1, row - top)):
        for j, across in ((left, 1 - (column - left)), (left + 1, column - left)):
            at = j % columns if circular else min(max(j, 0), columns - 1)
            value += float(image[min(max(i, 0), rows - 1), at]) * down * across
    return value


@pytest.mark.parametrize("circular", [True, False])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_linear_agrees_with_its_slow_definition(circular, dtype):
    generator = np.random.default_rng(5)
    image = torch.from_numpy(generator.uniform(0, 255, (7, 4608))).to(dtype)
    row = torch.from_numpy(generator.uniform(0, 7, (3, 90))).float()
    column = torch.from_numpy(generator.uniform(0, 4608, (3, 90))).float()
    column[0, :3] = torch.tensor([0.0, 0.2, 4607.9])
    lookup = Lookup(row=row, column=column, valid=torch.ones(3, 90, dtype=torch.bool), circular=circular)
    expected = [
        linear_slowly(image, r, c, circular=circular) for r, c in zip(row.flatten(), column.flatten(), strict=True)
    ]
    found = lookup.linear(image[None])
    assert found.dtype == dtype and (found.flatten() - torch.tensor(expected)).abs().max() < 0.2, "steps of 255"
    assert not lookup.linear(image[None, :, :0].new_zeros(1, 7, 8)).any()
