from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from golden_vectors import facts, recorded
from lidar2pano.calibration import read_calib
from lidar2pano.errors import InputError
from lidar2pano.formats.readers import read
from lidar2pano.geometry.camera import at_camera
from lidar2pano.geometry.projection import (
    Normalisation,
    RangeImage,
    directions,
    fitted_view,
    nearest_points,
    pixels,
    project,
)
from lidar2pano.scan import Scan
from lidar2pano.views import VIEWS, View
from published_projection import published_projection, synthetic_scan
from slow_definitions import nearest_slowly, place_slowly, points_on_rays, project_slowly

FRONT = View(rows=32, columns=512, up=3, down=-15, left=45, right=-45)
BEHIND = View(rows=32, columns=90, up=10, down=-25, left=225, right=135)
SMALL = {
    "sphere": replace(VIEWS["hdl64e"], columns=512),
    "sphere from elsewhere": replace(VIEWS["hdl64e"], columns=512, origin=(3.0, -2.0, 0.5)),
    "cylinder": replace(VIEWS["panorama"].scaled(0.125), origin=(0.0, 0.0, 0.0)),
    "cylinder at the camera": VIEWS["panorama"].scaled(0.125),
    "front": FRONT,
    "behind": BEHIND,
    "all around, from elsewhere": View(rows=16, columns=100, up=10, down=-25, left=200, right=-160),
    "to one side": View(rows=16, columns=100, up=10, down=-25, left=-30, right=-300),
}


def scan_of(*points: tuple[float, float, float], remission: float = 0.5) -> Scan:
    xyz = np.array(points, dtype=np.float32).reshape(-1, 3)
    return Scan(xyz=xyz, remission=np.full(len(xyz), remission, dtype=np.float32))


def at_azimuth(*degrees: float, range_m: float = 10.0) -> Scan:
    return scan_of(*((range_m * math.cos(math.radians(a)), range_m * math.sin(math.radians(a)), 0.0) for a in degrees))


def random_scan(points: int = 3000, seed: int = 0) -> Scan:
    """Points all around, with a few unusable and a few equal ones."""
    generator = np.random.default_rng(seed)
    azimuth, elevation = generator.uniform(-math.pi, math.pi, points), np.radians(generator.uniform(-30, 15, points))
    ray = np.stack([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], 1)
    xyz = (ray * generator.uniform(1, 60, (points, 1))).astype(np.float32)
    xyz[10:20], xyz[20:25], xyz[30:33] = 0, np.nan, np.inf
    xyz[40:90] = xyz[100:150]
    return Scan(xyz=xyz, remission=generator.random(points, dtype=np.float32))


def owners(image: RangeImage) -> dict[tuple[int, int], int]:
    return {(row, column): int(image.index[row, column]) for row, column in image.valid.nonzero().tolist()}


@pytest.mark.parametrize("name", SMALL)
def test_project_agrees_with_its_definition(name):
    scan, view = random_scan(), SMALL[name]
    image = project(scan, view)
    assert owners(image) == project_slowly(scan.xyz, view)
    assert image.valid.sum() > 100
    places = [place_slowly(point, view) for point in scan.xyz]
    assert image.inside.tolist() == [place is not None for place in places]
    found = torch.stack([image.row, image.column], 1)[image.inside].tolist()
    assert found == [list(place) for place in places if place is not None]


@pytest.mark.parametrize("name", SMALL)
def test_channels_are_the_owning_points_relative_to_the_origin(name):
    scan, view = random_scan(), SMALL[name]
    image = project(scan, view)
    owner = image.index[image.valid]
    shifted = torch.from_numpy(scan.xyz - np.float32(view.origin))[owner]
    torch.testing.assert_close(image.channels[1:4, image.valid].T, shifted)
    torch.testing.assert_close(image.channels[0, image.valid], shifted.norm(dim=1))
    torch.testing.assert_close(image.channels[0, image.valid], image.range_m[owner])
    assert torch.equal(image.channels[4, image.valid], torch.from_numpy(scan.remission)[owner])
    assert not image.channels[:, ~image.valid].any()
    assert torch.equal(image.valid, image.index >= 0)


# --- the published projection ---------------------------------------------------------------------------------------

