"""Panoramas with cameras: real where one sees, invented elsewhere, and one picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from lidar2pano.geometry.projection import directions
from lidar2pano.geometry.stitching import Camera
from lidar2pano.panorama import Panorama
from lidar2pano.pipeline import composition
from lidar2pano.pipeline.composition import compose, continued, photographed
from lidar2pano.scan import Scan
from lidar2pano.views import VIEWS, View
from miniature_surround import camera, camera_view, distances, painting, six, sweep

QUARTER = replace(VIEWS["panorama"].scaled(0.25), origin=(0.2, -0.1, 0.05))
INVENTED = 90


def truth(view: View = QUARTER) -> tuple[np.ndarray, np.ndarray]:
    """The painted place on a view: colours (H, W, 3) float, depths (H, W) float32."""
    rays, origin = directions(view).double().numpy(), np.array(view.origin)
    depth_m = distances(origin, rays)
    return painting(origin + depth_m[..., None] * rays), depth_m.astype(np.float32)


def panorama(depth_m: np.ndarray, view: View = QUARTER, points: int = 0) -> Panorama:
    shape = (view.rows, view.columns)
    return Panorama(
        name="a",
        frame=0,
        view=view,
        colour=np.full((*shape, 3), INVENTED, dtype=np.uint8),
        segments=np.ones(shape, dtype=np.uint8),
        depth_m=depth_m,
        labels=np.zeros(points, dtype=np.int64),
    )


def composed(around: Panorama, cameras: list[Camera]) -> Panorama:
    return compose(around, photographed(around, cameras))


@pytest.fixture(scope="module")
def photos() -> list[Camera]:
    return [Camera(camera_view(one), one, name=name) for name, one in six().items()]


def test_the_painted_place_is_real_where_a_camera_sees(photos):
    expected, depth_m = truth()
    around = composed(panorama(depth_m), photos)
    assert around.source is not None and around.source.dtype == np.uint8
    seen = around.source > 0
    assert seen.mean() > 0.97 and set(np.unique(around.source)) >= set(range(1, 7))
    off = np.abs(around.colour - expected)[seen]
    assert np.quantile(off, 0.95) < 2 and off.mean() < 0.8
    ahead = around.source[:, QUARTER.columns // 2]
    assert set(ahead[ahead > 0]) == {1}, "the first camera looks ahead"
    assert [one.name for one in around.cameras] == [one.name for one in photos]


def test_the_hidden_camera_stays_invented_and_the_others_real(photos):
    expected, depth_m = truth()
    around = composed(panorama(depth_m), photos[1:])
    ahead = np.abs(np.arange(QUARTER.columns) - QUARTER.columns // 2) < 10
    assert (around.source[:, ahead] == 0).all()
    off = np.abs(around.colour - expected).mean(2)
    assert off[around.source > 0].mean() < 1 < off[:, ahead].mean()


def test_gains_bring_cameras_together(photos, monkeypatch):
    expected, depth_m = truth()
    gain = np.array([1.0, 0.8, 0.9])
    dimmed = replace(photos[1], image=(photos[1].image * gain).round().astype(np.uint8))
    around = composed(panorama(depth_m), [photos[0], dimmed, *photos[2:]])
    applied = np.array([one.gain for one in around.cameras])
    relative = applied[1] / applied[[0, 2]].mean(0)
    assert (np.abs(np.log(relative * gain)) <= 0.5 * np.abs(np.log(gain)) + 0.01).all(), "a prior holds back the rest"
    monkeypatch.setattr(composition, "brought_together", lambda cameras, *_: cameras)
    plain = composed(panorama(depth_m), [photos[0], dimmed, *photos[2:]])
    off = [np.abs(one.colour - expected)[plain.source == 2].mean() for one in (around, plain)]
    assert off[0] < 0.7 * off[1]
    assert composed(panorama(depth_m), photos[:1]).cameras[0].gain == (1, 1, 1)


def test_what_stands_in_front_of_a_camera_hides_what_is_behind():
    beside = camera(0.0, (0.0, 1.5, 0.0))
    view = replace(QUARTER, origin=(0.0, 0.0, 0.0))
    depth_m = np.full((view.rows, view.columns), 12.0, dtype=np.float32)
    board = np.abs(np.arange(view.columns) - view.columns // 2) < 20  # straight ahead, 3 m away
    depth_m[:, board] = 3.0
    picture = np.full((300, 480, 3), 200, dtype=np.uint8)
    source = composed(panorama(depth_m, view), [Camera(picture, beside)]).source
    assert source is not None and (source[40:60, board] == 1).mean() > 0.9
    along = np.linspace(0, 20, 2001)[:, None] * np.array([3.0, -1.5]) / np.hypot(3, 1.5)  # past the board, from above
    behind = (along + (0.0, 1.5))[np.argmin(np.abs(np.hypot(*(along + (0.0, 1.5)).T) - 12))]
    column = round((180 - np.degrees(np.arctan2(behind[1], behind[0]))) / 360 * view.columns)
    assert (source[40:60, column - 3 : column + 4] == 0).all()
    assert (source[40:60, column - 80 : column - 70] == 1).all()
    near = depth_m.copy()
    near[:, board] = 12.0 / 1.3  # the same surface
    assert (composed(panorama(near, view), [Camera(picture, beside)]).source[40:60, 560:592] == 1).all()


def test_the_sky_is_seen_in_its_direction():
    view = replace(QUARTER, origin=(0.0, 0.0, 0.0))
    aside = camera(0.0, (0.0, 1.0, 0.0))
    picture = np.zeros((300, 480, 3), dtype=np.uint8)
    picture[:, 238:243] = 255  # straight ahead
    around = composed(panorama(np.zeros((view.rows, view.columns), np.float32), view), [Camera(picture, aside)])
    bright = np.flatnonzero(around.colour[20, :, 0] * (around.source[20] > 0) > 100)
    assert abs(bright.mean() + 0.5 - view.columns / 2) < 1


def test_the_own_vehicle_is_left_out(photos):
    _, depth_m = truth()
    mask = np.zeros((300, 480), dtype=bool)
    mask[200:] = True
    whole, part = (composed(panorama(depth_m), [replace(photos[0], ego_mask=one)]).source for one in (None, mask))
    assert whole is not None and part is not None
    assert 0 < part.sum() < 0.9 * whole.sum() and not (part > whole).any()


def test_the_invention_goes_over_into_what_is_seen_and_stays_itself_far_away():
    view = replace(QUARTER, origin=(0.0, 0.0, 0.0))
    depth_m = np.full((view.rows, view.columns), 12.0, dtype=np.float32)
    picture = np.full((300, 480, 3), 150, dtype=np.uint8)
    around = composed(panorama(depth_m, view), [Camera(picture, camera(180.0, (0.0, 0.0, 0.0)))])
    assert (around.colour[around.source > 0] == 150).all()
    row, seen = around.colour[48, :, 0].astype(int), around.source[48] > 0
    assert seen[0] and seen[-1], "the camera looks across the seam"
    first = int(np.flatnonzero(~seen)[0])
    assert abs(row[first] - 150) < 8 and abs(row[view.columns // 2] - INVENTED) < 3
    assert (np.abs(np.diff(row)) < 8).all()


def test_known_differences_stay_and_others_are_filled():
    known = torch.zeros(64, 128, dtype=torch.bool)
    known[16:32, 8:40] = True
    invented = torch.zeros(3, 64, 128, dtype=torch.uint8)
    filled = continued(torch.full((3, 64, 128), 7.0), invented, known)
    assert filled.shape == (3, 64, 128)
    assert filled[:, 20:28, 16:32].allclose(torch.tensor(7.0))
    assert float(filled[0, 20, 48]) > float(filled[0, 20, 90]) >= 0
    assert continued(torch.ones(3, 64, 128), invented, torch.zeros(64, 128, dtype=torch.bool)).eq(0).all()


def test_a_turned_scan_gives_turned_colours(photos):
    _, depth_m = truth()
    columns = 288  # a quarter of a turn
    straight = composed(panorama(depth_m), photos)
    R = np.eye(4)
    R[:2, :2] = [[0, 1], [-1, 0]]  # to the right
    turned = [
        replace(one, calibration=replace(one.calibration, T_camera_lidar=one.calibration.T_camera_lidar @ R.T))
        for one in photos
    ]
    x, y, z = (R[:3, :3] @ np.array(QUARTER.origin)).tolist()
    view = replace(QUARTER, origin=(x, y, z))
    around = composed(panorama(np.roll(depth_m, columns, 1), view), turned)
    same = np.roll(straight.source, columns, 1) == around.source
    assert same.mean() > 0.999
    off = np.abs(np.roll(straight.colour, columns, 1).astype(int) - around.colour)[same]
    assert np.quantile(off, 0.999) <= 1


def test_points_take_the_colours_of_cameras(photos, tmp_path):
    xyz, _ = sweep(32, 500)
    scan = Scan(xyz=xyz, remission=np.zeros(len(xyz), dtype=np.float32))
    _, depth_m = truth()
    around = composed(panorama(depth_m, points=len(scan)), photos)
    points = around.colour_points(scan)
    real = points.source > 0
    assert real.mean() > 0.9 and points.valid[real].all()
    assert np.abs(points.colour - painting(xyz))[real].mean() < 2
    around.save_points(tmp_path / "a.ply", scan)
    assert b"property uchar source" in (tmp_path / "a.ply").read_bytes()[:600]
    assert (panorama(depth_m, points=len(scan)).colour_points(scan).source == 0).all()


def test_the_source_is_saved(photos, tmp_path):
    _, depth_m = truth()
    around = composed(panorama(depth_m), photos)
    (path,) = around.save(tmp_path, "source")
    from PIL import Image

    assert path.name == "a.source.png" and (np.asarray(Image.open(path)) == around.source).all()
    (path,) = panorama(depth_m).save(tmp_path, "source", stem="b")
    assert not np.asarray(Image.open(path)).any(), "without cameras all is invented"
