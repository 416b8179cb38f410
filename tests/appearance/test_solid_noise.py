"""Noise that hangs in space."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from lidar2pano.appearance.invented_textures import BITS, COARSER, SKY_M, VOXELS, noise_tile, smooth_noise, solid_noise
from lidar2pano.geometry.projection import directions
from lidar2pano.scene.surfaces import cylinder_points
from lidar2pano.views import VIEWS, View

VIEW = VIEWS["panorama"].scaled(1 / 16)
WAVES = (0.0625, 0.25, 4.0)


def turned(columns: int, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """The pose of a sensor that has turned left by so many columns and moved."""
    angle = columns / VIEW.columns * 2 * math.pi
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    pose[:3, 3] = shift
    return pose


def scene(view: View) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    depth_m = 1 + 30 * torch.rand(view.rows, view.columns, generator=generator) ** 2
    return depth_m, torch.rand(view.rows, view.columns, generator=generator) < 0.2


def slowly(depth_m, sky, view, waves, pose) -> torch.Tensor:
    """Every pixel of every third column for itself, in float64; NaN in the others."""
    tile = noise_tile(torch.device("cpu"), torch.float32).view(*[2**BITS] * 3)
    rays = directions(view).double().numpy()
    out = torch.full((len(waves), *depth_m.shape), torch.nan)
    finest = min(waves) / VOXELS
    start = np.round((pose[:3, :3] @ np.array(view.origin) + pose[:3, 3]) / finest) * finest
    for number, wave in enumerate(waves):
        for i in range(view.rows):
            for j in range(0, view.columns, 3):
                ray = pose[:3, :3] @ rays[i, j]
                distance = float(depth_m[i, j])
                point = ray * SKY_M if sky[i, j] else ray * distance + start
                x, y, z = (int(part) for part in np.floor(point / (wave / VOXELS)) % 2**BITS)
                footprint = 1e-3 / view.focal_px if sky[i, j] else distance / view.focal_px
                out[number, i, j] = tile[x, y, z] * min(max(wave / footprint - 1, 0), 1)
    return out


@pytest.mark.parametrize("pose", [np.eye(4), turned(5, (12.3, -4000.7, 1.1))], ids=["here", "elsewhere"])
def test_the_lookup_agrees_with_its_definition(pose):
    depth_m, sky = scene(VIEW)
    noise, slow = solid_noise(depth_m, sky, VIEW, WAVES, pose), slowly(depth_m, sky, VIEW, WAVES, pose)
    same = (noise - slow)[..., ::3].abs() < 1e-3  # float32 puts few points into the voxel beside
    assert same.float().mean() > 0.98
    assert noise.isfinite().all()


def test_a_wavelength_is_gone_where_a_pixel_is_as_wide():
    depth_m, sky = torch.full((VIEW.rows, VIEW.columns), 3.0), torch.zeros(VIEW.rows, VIEW.columns, dtype=torch.bool)
    width_m = 3.0 / VIEW.focal_px
    assert WAVES[0] < width_m < 2 * width_m < WAVES[1]
    noise = solid_noise(depth_m, sky, VIEW, WAVES)
    assert not noise[0].any() and noise[1].std() > 0.5


def test_noise_stays_in_the_world_when_the_sensor_turns():
    depth_m, sky = scene(VIEW)
    at_axis = View(**{**VIEW.as_dict(), "origin": (0.0, 0.0, 0.0)})
    here = solid_noise(depth_m, sky, at_axis, WAVES, turned(0, (3.0, 4.0, 5.0)))
    there = solid_noise(depth_m.roll(7, 1), sky.roll(7, 1), at_axis, WAVES, turned(7, (3.0, 4.0, 5.0)))
    assert ((here.roll(7, 2) - there).abs() < 1e-3).float().mean() > 0.98


def test_noise_stays_on_a_wall_when_the_sensor_moves():
    """Points of a wall at y = 8 m, seen from two places: the same noise, but for the rounding to voxels."""
    view = View(rows=16, columns=3600, up=0.2, down=-0.2, kind="cylinder")
    ahead_m = torch.linspace(-9, 9, 150)
    found = []
    for x_m in (0.0, 2.0):
        azimuth = torch.atan2(torch.tensor(8.0), ahead_m - x_m)
        column = ((math.pi - azimuth) / (2 * math.pi) * 3600).long()
        depth_m = 8 / directions(view)[..., 1].clamp(min=0.1)
        pose = np.eye(4)
        pose[0, 3] = x_m
        noise = solid_noise(depth_m, torch.zeros_like(depth_m, dtype=torch.bool), view, (4.0,), pose)
        found.append(noise[0, 7, column])
    assert found[0].std() > 0.3
    assert np.corrcoef(torch.stack(found))[0, 1] > 0.98


def test_the_sky_does_not_move_with_the_sensor():
    depth_m, sky = scene(VIEW)
    here, there = (solid_noise(depth_m, sky, VIEW, WAVES, turned(0, shift)) for shift in ((0, 0, 0), (30.0, 7.0, 0)))
    same = (here - there).abs() < 1e-3
    assert same[:, sky].float().mean() > 0.98
    assert same[:, ~sky].float().mean() < 0.6  # the finest is gone nearly everywhere


def test_the_tile_is_smooth_from_voxel_to_voxel():
    tile = noise_tile(torch.device("cpu"), torch.float32).view(*[2**BITS] * 3)
    assert tile.std() == pytest.approx(1, abs=1e-3) and abs(float(tile.mean())) < 1e-3
    for axis in range(3):
        assert (tile - tile.roll(1, axis)).std() < 0.6


def test_smooth_noise_is_the_tile_between_its_voxels():
    """Scipy's linear interpolation of the periodic tile, at the points that a fourth of the columns and rows show."""
    ndimage = pytest.importorskip("scipy.ndimage")
    depth_m, _ = scene(VIEW)
    pose = turned(5, (12.3, -400.7, 1.1))
    noise = smooth_noise(*cylinder_points(depth_m[None], VIEW), VIEW, 16.0, pose)[0]
    rays = directions(VIEW).double().numpy()
    points = (rays * depth_m.double().numpy()[..., None] + VIEW.origin) @ pose[:3, :3].T + pose[:3, 3]
    tile = noise_tile(torch.device("cpu"), torch.float32).view(*[2**BITS] * 3).numpy()
    expected = ndimage.map_coordinates(tile, points.reshape(-1, 3).T * VOXELS / 16, order=1, mode="grid-wrap")
    read = slice(COARSER // 2, None, COARSER)
    assert np.allclose(noise[read, read], expected.reshape(depth_m.shape)[read, read], atol=1e-3)
    assert torch.equal(noise[::COARSER, ::COARSER], noise[read, read])


def test_smooth_noise_has_no_steps():
    """Along a wall 10 m away, between one pixel that is read and the next (12 cm): a small part of its spread."""
    view = View(rows=8, columns=512 * COARSER, up=0.1, down=-0.1, kind="cylinder")
    noise = smooth_noise(*cylinder_points(torch.full((1, 8, view.columns), 10.0), view), view, 16.0)[0, 0, ::COARSER]
    assert noise.std() > 0.3
    assert (noise - noise.roll(1)).abs().max() < 0.1
