"""Cameras all around: their readers, the panorama composed of them, and the depths that this takes."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lidar2pano.data.layouts import frames
from lidar2pano.data.pandaset import CLASSES, class_table
from lidar2pano.data.surround import SurroundFrame
from lidar2pano.errors import InputError
from lidar2pano.geometry.camera import at_camera, points_in_camera
from lidar2pano.geometry.projection import directions
from lidar2pano.geometry.stitching import BLEND, Camera, stitch
from lidar2pano.labels import SEMANTIC_KITTI
from lidar2pano.scene.depth import complete_depth
from lidar2pano.scene.surfaces import ground_plane
from lidar2pano.views import VIEWS, View
from miniature_layouts import CIRCLE_DEG, fisheye_view, kitti360_fisheyes
from miniature_surround import (
    HEIGHT,
    SIZE,
    camera,
    camera_view,
    distances,
    painting,
    six,
    sweep,
    write_nuscenes,
    write_pandaset,
)
from slow_definitions import project_slowly

# Of `complete_depth`: half a ring's gap, radians; ratio of distances on one surface; tangents of open sky and of a rim.
RING_GAP_RAD, ONE_SURFACE, OPEN_SKY, RIM = 1 / 183, 1.25, 0.08, 0.012

QUARTER = replace(VIEWS["panorama"].scaled(0.25), origin=(0.2, -0.1, 0.05))


@pytest.fixture(scope="module")
def photos() -> dict[str, Camera]:
    return {name: Camera(image=camera_view(one), calibration=one) for name, one in six().items()}


def ground_truth(view: View) -> tuple[np.ndarray, torch.Tensor]:
    """The painted place on a view: colours (H, W, 3) float, depths (H, W) float32."""
    rays, origin = directions(view).double().numpy(), np.array(view.origin)
    depth = distances(origin, rays)
    return painting(origin + depth[..., None] * rays), torch.from_numpy(depth).float()


def flat(calibration, colour: tuple[int, int, int]) -> Camera:
    """A camera that sees one colour."""
    return Camera(image=np.full((SIZE[1], SIZE[0], 3), colour, dtype=np.uint8), calibration=calibration)


# --- composing ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("origin", [QUARTER.origin, (0.0, 0.0, 0.0), (-0.8, 0.3, 0.2)])
def test_a_painted_place_is_composed_again_from_six_images_of_it(photos, origin):
    view = replace(QUARTER, origin=origin)
    expected, depth = ground_truth(view)
    colour, valid = stitch(list(photos.values()), view, depth)
    assert colour.dtype == np.uint8 and valid.dtype == bool and colour.shape == (*valid.shape, 3)
    assert valid.mean() > 0.97
    places = np.array(origin) + depth.numpy()[..., None] * directions(view).numpy()
    crease = (np.abs(places[..., 2] + HEIGHT) < 0.2) & (np.hypot(places[..., 0], places[..., 1]) > 17)
    off = np.abs(colour - expected)[valid & ~crease]
    assert off.max() < 1.2, "half a step for each of two roundings, and what lies between pixels"
    assert off.mean() < 0.4 and crease.mean() < 0.06
    assert (colour[~valid] == 0).all()
    wrong, covered = stitch(list(photos.values()), view, torch.full_like(depth, torch.inf))
    assert np.abs(wrong - expected)[covered].mean() > 5 * off.mean(), "without depths the cameras' places matter"


def test_a_place_falls_where_it_is_put_by_hand():
    left = camera(90.0, (0.0, 0.0, 0.0))  # looks to the left: ahead lies to its right
    painted = np.zeros((SIZE[1], SIZE[0], 3), dtype=np.uint8)
    u, v = round(240 + 300 * 1 / 5), round(144 - 300 * 0.5 / 5)
    painted[v - 2 : v + 3, u - 2 : u + 3] = (255, 9, 7)
    view = replace(QUARTER, origin=(0.0, 0.0, 0.0))
    colour, valid = stitch([Camera(image=painted, calibration=left)], view, torch.full((96, 1152), 30.0))
    bright = np.argwhere(colour[..., 0] > 200).mean(0) + 0.5
    column = (180 - math.degrees(math.atan2(5, 1))) / 360 * 1152
    row = (0.24 - 0.5 / math.hypot(1, 5)) / (0.24 + 0.2836) * 96
    assert bright == pytest.approx([row, column], abs=0.6)
    assert colour[bright.astype(int)[0], bright.astype(int)[1]].tolist() == [255, 9, 7]
    assert not valid[:, 600:].any(), "no camera looks to the right"


def test_the_camera_with_the_nearer_axis_is_taken_and_few_columns_are_mixed():
    turned = [flat(camera(left, (0.0, 0.0, 0.0)), colour) for left, colour in ((0, (200, 0, 0)), (60, (0, 0, 100)))]
    view = replace(QUARTER, origin=(0.0, 0.0, 0.0))
    for pair in (turned, turned[::-1]):
        colour, _ = stitch(pair, view, torch.full((96, 1152), torch.inf))
        row = colour[44].astype(int)
        border = round((180 - 30) / 360 * 1152)
        assert (row[border + BLEND : 576] == (200, 0, 0)).all() and (row[400 : border - BLEND] == (0, 0, 100)).all()
        mixed = (row[:, 0] > 0) & (row[:, 2] > 0)
        assert 2 <= mixed.sum() <= BLEND and abs(np.flatnonzero(mixed).mean() + 0.5 - border) < 1
        assert (np.diff(row[border - BLEND : border + BLEND, 0]) >= 0).all()


def test_pixels_that_no_camera_sees_are_not_valid():
    ahead = flat(camera(0.0, (0.0, 0.0, 0.0)), (1, 2, 3))
    view = replace(QUARTER, origin=(0.0, 0.0, 0.0))
    depth = torch.full((96, 1152), 10.0)
    depth[:, 570:580] = torch.tensor([0.0, torch.nan]).repeat(5)
    colour, valid = stitch([ahead], view, depth)
    half = math.degrees(math.atan(240 / 300))
    column = (180 - np.degrees(np.arange(-math.pi, math.pi, math.tau / 1152))) % 360 - 180
    inside = np.abs(180 - (np.arange(1152) + 0.5) / 1152 * 360) < half - 0.5
    inside[570:580] = False
    assert (valid[44] == inside)[np.abs(np.abs(column) - half) > 1].all()
    assert (colour[valid] == (1, 2, 3)).all() and not colour[~valid].any()
    unknown = stitch([], view, depth)
    assert not unknown[1].any() and not unknown[0].any()
    with pytest.raises(ValueError, match="depths must be"):
        stitch([ahead], view, depth[1:])


def test_a_cameras_own_car_is_not_in_the_panorama():
    ahead = flat(camera(0.0, (0.0, 0.0, 0.0)), (50, 60, 70))
    ego_mask = np.zeros((SIZE[1], SIZE[0]), dtype=bool)
    ego_mask[200:] = True  # 56 rows below the horizon
    view = replace(QUARTER, origin=(0.0, 0.0, 0.0))
    _, valid = stitch([replace(ahead, ego_mask=ego_mask)], view, torch.full((96, 1152), torch.inf))
    lowest = np.flatnonzero(valid[:, 576]).max() + 0.5
    assert 0.24 - lowest / 96 * 0.5236 == pytest.approx(-(200 - 144 - 0.5) / 300, abs=0.006)
    with pytest.raises(ValueError, match="must be"):
        Camera(image=ahead.image, calibration=ahead.calibration, ego_mask=ego_mask[1:])


def test_what_stands_before_a_place_hides_it_from_a_camera_beside():
    """A post 2 m ahead, a wall at 10 m: from 1 m to the right the post covers another part of the wall."""
    view = replace(QUARTER, origin=(0.0, 0.0, 0.0))
    azimuth = np.radians(180 - (np.arange(1152) + 0.5) / 1152 * 360)
    post = np.abs(azimuth) < 0.1
    depth = torch.from_numpy(np.where(post, 2.0, 10.0)).float().expand(96, 1152).contiguous()
    beside = flat(camera(0.0, (0.0, -1.0, 0.0)), (255, 0, 0))
    _, valid = stitch([beside], view, depth)
    # the camera's line past the post's left edge (1.99, 0.2) meets the circle of 10 m at about y = 4.6
    edges = [1.99, 0.2], [1.99, -0.2]
    hidden = []
    for x, y in edges:
        way = np.array([x, y + 1]) / math.hypot(x, y + 1)
        along = way[1] + math.sqrt(way[1] ** 2 - 1 + 100)
        hidden.append(math.atan2(along * way[1] - 1, along * way[0]))
    behind = (azimuth < hidden[0] - 0.03) & (azimuth > hidden[1] + 0.03) & ~post
    assert behind.sum() > 15 and not valid[44, behind].any()
    free = ((azimuth > hidden[0] + 0.05) | ((azimuth < hidden[1] - 0.05) & ~post)) & (np.abs(azimuth) < 0.55)
    assert free.sum() > 100 and valid[44, free].all() and valid[44, post].all()
    _, unhidden = stitch([beside], view, depth.where(~torch.from_numpy(post), torch.inf))
    assert unhidden[44, (np.abs(azimuth) < 0.5) & ~post].all(), "the sky hides nothing"
    here = flat(camera(0.0, (0.0, 0.0, 0.0)), (0, 255, 0))
    colour, both = stitch([beside, here], view, depth)
    assert both[44, behind].all() and (colour[44, behind] == (0, 255, 0)).all(), "the other camera sees it"


def test_from_the_cameras_own_place_nothing_is_hidden():
    generator = np.random.default_rng(0)
    rough = np.kron(generator.choice([3.0, 12.0, np.inf], (12, 96)), np.ones((8, 12)))
    here = flat(camera(0.0, (0.2, -0.1, 0.05)), (1, 1, 1))
    valid = [
        stitch([here], QUARTER, depth)[1] for depth in (torch.from_numpy(rough).float(), torch.full((96, 1152), 9.0))
    ]
    assert np.array_equal(*valid) and valid[0].mean() > 0.15


def test_a_fisheye_is_composed_up_to_its_image_circle(photos):
    """Beyond the circle the image is of another colour, which must not come into the panorama."""
    lens = replace(kitti360_fisheyes()["image_02"], reach_deg=CIRCLE_DEG)
    view = replace(QUARTER, origin=lens.centre)
    expected, depth = ground_truth(view)
    colour, valid = stitch([Camera(image=fisheye_view(lens), calibration=lens)], view, depth)
    axis = lens.T_camera_lidar[2, :3]
    angle = np.degrees(np.arccos(directions(view).double().numpy() @ axis))
    assert (valid == (angle <= CIRCLE_DEG))[np.abs(angle - CIRCLE_DEG) > 0.01].all() and 0.4 < valid.mean() < 0.6
    off = np.abs(colour - expected)[angle < CIRCLE_DEG - 1]
    assert off.mean() < 0.6 and off.max() < 6, "at the crease between ground and wall; beyond the circle it is 100"
    whole = replace(lens, reach_deg=180.0)
    _, farther = stitch([Camera(image=fisheye_view(lens), calibration=whole)], view, depth)
    assert (valid <= farther).all() and farther.sum() > valid.sum() + 1000
    beside, _ = stitch(
        [*photos.values(), Camera(image=fisheye_view(lens), calibration=lens)], QUARTER, ground_truth(QUARTER)[1]
    )
    assert np.abs(beside - ground_truth(QUARTER)[0]).mean() < 1


# --- depths ---------------------------------------------------------------------------------------------------------


def test_depths_of_the_painted_place_come_from_its_scan():
    _, expected = ground_truth(QUARTER)
    points = torch.from_numpy(sweep()[0])
    depth = complete_depth(points, QUARTER)
    assert depth.dtype == torch.float32 and (depth > 0).all()
    off = (depth / expected - 1).abs()
    assert off.isfinite().all(), "the sphere is seen up to the top"
    assert off.median() < 0.002 and (off > 0.05).float().mean() < 0.02
    assert off[66:].max() < 0.03, "ground: a point may lie half a pixel off its pixel's middle"


def test_few_rings_are_enough_for_a_place_of_ground_and_walls():
    _, expected = ground_truth(QUARTER)
    off = (complete_depth(torch.from_numpy(sweep(rings=16)[0]), QUARTER) / expected - 1).abs()
    assert off.max() < 0.07 and off.mean() < 0.01, "also between the last ring on the ground and the first on the wall"


def test_what_was_measured_stays_and_the_own_car_is_left_out():
    others = np.array([[7.0, 1.5, 0.3], [0.5, 3.0, -0.4]], dtype=np.float32)
    points = np.concatenate([sweep()[0][::37], others])
    car = torch.tensor([[1.5, 0.4, -0.2], [-1.0, 0.0, -0.2]])
    depth = complete_depth(torch.from_numpy(points), QUARTER)
    assert torch.equal(complete_depth(torch.cat([torch.from_numpy(points), car]), QUARTER), depth)
    owners = project_slowly(points, QUARTER)
    rows, columns = np.array(list(owners)).T
    away = np.linalg.norm(points[list(owners.values())] - np.float32(QUARTER.origin), axis=1)
    assert {len(points) - 1, len(points) - 2} <= set(owners.values())
    assert depth.numpy()[rows, columns] == pytest.approx(away, rel=1e-5)


def test_above_the_topmost_point_is_sky_unless_the_sensor_looks_no_higher():
    points, ground = (torch.from_numpy(part) for part in sweep())
    slope = points[:, 2] / torch.hypot(points[:, 0], points[:, 1])
    view = replace(QUARTER, origin=(0.0, 0.0, 0.0))
    ahead = points[:, 1].abs() < points[:, 0]
    low = points[ground | (slope < 0.05) | ~ahead]  # a low wall ahead, the high one elsewhere
    depth = complete_depth(low, view)
    height = view.up - (torch.arange(96) + 0.5) / 96 * (view.up - view.down)
    assert depth[height > 0.08, 576].isinf().all() and depth[height < 0.04, 576].isfinite().all()
    assert depth[:, 10].isfinite().all()
    short = points[slope < 0.05]  # a sensor that ends there
    assert complete_depth(short, view).isfinite().all()


def test_columns_without_points_are_ground_and_sky():
    points = torch.from_numpy(sweep()[0])
    open_side = points[points[:, 1] < 6.0]
    view = replace(QUARTER, origin=(0.0, 0.0, 0.0))
    depth = complete_depth(open_side, view)[:, 288]  # to the left
    slope = view.up - (torch.arange(96) + 0.5) / 96 * (view.up - view.down)
    reach = HEIGHT / -slope
    ground = (slope < 0) & (reach < 60)
    assert depth[ground] == pytest.approx((reach * torch.sqrt(1 + slope**2))[ground], rel=0.01)
    assert depth[(slope > 0.02)].isinf().all()
    assert complete_depth(torch.zeros(0, 3), view).isinf().all()
    with pytest.raises(ValueError, match="cylinder"):
        complete_depth(points, VIEWS["hdl64e"])


def test_the_grounds_plane_is_found_under_cars_and_houses():
    generator = np.random.default_rng(1)
    xy = generator.uniform(-24, 24, (6000, 2))
    z = 0.03 * xy[:, 0] - 0.02 * xy[:, 1] - 1.9 + generator.normal(0, 0.01, 6000)
    square = np.floor(xy / 4).astype(int)
    roof = (square[:, 0] + 2 * square[:, 1]) % 4 == 0  # a quarter of all squares of 4 m
    z[roof] += generator.uniform(1.0, 4.0, roof.sum())
    points = torch.from_numpy(np.column_stack([xy, z])).float()
    assert ground_plane(points) == pytest.approx((0.03, -0.02, -1.9), abs=0.03)
    steep = points * torch.tensor([1.0, 1.0, 0.0]) + torch.tensor([0.0, 0.0, 1.0]) * (0.1 * points[:, :1] - 2)
    assert ground_plane(steep) == pytest.approx((0.1, 0.0, -2.0), abs=1e-4)
    assert ground_plane(points[:4]) is None


def depth_completed_slowly(xyz: np.ndarray, view: View) -> np.ndarray:
    """`complete_depth` pixel by pixel, for a scan whose ground is not known."""
    measured = np.zeros((view.rows, view.columns))
    flat_m = np.zeros_like(measured)
    for (row, column), owner in project_slowly(xyz, view).items():
        away = xyz[owner] - np.float32(view.origin)
        measured[row, column], flat_m[row, column] = np.linalg.norm(away), np.hypot(away[0], away[1])
    closed = flat_m.copy()
    for row, column in np.argwhere(flat_m == 0):
        for away in range(1, max(1, round(RING_GAP_RAD * view.focal_px)) + 1):
            near = [flat_m[row, (column + step) % view.columns] for step in (-away, away)]
            if any(near):
                closed[row, column] = min(one for one in near if one)
                break
    depth = measured.copy()
    top = max(z / math.hypot(x, y) for x, y, z in xyz)
    for row, column in np.argwhere(measured == 0):
        slope = view.up - (row + 0.5) / view.rows * (view.up - view.down)
        depth[row, column] = _flat_slowly(int(row), int(column), closed, top, view) * math.hypot(1, slope)
    return depth


def _flat_slowly(row: int, column: int, flat_m: np.ndarray, top: float, view: View) -> float:
    """Horizontal distance of one pixel, given those (H, W) of the rings and the highest slope that the sensor saw."""
    known = np.flatnonzero(flat_m[:, column])
    above, below = known[known <= row], known[known >= row]
    if len(above) and len(below):
        a, b = above[-1], below[0]
        far = flat_m[[a, b], column]
        share = (row - a) / (b - a) if b > a else 0.0
        if max(far) < ONE_SURFACE * min(far):
            return 1 / (1 / far[0] + (1 / far[1] - 1 / far[0]) * share)
        step = (view.up - view.down) / view.rows
        if (b - a) * step > OPEN_SKY and min(row - a, b - row) * step > RIM:
            return math.inf
        return far[0] if share <= 0.5 else far[1]
    if len(above):
        return flat_m[above[-1], column]
    if len(below):
        close = below[0] - row <= RIM * view.rows / (view.up - view.down)
        if close or _slope_from_sensor(below[0], column, flat_m, view) > top - RIM:
            return flat_m[below[0], column]
    return math.inf


def _slope_from_sensor(row: int, column: int, flat_m: np.ndarray, view: View) -> float:
    azimuth = math.radians(view.left - (column + 0.5) / view.columns * 360)
    r, slope = flat_m[row, column], view.up - (row + 0.5) / view.rows * (view.up - view.down)
    x, y, z = (o + w * r for o, w in zip(view.origin, (math.cos(azimuth), math.sin(azimuth), slope), strict=True))
    return z / math.hypot(x, y)


def test_filling_agrees_with_its_slow_definition():
    view = View(rows=30, columns=366, up=0.3, down=-0.3, kind="cylinder", origin=(0.3, 0.1, 0.2))
    generator = np.random.default_rng(3)
    azimuth, slope = generator.uniform(-math.pi, math.pi, 900), generator.uniform(-0.36, 0.2, 900)
    distance = generator.choice([26.0, 29.0, 45.0, 47.0], 900)  # too far for a ground
    xyz = np.column_stack([distance * np.cos(azimuth), distance * np.sin(azimuth), distance * slope]).astype(np.float32)
    tall = replace(view, rows=42, up=0.42, down=-0.42)  # BEYOND is 6 rows of 0.02
    fast, slow = complete_depth(torch.from_numpy(xyz), view).numpy(), depth_completed_slowly(xyz, tall)[6:-6]
    assert np.isinf(slow).mean() > 0.05
    assert np.array_equal(np.isinf(fast), np.isinf(slow))
    assert np.allclose(fast, slow, rtol=1e-4)


# --- readers --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def painted(tmp_path_factory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("painted")
    return {"pandaset": write_pandaset(root / "pandaset", 2), "nuscenes": write_nuscenes(root / "nuscenes")}


def first(layout: str, root: Path) -> SurroundFrame:
    return surround(root)[0]


def surround(root: Path, split: str = "all") -> list[SurroundFrame]:
    found = list(frames(root, split, QUARTER))
    assert all(isinstance(frame, SurroundFrame) for frame in found)
    return found


def read(frame: SurroundFrame) -> None:
    """Read all parts but the panorama."""
    for part in ("cameras", "scan", "point_labels", "pose"):
        getattr(frame, part)


@pytest.mark.parametrize("layout", ["pandaset", "nuscenes"])
def test_a_painted_place_is_read_in_our_frame(painted, layout):
    frame = first(layout, painted[layout])
    points, _ = sweep() if layout == "pandaset" else sweep(32, 1000)
    assert np.abs(frame.whole_scan.xyz - points).max() < 1e-4
    assert frame.whole_scan.remission == pytest.approx(0.5 if layout == "pandaset" else 0.2)
    assert len(frame.cameras) == 6 and frame.front == list(frame.cameras)[0]
    for photo, mount in zip(frame.cameras.values(), six().values(), strict=True):
        assert photo.calibration.T_camera_lidar == pytest.approx(mount.T_camera_lidar, abs=1e-6)
        assert pytest.approx(mount.K) == photo.calibration.K and photo.calibration.size == SIZE
    view = at_camera(QUARTER, frame.cameras[frame.front].calibration)
    expected, _ = ground_truth(view)
    depth = complete_depth(torch.from_numpy(frame.whole_scan.xyz), view)
    colour, valid = stitch(list(frame.cameras.values()), view, depth)
    off = np.abs(colour - expected)[valid]
    assert valid.mean() > 0.9 and off.mean() < 1.5, "JPEG's loss and what lies between the rings"


def test_pandaset_frames_have_names_labels_and_poses(painted):
    found = surround(painted["pandaset"], "002")
    assert [frame.name for frame in found] == ["002/000000", "002/000001"]
    one, other = found
    points, ground = sweep()
    assert one.point_labels is not None and one.whole_scan.name == one.name == "002/000000"
    named = np.array(SEMANTIC_KITTI.classes)[one.point_labels]
    assert (named[ground] == "road").all() and (named[~ground] == "building").all()
    moved = np.linalg.inv(one.pose) @ other.pose
    expected = np.eye(4)
    expected[0, 3] = 3.0  # their y is ahead
    assert moved == pytest.approx(expected, abs=1e-6)
    # the pose leads to their world: the sensor stands where it was put, our x is their y
    assert one.pose[:3, 3] == pytest.approx([0.3, 0.8, 1.8], abs=1e-6)
    assert one.pose[:3, 0] == pytest.approx([0, 1, 0], abs=1e-6)


def test_nuscenes_frames_have_names_and_poses(painted):
    (frame,) = surround(painted["nuscenes"])
    assert frame.name == frame.whole_scan.name == "nuscenes/000007" and frame.point_labels is None
    assert frame.pose[:3, 3] == pytest.approx([100, 200, 0.5]) and frame.pose[:3, 0] == pytest.approx([0, 1, 0])


def test_the_own_car_is_masked_in_the_cameras_that_see_it(pandaset_mini, nuscenes):
    for frame, seeing, share in (
        (surround(pandaset_mini)[0], "back_camera", 0.23),
        (surround(nuscenes)[0], "CAM_BACK", 0.03),
    ):
        for name, photo in frame.cameras.items():
            if name != seeing:
                assert photo.ego_mask is None
                continue
            assert photo.ego_mask is not None
            assert photo.ego_mask.mean() == pytest.approx(share, abs=0.02)
            assert not photo.ego_mask[: photo.ego_mask.shape[0] * 3 // 4].any() and photo.ego_mask[-1, 200:-200].all()


def test_every_class_of_pandaset_has_a_name_here(pandaset_mini):
    names = json.loads((pandaset_mini / "classes.json").read_text())
    assert set(names.values()) == set(CLASSES)
    table = class_table(pandaset_mini / "classes.json")
    by_name = {name: SEMANTIC_KITTI.classes[table[int(index)]] for index, name in names.items()}
    assert (
        by_name["Lane Line Marking"] == "road"
        and by_name["Pickup Truck"] == "truck"
        and by_name["Cones"] == "unlabeled"
    )
    assert table[0] == 0


# where the axes of the real cameras point, degrees to the left of ahead
REAL = {
    "front_camera": 0, "front_left_camera": 58, "left_camera": 91, "back_camera": 182, "right_camera": -91,
    "front_right_camera": -58, "CAM_FRONT": 0, "CAM_FRONT_LEFT": 56, "CAM_BACK_LEFT": 109, "CAM_BACK": 180,
    "CAM_BACK_RIGHT": -109, "CAM_FRONT_RIGHT": -56,
}  # fmt: skip


@pytest.mark.parametrize("layout", ["pandaset", "nuscenes"])
def test_in_every_real_camera_left_is_left_and_up_is_up(pandaset_mini, nuscenes, layout):
    frame = first(layout, pandaset_mini if layout == "pandaset" else nuscenes)
    for name, photo in frame.cameras.items():
        at, high = math.radians(REAL[name]), photo.calibration.centre[2]
        places = [(at, high), (at + 0.1, high), (at, high + 1.0)]
        xyz = torch.tensor([(20 * math.cos(a), 20 * math.sin(a), z) for a, z in places])
        u, v, depth = (part.tolist() for part in points_in_camera(xyz, photo.calibration))
        width, height = photo.calibration.size
        assert min(depth) > 15 and abs(u[0] / width - 0.5) < 0.08 and abs(v[0] / height - 0.5) < 0.12, name
        assert u[1] < u[0] - 0.04 * width and v[2] < v[0] - 0.02 * height, name


def cones(xyz: np.ndarray) -> float:
    """How sharply points lie on cones about the origin: 1 where they are spread evenly over all slopes.

    The sensor's axis is the one that PandaSet's car has: it leans back by 0.9 degrees.
    """
    flat_m = np.hypot(xyz[:, 0], xyz[:, 1])
    kept = (flat_m > 4) & (flat_m < 40)
    slope = (xyz[kept, 2] - 0.0157 * xyz[kept, 0] + 0.0005 * xyz[kept, 1]) / flat_m[kept]
    share = np.histogram(slope, bins=np.arange(-0.5, 0.3, 0.0001))[0] / kept.sum()
    share = np.convolve(share, np.bartlett(11) / 5)
    return float((share**2).sum() * len(share))


@pytest.mark.parametrize("number", [0, 5])
def test_pandasets_sensor_stands_at_the_origin(pandaset_mini, number):
    xyz = surround(pandaset_mini)[number].whole_scan.xyz.astype(np.float64)
    best = cones(xyz)
    for off in ((0.1, 0, 0), (-0.1, 0, 0), (0, 0.1, 0), (0, -0.1, 0), (0, 0, 0.1), (0, 0, -0.1)):
        assert best > 1.2 * cones(xyz + np.array(off)), off


def test_pandasets_poses_put_houses_on_houses(pandaset_mini):
    found = surround(pandaset_mini)
    one, other = found[0], found[-1]
    house = SEMANTIC_KITTI.id_of("building")

    def blocks(frame: SurroundFrame, pose: np.ndarray) -> set[tuple[int, ...]]:
        xyz = frame.whole_scan.xyz[frame.point_labels == house] @ pose[:3, :3].T + pose[:3, 3]
        return set(map(tuple, np.floor(xyz / 0.5).astype(int).tolist()))

    def shared(a: set[tuple[int, ...]], b: set[tuple[int, ...]]) -> float:
        return len(a & b) / min(len(a), len(b))

    with_poses = shared(blocks(one, one.pose), blocks(other, other.pose))
    assert with_poses > 0.4 and with_poses > 2 * shared(blocks(one, one.pose), blocks(other, one.pose))


@pytest.mark.parametrize("layout", ["pandaset", "nuscenes"])
def test_neighbouring_real_cameras_agree_where_both_see(pandaset_mini, nuscenes, layout):
    """The same grey pattern in both; the scan's depth brings them together."""
    frame = first(layout, pandaset_mini if layout == "pandaset" else nuscenes)
    view = at_camera(VIEWS["panorama"].scaled(0.25), frame.cameras[frame.front].calibration)
    scan = complete_depth(torch.from_numpy(frame.whole_scan.xyz), view)
    agreement = []
    for depth in (scan, torch.full_like(scan, torch.inf)):
        stitched = [stitch([photo], view, depth) for photo in frame.cameras.values()]
        found = []
        for n, (one, here) in enumerate(stitched):
            for other, there in stitched[:n]:
                both = here & there
                if both.sum() > 1000:
                    a, b = (part[both].mean(-1) for part in (one, other))
                    found.append(np.corrcoef(a, b)[0, 1])
        assert len(found) >= 4
        agreement.append(float(np.mean(found)))
    assert agreement[0] > 0.75 and 1 - agreement[0] < 0.8 * (1 - agreement[1])


