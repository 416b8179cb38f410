"""Points, normals and the road's height from depths on a panorama."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidar2pano.geometry.projection import directions
from lidar2pano.labels import COMMON15, THINGS
from lidar2pano.scene.surfaces import (
    LEAST_PIXELS,
    ROAD_Z_M,
    SAME_SURFACE,
    components,
    cylinder_points,
    normals,
    same_surface,
    slopes,
    thing_instances,
    viewpoint_height,
)
from lidar2pano.views import VIEWS, View

SMALL = VIEWS["panorama"].scaled(1 / 32)
SPHERE = View(rows=12, columns=72, up=10, down=-20)
CAR, PERSON, ROAD = (COMMON15.id_of(name) for name in ("car", "person", "road"))


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


def flooded(segments, depth_m, measured, circular):
    """The slow definition: floods from each pixel."""
    rows, columns = segments.shape
    number, last = np.zeros(segments.shape, dtype=int), 0
    seen = ~(np.isin(segments, THINGS) & (depth_m > 0))
    for start in np.ndindex(rows, columns):
        if seen[start]:
            continue
        seen[start], waiting, surface = True, deque([start]), [start]
        while waiting:
            row, column = waiting.popleft()
            for r, beside in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
                c = beside % columns if circular else beside
                if not (0 <= r < rows and 0 <= c < columns) or seen[r, c] or segments[r, c] != segments[row, column]:
                    continue
                one, other = depth_m[row, column], depth_m[r, c]
                if max(one, other) < SAME_SURFACE * min(one, other):
                    seen[r, c] = True
                    waiting.append((r, c))
                    surface.append((r, c))
        place = tuple(np.array(surface).T)
        if len(surface) >= LEAST_PIXELS and measured[place].any():
            last += 1
            number[place] = last
    return number


def scene(rows=40, columns=120):
    """A road at 10 m, all of it measured."""
    return (
        np.full((rows, columns), ROAD, dtype=np.uint8),
        np.full((rows, columns), 10, dtype=np.float32),
        np.ones((rows, columns), dtype=bool),
    )


@pytest.mark.parametrize("circular", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_it_agrees_with_flooding(seed, circular):
    generator = np.random.default_rng(seed)
    segments = generator.choice([CAR, CAR, PERSON, ROAD], (12, 24)).astype(np.uint8).repeat(5, 0).repeat(5, 1)
    depth_m = generator.uniform(12, 30, (12, 24)).astype(np.float32).repeat(5, 0).repeat(5, 1)
    measured = generator.random(segments.shape) < 0.02
    found = thing_instances(segments, depth_m, measured, circular=circular)
    expected = flooded(segments, depth_m, measured, circular)
    assert np.array_equal(found, expected) and expected.max() > 3


def test_one_behind_the_other_are_two_and_across_the_seam_one():
    segments, depth_m, measured = scene()
    segments[5:25, 40:60] = segments[5:25, 110:] = segments[5:25, :10] = CAR
    depth_m[5:25, 50:60] = 30  # behind
    found = thing_instances(segments, depth_m, measured, circular=True)
    assert found.max() == 3 and found[10, 45] != found[10, 55] and found[10, 0] == found[10, 119] > 0
    assert thing_instances(segments, depth_m, measured, circular=False).max() == 4


def test_a_guess_without_a_point_and_a_speck_are_none():
    segments, depth_m, measured = scene()
    segments[5:25, 40:60] = CAR
    measured[5:25, 40:60] = False
    segments[30:39, 80:91] = PERSON  # 99 pixels
    assert not thing_instances(segments, depth_m, measured, circular=True).any()
    measured[6, 50], segments[30, 91] = True, PERSON
    assert thing_instances(segments, depth_m, measured, circular=True).max() == 2


def test_nothing_has_no_instances():
    segments, depth_m, measured = scene()
    assert not thing_instances(segments, depth_m, measured, circular=True).any()


def test_a_long_chain_is_one_component():
    node = np.random.default_rng(0).permutation(5000)
    assert not components(5000, node[:-1], node[1:]).any()
    assert np.array_equal(components(4, np.array([3]), np.array([1])), [0, 1, 2, 1])