EDGES = {"titan-front": (3.0, -15.0, 45.0), "hdl64e": (3.0, -25.0, 180.0)}  # up, down, half width in degrees


@pytest.mark.parity
@pytest.mark.parametrize(("file", "view"), [("titan_synth", "titan-front"), ("salsa_synth", "hdl64e")])
def test_the_written_out_published_projection_is_the_recorded_one(golden: Path, file: str, view: str) -> None:
    """On another processor an angle may be rounded otherwise, so that a point falls into the pixel beside."""
    found = published_projection(synthetic_scan(), *EDGES[view])
    kept, noted = recorded(golden, f"projection_{file}"), facts(golden, f"projection_{file}")
    for name, values in found._asdict().items():
        ours, theirs = kept[name].of(torch.from_numpy(values)), kept[name].values
        assert ours.dtype == theirs.dtype
        assert (ours != theirs).sum() <= 2, name
    assert (found.proj_idx >= 0).sum() == pytest.approx(noted["valid_pixels"], abs=2)
    assert (found.proj_idx >= 0).sum() - found.proj_mask.sum() == 1 == noted["valid_pixels"] - noted["mask_pixels"]
    assert found.proj_idx.sum(dtype=np.int64) == pytest.approx(noted["idx_checksum"], abs=500_000)  # 1e-4 of it
    assert found.proj_range.sum(dtype=np.float64) == pytest.approx(noted["range_sum"], abs=200)


def assert_agrees_with_the_published_projection(scan: Scan, view: str, points: int) -> None:
    """At most `points` in view fall into another pixel (single and double precision), how many hangs on the processor.

    Each changes two pixels at most: that which it leaves, and that which it enters.
    """
    published, image = published_projection(scan, *EDGES[view]), project(scan, VIEWS[view])
    row, column, inside = image.row.numpy(), image.column.numpy(), image.inside.numpy()
    differs = (row != published.proj_y) | (column != published.proj_x)
    assert inside.sum() > 17_000 and (differs & inside).sum() <= points
    steps = np.abs(row - published.proj_y) + np.abs(column - published.proj_x)
    assert (steps[differs & inside] == 1).all(), "rounding moves a point to the pixel beside"
    inner = np.s_[1:-1, 1:-1]  # the published code clamps what is out of view into the border
    differs = (image.index.numpy() != published.proj_idx)[inner]
    assert differs.sum() <= 2 * points


@pytest.mark.parity
@pytest.mark.parametrize(("view", "points"), [("titan-front", 1), ("hdl64e", 5)])
def test_projection_is_the_published_one_in_view(view: str, points: int) -> None:
    assert_agrees_with_the_published_projection(synthetic_scan(), view, points)


@pytest.mark.parametrize(("view", "points"), [("titan-front", 2), ("hdl64e", 7)])
def test_projection_of_a_real_scan_is_the_published_one_in_view(kitti_mini: Path, view: str, points: int) -> None:
    scan = read(kitti_mini / "sequences" / "drive" / "velodyne" / "000000.bin")
    assert_agrees_with_the_published_projection(scan, view, points)


@pytest.mark.parity
def test_network_input_is_the_published_one() -> None:
    published, image = (
        published_projection(synthetic_scan(), *EDGES["hdl64e"]),
        project(synthetic_scan(), VIEWS["hdl64e"]),
    )
    same = (image.index.numpy() == published.proj_idx) & (published.proj_mask > 0)
    assert same.sum() > 74_000
    np.testing.assert_allclose(image.channels[0].numpy()[same], published.proj_range[same], rtol=3e-7)
    np.testing.assert_array_equal(image.channels[1:4].movedim(0, 2).numpy()[same], published.proj_xyz[same])
    ours = Normalisation()(image)
    np.testing.assert_allclose(ours.numpy()[:, same], published.net_input[:, same], atol=2e-6)
    assert not ours[:, ~image.valid].any()