# --- what is wrong with the data ------------------------------------------------------------------------------------


def edit(path: Path, change: Callable[[dict], object]) -> None:
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))


S = "sequences/002"
PANDASET_DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no camera picture": (lambda r: (r / S / "left_camera/000000.jpg").unlink(), r"left_camera/000000.jpg: is missing"),
    "a damaged picture": (
        lambda r: (r / S / "left_camera/000000.jpg").write_bytes(b"no"),
        r"left_camera/000000.jpg: is no readable image",
    ),
    "no calibration": (lambda r: (r / S / "calib/000000.json").unlink(), r"calib/000000.json: cannot be read"),
    "calibration no JSON": (lambda r: (r / S / "calib/000000.json").write_text("{"), r"000000.json: is no JSON"),
    "calibration without cameras": (
        lambda r: (r / S / "calib/000000.json").write_text("[]"),
        r"000000.json: has no cameras",
    ),
    "a mount that is no motion": (
        lambda r: edit(
            r / S / "calib/000000.json", lambda c: c["cameras"]["back_camera"]["cam_from_lidar"][0].reverse()
        ),
        r"000000.json: cam_from_lidar: holds no rotation",
    ),
    "a mount too small": (
        lambda r: edit(r / S / "calib/000000.json", lambda c: c["cameras"]["back_camera"]["cam_from_lidar"].pop()),
        r"cam_from_lidar: must hold 16 numbers \(4x4\), it has 12",
    ),
    "no focal length": (
        lambda r: edit(r / S / "calib/000000.json", lambda c: c["cameras"]["back_camera"]["K"].pop("fx")),
        r"K: is missing, or holds no finite numbers",
    ),
    "another size": (
        lambda r: edit(r / S / "calib/000000.json", lambda c: c["cameras"]["back_camera"].update(size=[960, 540])),
        r"back_camera/000000.jpg: is not of the size",
    ),
    "no pose": (
        lambda r: edit(r / S / "calib/000000.json", lambda c: c.pop("world_from_lidar")),
        r"world_from_lidar: is missing, or holds no finite numbers",
    ),
    "no labels": (lambda r: (r / S / "labels_pandaset/000000.label").unlink(), r"000000.label: cannot be read"),
    "too few labels": (
        lambda r: (r / S / "labels_pandaset/000000.label").write_bytes(b"\0" * 8),
        r"000000.label: has 2 labels",
    ),
    "an unknown class": (
        lambda r: edit(r / "classes.json", lambda c: c.update({"5": "Treehouse"})),
        r"class 'Treehouse'",
    ),
    "a class without a name": (
        lambda r: edit(r / "classes.json", lambda c: (c.pop("41"), c.pop("13"))),
        r"holds class 41",
    ),
    "a camera of another form": (
        lambda r: edit(r / S / "calib/000000.json", lambda c: c["cameras"].update(back_camera=3)),
        r"000000.json: camera back_camera is no object",
    ),
    "no focal length that can be": (
        lambda r: edit(r / S / "calib/000000.json", lambda c: c["cameras"]["back_camera"]["K"].update(fx=-3)),
        r"K: is no camera matrix",
    ),
    "four numbers for a camera": (
        lambda r: edit(
            r / S / "calib/000000.json", lambda c: c["cameras"]["back_camera"].update(K=[100.0, 100.0, 80.0, 40.0])
        ),
        r"K: is no camera matrix",
    ),
    "a class of a strange number": (lambda r: edit(r / "classes.json", lambda c: c.update({"-5": "Car"})), r"class -5"),
    "classes no names": (lambda r: (r / "classes.json").write_text("[1]"), r"classes.json: must be an object"),
}


