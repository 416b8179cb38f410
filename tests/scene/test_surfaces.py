"""Points, normals and the road's height from depths on a panorama."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from lidar2pano.geometry.projection import directions
from lidar2pano.scene.surfaces import (
    ROAD_Z_M,
    SAME_SURFACE,
    cylinder_points,
    normals,
    same_surface,
    slopes,
    viewpoint_height,
)
from lidar2pano.views import VIEWS, View

SMALL = VIEWS["panorama"].scaled(1 / 32)
SPHERE = View(rows=12, columns=72, up=10, down=-20)


def normals_slowly(depth_m: torch.Tensor, view: View) -> torch.Tensor:
    """Cross product of differences of Cartesian points, then turned into each column's axes."""
    rays = directions(view).double()
    points = rays * depth_m.double()[..., None]
    rows, columns = depth_m.shape
    out = torch.zeros(3, rows, columns, dtype=torch.float64)
    for i in range(rows):
        for j in range(columns):
            k = min(max(i, 1), rows - 2)
            down = points[k + 1, j] - points[k - 1, j]
            across = points[i, (j + 1) % columns] - points[i, j - 1]
            normal = torch.linalg.cross(down, across)
            normal = normal / normal.norm()
            flat = rays[i, j, :2] / rays[i, j, :2].norm()
            out[:, i, j] = torch.stack([normal[:2] @ flat, normal[1] * flat[0] - normal[0] * flat[1], normal[2]])
    return out


@pytest.mark.parametrize("view", [SMALL, SPHERE], ids=["cylinder", "sphere"])
def test_normals_agree_with_their_definition(view):
    depth_m = 5 + torch.rand(view.rows, view.columns, generator=torch.Generator().manual_seed(1))
    radius_m, z_m = cylinder_points(depth_m[None], view)
    assert torch.allclose(normals(radius_m, z_m, view)[0].double(), normals_slowly(depth_m, view), atol=1e-4)


def test_flat_ground_looks_up_and_a_wall_around_looks_at_the_sensor():
    radius_m = torch.linspace(20, 4, 12)[None, :, None].expand(1, 12, 72)
    ground = normals(radius_m, torch.full_like(radius_m, -1.7), SMALL)[0]
    assert torch.allclose(ground, torch.tensor([0.0, 0, 1])[:, None, None].expand_as(ground), atol=1e-5)
    z_m = torch.linspace(3, -2, 12)[None, :, None].expand(1, 12, 72)
    wall = normals(torch.full_like(z_m, 8.0), z_m, SMALL)[0]
    assert torch.allclose(wall, torch.tensor([-1.0, 0, 0])[:, None, None].expand_as(wall), atol=1e-5)


def test_the_viewpoint_is_as_high_as_most_pixels_of_the_road_say():
    view = replace(VIEWS["panorama"].scaled(1 / 4), origin=(0.0, 0.0, 0.4))
    slope = slopes(view)[:, None].expand(view.rows, view.columns)
    depth_m = torch.where(slope < 0, 2.1 / -slope, 50.0) * torch.sqrt(1 + slope.square())
    depth_m = depth_m.expand(2, -1, -1).clone()
    depth_m[:, :, :60] *= 0.5  # some of the pixels are wrong
    road = torch.zeros_like(depth_m, dtype=torch.bool)
    road[0, slope < 0] = True
    road[1, -20, :8] = True  # too few
    assert viewpoint_height(depth_m, road, view).tolist() == pytest.approx([2.1, 0.4 - ROAD_Z_M], rel=1e-3)
    below = viewpoint_height(2.2 * depth_m, road, view)
    assert below.tolist() == pytest.approx([0.4 - ROAD_Z_M] * 2), "no road lies so far below a vehicle's roof"
    assert viewpoint_height(depth_m + 90, road, view)[0] == pytest.approx(0.4 - ROAD_Z_M), "too far away"


def test_neighbours_are_of_one_surface_up_to_a_ratio():
    distance = torch.tensor([10.0, 10.0, 10.0, 10.0])
    neighbour = torch.tensor(
        [10 * SAME_SURFACE - 0.1, 10 * SAME_SURFACE + 0.1, 10 / SAME_SURFACE + 0.1, 10 / SAME_SURFACE - 0.1]
    )
    assert same_surface(distance, neighbour).tolist() == [True, False, True, False]
    assert same_surface(1 / distance, 1 / neighbour).tolist() == [True, False, True, False]


def test_turned_depths_have_turned_normals():
    view = replace(SMALL, origin=(0.0, 0.0, 0.0))
    depth_m = 5 + torch.rand(1, view.rows, view.columns)
    plain, turned = (normals(*cylinder_points(one, view), view) for one in (depth_m, depth_m.roll(7, 2)))
    assert torch.allclose(plain.roll(7, 3), turned, atol=1e-6)