def test_a_sixth_channel_is_the_roughness_beside_each_point():
    """By hand: 10 m away, every fourth point off by 0.2 m, so that comparisons one and two columns away see it."""
    view = replace(VIEWS["hdl64e"], rows=2, columns=64)
    range_m = torch.full((2, 64), 10.0)
    range_m[0, ::4] = 10.2
    range_m[1, 5:] = 0
    image = project(
        Scan(
            xyz=points_on_rays(range_m, view).reshape(-1, 3).nan_to_num(0).numpy(), remission=np.ones(128, np.float32)
        ),
        view,
    )
    five, six = Normalisation()(image), Normalisation.of(6)(image)
    assert five.shape == (5, 2, 64) and torch.equal(six[:5], five)
    flat = torch.hypot(*image.channels[1:3])[0].double()
    off = [abs((1 / flat[8 - away] + 1 / flat[8 + away]) / 2 - 1 / flat[8]) * flat[8] ** 2 for away in (1, 2, 3)]
    expected = (sum(math.log(float(each) + 0.001) for each in off) / 3 - math.log(0.03)) / 1.3
    assert float(six[5, 0, 8]) == pytest.approx(expected, abs=0.01) and expected > 0.5
    assert not six[5, 1, 5:].any() and not six[5, 1, 0], "nothing there, and nothing beside it"
    assert six[5, 1, 2] < -1.5, "even"