@pytest.mark.parametrize("damage", PANDASET_DAMAGES)
def test_what_is_wrong_with_a_pandaset_is_said_in_one_line(painted, tmp_path, damage):
    harm, message = PANDASET_DAMAGES[damage]
    root = copied(painted["pandaset"], tmp_path)
    read(surround(root)[0])
    harm(root)
    with pytest.raises(InputError, match=message) as caught:
        read(surround(root)[0])
    assert str(root) in str(caught.value) and "\n" not in str(caught.value)


def test_what_is_wrong_with_a_pandasets_folder(painted, tmp_path):
    (tmp_path / "classes.json").write_text("{}")
    with pytest.raises(InputError, match=r"has no sequences/"):
        surround(tmp_path)
    with pytest.raises(InputError, match=r"no split '003'; did you mean '002'"):
        surround(painted["pandaset"], "003")
    (tmp_path / "sequences" / "001").mkdir(parents=True)
    with pytest.raises(InputError, match=r"split 'all' has no scan"):
        surround(tmp_path)


NUSCENES_DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no list": (lambda r: (r / "info.json").write_text("[]"), r"info.json: has no list 'data_list'"),
    "no JSON": (lambda r: (r / "info.json").write_text("?"), r"info.json: is no JSON"),
    "another form": (lambda r: (r / "info.json").write_text("[" * 10**5), r"info.json: is no JSON"),
    "a sample without a number": (
        lambda r: edit(r / "info.json", lambda c: c["data_list"][0].update(sample_idx=[])),
        r"has a sample without a number 'sample_idx'",
    ),
    "cameras of another form": (
        lambda r: edit(r / "info.json", lambda c: c["data_list"][0]["images"].update(CAM_BACK=3)),
        r"has no 'img_path'",
    ),
    "a camera looking backwards": (
        lambda r: edit(
            r / "info.json", lambda c: c["data_list"][0]["images"]["CAM_BACK"]["cam2img"][0].__setitem__(0, -3)
        ),
        r"cam2img: is no camera matrix",
    ),
    "four numbers for a camera": (
        lambda r: edit(
            r / "info.json", lambda c: c["data_list"][0]["images"]["CAM_BACK"].update(cam2img=[100, 100, 80, 40])
        ),
        r"cam2img: is no camera matrix",
    ),
    "a lens's number before a camera": (
        lambda r: edit(
            r / "info.json", lambda c: c["data_list"][0]["images"]["CAM_BACK"].update(cam2img=[1, 100, 100, 80, 40])
        ),
        r"cam2img: is no camera matrix",
    ),
    "no sample": (lambda r: edit(r / "info.json", lambda c: c["data_list"].clear()), r"info.json: lists no sample"),
    "no cameras": (lambda r: edit(r / "info.json", lambda c: c["data_list"][0].pop("images")), r"has no 'images'"),
    "no front camera": (
        lambda r: edit(r / "info.json", lambda c: c["data_list"][0]["images"].pop("CAM_FRONT")),
        r"has no camera CAM_FRONT",
    ),
    "no path": (
        lambda r: edit(r / "info.json", lambda c: c["data_list"][0]["lidar_points"].pop("lidar_path")),
        r"has no 'lidar_path'",
    ),
    "no sweep": (lambda r: (r / "LIDAR_TOP.pcd.bin").unlink(), r"LIDAR_TOP.pcd.bin: cannot be read"),
    "half a sweep": (lambda r: (r / "LIDAR_TOP.pcd.bin").write_bytes(b"\0" * 30), r"30 bytes are no whole number"),
}


@pytest.mark.parametrize("damage", NUSCENES_DAMAGES)
def test_what_is_wrong_with_nuscenes_is_said_in_one_line(painted, tmp_path, damage):
    harm, message = NUSCENES_DAMAGES[damage]
    root = copied(painted["nuscenes"], tmp_path)
    harm(root)
    with pytest.raises(InputError, match=message) as caught:
        read(surround(root)[0])
    assert str(root) in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(InputError, match="no split 'val'"):
        surround(painted["nuscenes"], "val")


def copied(root: Path, to: Path) -> Path:
    """A copy whose files are links, but for those that tests write to."""
    for path in root.rglob("*"):
        there = to / path.relative_to(root)
        if path.is_dir():
            there.mkdir(parents=True, exist_ok=True)
        else:
            there.parent.mkdir(parents=True, exist_ok=True)
            there.write_bytes(path.read_bytes())
    return to
