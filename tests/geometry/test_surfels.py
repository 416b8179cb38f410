"""Surfels: agreement with their slow definition; surfaces are closed, whatever the pattern of points, and no larger."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("scipy", reason="the extra 'formats' brings it")

from lidar2pano.geometry.surfels import Rays, find_spacing, first_hits, fit_surfels, thin_by_range
from slow_definitions import first_hits_slowly

RAYS = Rays(elevation=np.radians(np.linspace(12, -12, 9)), azimuth=np.radians(np.linspace(-3, 3, 9)), firings=72)


def surfels_of(xyz: np.ndarray):
    """Return surfels of points that were thinned out to cells of no size."""
    return fit_surfels(xyz, np.zeros(len(xyz)), np.zeros(len(xyz)))


def wall(distance_m: float, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Points of a wall across the x axis, on a grid."""
    return np.stack([np.full(len(y) * len(z), distance_m), *map(np.ravel, np.meshgrid(y, z))], axis=1)


def test_rays_meet_what_the_slow_definition_says():
    generator = np.random.default_rng(3)
    xyz = generator.normal(0, 3, (160, 3)) * (1, 1, 0.3) + (7, 0, 0)
    surfels = surfels_of(xyz)
    ranges, _ = first_hits(surfels, RAYS)
    slow = first_hits_slowly(surfels, RAYS)
    assert 50 < np.isfinite(slow).sum() < slow.size - 50
    np.testing.assert_allclose(ranges, slow, rtol=1e-5)


PATTERNS = {
    "a grid": wall(6, np.arange(-4, 4, 0.1), np.arange(-3, 3, 0.1)),
    "by chance": wall(6, np.zeros(1), np.zeros(1))
    + np.random.default_rng(0).uniform((0, -4, -3), (0, 4, 3), (4800, 3)),
    "lines across": wall(6, np.arange(-4, 4, 0.02), np.arange(-3, 3, 0.2)),
    "lines upright": wall(6, np.arange(-4, 4, 0.2), np.arange(-3, 3, 0.02)),
}


@pytest.mark.parametrize("pattern", PATTERNS)
def test_no_ray_passes_a_wall_however_its_points_lie(pattern):
    """A second wall behind is not seen, and the range is that of the first one's plane."""
    behind = PATTERNS[pattern] * (1.5, 1, 1)
    ranges, _ = first_hits(surfels_of(np.concatenate([PATTERNS[pattern], behind])), RAYS)
    row, column = np.indices(ranges.shape).reshape(2, -1)
    direction = RAYS.directions(row, column)
    on_wall = (direction[:, 0] > 0) & (np.abs(direction[:, 1] / direction[:, 0] * 6) < 3.5)
    true = (6 / direction[:, 0])[on_wall]
    np.testing.assert_allclose(ranges.reshape(-1)[on_wall], true, atol=0.005)


def test_the_ground_has_its_range_at_the_lowest_angle():
    """A surfel lies in the ground and does not stand up on it, so that what is behind stays in view."""
    flat = np.random.default_rng(1).uniform((1, -10, -1.7), (60, 10, -1.7), (60_000, 3))
    rays = Rays(elevation=np.radians([-2.0, -4.0, -8.0]), azimuth=np.zeros(3), firings=720)
    ranges, _ = first_hits(surfels_of(flat[thin_by_range(flat, 0.006)]), rays)
    ahead = ranges[:, 357:363]
    np.testing.assert_allclose(ahead, (1.7 / np.sin([[0.0349066], [0.0697], [0.1391731]])) @ np.ones((1, 6)), rtol=0.01)


def test_a_pole_stays_as_narrow_as_its_points():
    """Of 10 cm, at points 5 cm apart: its outline is ragged, no beam misses it, and none finds it twice as wide."""
    turn, height = np.random.default_rng(2).uniform((0, -1.5), (2 * np.pi, 3), (900, 2)).T
    pole = np.stack([10 + 0.05 * np.cos(turn), 0.05 * np.sin(turn), height], axis=1)
    rays = Rays(elevation=np.radians(np.linspace(8, -6, 15)), azimuth=np.zeros(15), firings=7200)
    hit = np.isfinite(first_hits(surfels_of(pole[thin_by_range(pole, 0.006)]), rays)[0])
    width_m = hit.sum(1) * rays.step * 10
    assert width_m.all() and (width_m < 0.2).all() and 0.05 < width_m.mean() < 0.11, width_m


def test_a_lone_point_is_no_surface():
    cloud = wall(8, np.arange(-4, 4, 0.1), np.arange(-3, 3, 0.1))
    ranges, _ = first_hits(surfels_of(np.concatenate([cloud, [[3.0, 0, 0]]])), RAYS)
    assert np.isfinite(ranges).any() and ranges.min() > 7.9


def test_values_are_those_of_the_surface_in_front():
    near, behind = (
        wall(5, np.arange(-4, 4, 0.1), np.arange(-3, 3, 0.1)),
        wall(9, np.arange(-9, 9, 0.1), np.arange(-5, 5, 0.1)),
    )
    xyz = np.concatenate([near, behind])
    values = np.r_[np.full(len(near), 0.25), np.ones(len(behind))]
    ranges, value = first_hits(fit_surfels(xyz, values, np.full(len(xyz), 0.1)), RAYS)
    assert value[ranges < 5.2] == pytest.approx(0.25) and value[:, 36].max() == pytest.approx(0.25)


def test_spacing_is_that_of_surfaces_and_not_along_lines():
    assert find_spacing(PATTERNS["by chance"]) == pytest.approx(0.1, rel=0.1)
    assert 0.06 < find_spacing(PATTERNS["lines across"]) <= 0.25