@pytest.mark.parametrize("name", SMALL)
def test_points_on_the_rays_of_their_pixels_are_projected_there(name):
    view = SMALL[name]
    range_m = torch.from_numpy(np.random.default_rng(0).uniform(2, 50, (view.rows, view.columns))).float()
    range_m[3, 5] = 0
    points = points_on_rays(range_m, view)
    assert points.shape == (view.rows, view.columns, 3) and points[3, 5].isnan().all()
    image = project(Scan(xyz=points.reshape(-1, 3).numpy(), remission=np.ones(range_m.numel(), np.float32)), view)
    assert not image.valid[3, 5] and image.valid.sum() == view.rows * view.columns - 1
    assert torch.equal(image.index[image.valid], torch.arange(view.rows * view.columns)[image.valid.flatten()])
    torch.testing.assert_close(image.channels[0][image.valid], range_m[image.valid], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", SMALL)
def test_directions_are_unit_vectors_through_pixel_centres(name):
    view = SMALL[name]
    rays = directions(view)
    torch.testing.assert_close(rays.norm(dim=2), torch.ones(view.rows, view.columns))
    row, column = pixels(*rays.unbind(2), view)
    wanted = torch.meshgrid(torch.arange(view.rows) + 0.5, torch.arange(view.columns) + 0.5, indexing="ij")
    torch.testing.assert_close(row, wanted[0].double(), atol=1e-3, rtol=0)
    torch.testing.assert_close(column, wanted[1].double(), atol=1e-3, rtol=0)


def test_a_point_without_remission_is_dropped():
    scan = Scan(xyz=np.array([[10, 0, 0], [0, 10, 0]], np.float32), remission=np.array([np.nan, 0.1], np.float32))
    image = project(scan, VIEWS["hdl64e"])
    assert image.dropped == 1 and image.valid.sum() == 1 and image.channels.isfinite().all()


def test_points_at_either_origin_are_dropped():
    view = replace(VIEWS["panorama"].scaled(0.125), origin=(1.0, 2.0, 3.0))
    image = project(scan_of((0, 0, 0), (1, 2, 3), (5, 2, 3)), view)
    assert image.usable.tolist() == [False, False, True]
    assert image.range_m.tolist() == [0, 0, 4]


@pytest.mark.parametrize("points", [[], [(0, 0, 0)] * 3, [(math.nan,) * 3] * 2])
@pytest.mark.parametrize("view", [VIEWS["hdl64e"], SMALL["cylinder at the camera"]])
def test_a_scan_without_usable_points_gives_an_empty_image(points, view):
    image = project(scan_of(*points), view)
    assert image.dropped == len(points) and not image.valid.any() and not image.channels.any()
    assert (image.index == -1).all() and not image.inside.any()
    assert (image.spread(torch.ones(len(points), dtype=torch.int64), empty=7) == 7).all()


@pytest.mark.parametrize("name", SMALL)
def test_points_straight_up_and_down_are_out_of_view(name):
    view = replace(SMALL[name], origin=(0.0, 0.0, 0.0))
    image = project(scan_of((0, 0, 5), (0, 0, -5), (1e-6, 0, 80)), view)
    assert not image.valid.any() and image.dropped == 0


def test_far_points_straight_up_and_down_are_given_from_their_side():
    row = project(scan_of((0, 0, 1e18), (0, 0, -1e18)), VIEWS["panorama"]).row
    assert row[0] < 0 and row[1] >= 384, "no overflow"


def test_equal_ranges_among_many_points():
    xyz = np.tile(random_scan(500).xyz, (4, 1))
    image = project(Scan(xyz=xyz, remission=np.zeros(2000, np.float32)), VIEWS["hdl64e"])
    assert image.index.max() < 500


def test_a_view_may_cross_the_direction_straight_behind():
    image = project(at_azimuth(223.5, 200.5, 180.5, 179.5, 135.5, 130, 230, 0), BEHIND)
    assert image.inside.tolist() == [True] * 5 + [False] * 3
    assert image.column[:5].tolist() == [1, 24, 44, 45, 89]


@pytest.mark.parametrize("view", [VIEWS["hdl64e"], VIEWS["waymo-top"], SMALL["all around, from elsewhere"]])
def test_no_direction_falls_between_the_last_column_and_the_first(view):
    tiny = [sign * 10.0**-power for power in range(4, 45) for sign in (1, -1)]
    image = project(scan_of(*((-10, y, 0) for y in tiny)), view)
    assert image.inside.all()
    behind = math.floor((view.left - 180) * view.columns / 360)
    assert set(image.column.tolist()) <= {behind, (behind - 1) % view.columns}


def test_the_edges_belong_to_the_left_and_the_top():
    image = project(scan_of((10, 10, 0), (10, -10, 0)), FRONT)
    assert image.column[0] == 0 and image.column[1] == 512 and image.inside.tolist() == [True, False]
    level = View(rows=4, columns=8, up=1.0, down=0.0, kind="cylinder")
    image = project(scan_of((10, 0, 10), (10, 0, 0)), level)
    assert image.row.tolist() == [0, 4] and image.inside.tolist() == [True, False]


def test_out_of_view_columns_tell_the_nearer_side():
    image = project(at_azimuth(50, 100, -50, -100), FRONT)
    assert (image.column[:2] < 0).all() and (image.column[2:] >= 512).all()
    image = project(at_azimuth(-120, 100), BEHIND)  # 240 degrees is left of 225
    assert image.column[0] < 0 and image.column[1] >= 90


def test_window_keeps_the_pixels():
    scan, view = random_scan(), VIEWS["panorama"].scaled(0.125)
    whole = project(scan, view)
    for start, columns in ((100, 200), (0, 576), (500, 76)):
        part = project(scan, view.window(start, columns))
        assert torch.equal(part.channels, whole.channels[..., start : start + columns])


@pytest.mark.parametrize("name", VIEWS)
def test_a_window_of_the_full_width_is_circular(name):
    view = VIEWS[name]
    for start in (0, 1, 7, 333, view.columns - 200):
        assert view.window(start, view.columns).circular == view.circular


def test_spread_carries_values_to_the_pixels_of_their_points():
    scan = scan_of((10, 0, 0), (20, 0, 0), (0, 10, 0))
    image = project(scan, VIEWS["hdl64e"])
    labels = image.spread(torch.tensor([4, 5, 6]), empty=255)
    assert sorted(labels.unique().tolist()) == [4, 6, 255] and (labels != 255).sum() == 2
    heights = image.spread(torch.tensor([0.5, 1.5, 2.5]))
    assert heights.dtype == torch.float32 and torch.equal(heights > 0, image.valid)


def test_the_cameras_own_view_matches_the_calibration(kitti_mini: Path):
    calibration = read_calib(kitti_mini / "sequences" / "drive" / "calib.txt")
    view = at_camera(VIEWS["panorama"], calibration)
    np.testing.assert_allclose(view.origin, VIEWS["panorama"].origin, atol=0.005)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("name", SMALL)
def test_cuda_agrees_with_the_cpu(name):
    scan = random_scan(100_000)
    here, there = (project(scan, SMALL[name], device=device) for device in ("cpu", "cuda"))
    same = here.index == there.index.cpu()  # processors round differently, and a point may be in the next pixel
    assert same.float().mean() > 0.999 and torch.equal(here.usable, there.usable.cpu())
    torch.testing.assert_close(here.range_m, there.range_m.cpu())
    torch.testing.assert_close(here.channels[:, same], there.channels.cpu()[:, same])


def test_the_z_buffer_agrees_with_its_slow_definition():
    generator = np.random.default_rng(2)
    cell = torch.from_numpy(generator.integers(0, 61, 2000))  # 60 is out of view
    distance = torch.from_numpy(generator.choice(np.float32([0, 1.5, 2, 7.25, np.inf]), 2000))
    cell[cell == 17] = 18
    assert nearest_points(cell, distance, 60).tolist() == nearest_slowly(cell.tolist(), distance.tolist(), 60)
    assert nearest_points(cell[:0], distance[:0], 3).tolist() == [-1, -1, -1]


def test_a_view_may_be_given_by_its_name():
    scan = Scan(xyz=[[10, 0, 0], [0, 5, 0]], remission=[0.5, 0.2])
    assert torch.equal(project(scan, "hdl64e").channels, project(scan, VIEWS["hdl64e"]).channels)
    with pytest.raises(InputError, match="no view 'hdl64'; did you mean 'hdl64e'"):
        project(scan, "hdl64")


# --- views that grow --------------------------------------------------------------------------------------------------


def rings(*elevations_deg: float, points: int = 200) -> Scan:
    """A scan of a sensor with beams of these elevations, 10 m away."""
    elevation, azimuth = (
        part.ravel() for part in np.meshgrid(np.radians(elevations_deg), np.linspace(-3, 3, points), indexing="ij")
    )
    level = np.cos(elevation)
    xyz = 10 * np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], 1)
    return Scan(xyz=xyz.astype(np.float32), remission=np.full(len(xyz), 0.5, np.float32))


@pytest.mark.parametrize(
    ("highest", "lowest", "rows", "up", "down"),
    [
        (2, -24.8, 64, 3.0, -25.0),  # HDL-64E
        (5.9, -27.9, 64, 3.0, -25.0),  # beyond, but within BORDER_DEG
        (7.1, -24.8, 80, 10.0, -25.0),
        (10.5, -30.67, 112, 17.0, -32.0),  # HDL-32E
        (15, -25, 96, 17.0, -25.0),  # Pandar64
        (22.5, -22.5, 112, 24.0, -25.0),  # OS1
        (60, -60, 128, 24.0, -32.0),  # as far as it goes
    ],
)
def test_a_view_grows_to_what_the_scan_measured(highest, lowest, rows, up, down):
    view, tallest = VIEWS["hdl64e"], VIEWS["hdl64e-tall"]
    grown = fitted_view(rings(highest, 0, -10, lowest), view, tallest)
    assert (grown.rows, grown.up, grown.down) == (rows, pytest.approx(up), pytest.approx(down))
    assert (grown.up - grown.down) / rows == pytest.approx((view.up - view.down) / view.rows)
    assert fitted_view(rings(highest, 0, -10, lowest), view, None) == view


def test_few_points_do_not_make_a_view_grow():
    level, high = rings(*np.linspace(-20, 0, 20), points=300), rings(12, points=25)
    both = Scan(xyz=np.concatenate([level.xyz, high.xyz]), remission=np.concatenate([level.remission, high.remission]))
    assert len(high) / len(both) < 0.005
    assert fitted_view(both, VIEWS["hdl64e"], VIEWS["hdl64e-tall"]) == VIEWS["hdl64e"]


def test_points_that_cannot_be_used_do_not_make_a_view_grow():
    scan = rings(0, -10)
    scan.xyz[::2] = np.nan
    scan.xyz[1::4] = 0
    assert fitted_view(scan, VIEWS["hdl64e"], VIEWS["hdl64e-tall"]) == VIEWS["hdl64e"]


def test_a_grown_view_keeps_the_pixels_of_the_view():
    scan = rings(*np.linspace(-24.5, 16, 90))
    view = VIEWS["hdl64e"]
    grown = fitted_view(scan, view, VIEWS["hdl64e-tall"])
    assert grown.rows == 96
    small, large = project(scan, view), project(scan, grown)
    assert torch.equal(large.channels[:, 32:], small.channels) and torch.equal(large.index[32:], small.index)
    assert large.valid[:32].any() and bool(large.inside.all()) and not bool(small.inside.all())
