"""What lies a kerb above the road's plane is sidewalk, and what lies on it is road."""

from __future__ import annotations

import pytest
import torch

from lidar2pano.geometry.kerbs import FARTHEST_M, LEAST_ODDS, MOST_ODDS, PER_M, road_plane, weigh_by_height
from lidar2pano.geometry.surface import azimuths, slopes
from lidar2pano.views import View

ROAD, WALK, WALL = range(3)
ROWS, COLUMNS = 64, 180
VIEW = View(rows=ROWS, columns=COLUMNS, up=0.1, down=-0.6, kind="cylinder")


def ground(tilt: float = 0.0, height_m: torch.Tensor | float = 0.0) -> torch.Tensor:
    """Depths (1, H, W) of a plane 1.7 m below the eye that rises by `tilt` to the front, and of what lies above it."""
    azimuth, slope = azimuths(VIEW).float(), slopes(VIEW)[:, None]
    radius_m = (height_m - 1.7) / (slope - tilt * azimuth.cos())
    radius_m = torch.where((radius_m > 0) & (radius_m < 60), radius_m, 60.0)
    return (radius_m * torch.sqrt(1 + slope.square()))[None]


def gained(depth_m: torch.Tensor, ids: torch.Tensor) -> torch.Tensor:
    """By how much the logarithm of the odds of sidewalk against road has grown, (H, W)."""
    logits = torch.randn(1, 3, ROWS, COLUMNS, generator=torch.Generator().manual_seed(1))
    after = logits.clone()
    weigh_by_height(after, ids, depth_m, VIEW, ROAD, WALK)
    assert torch.equal(after[:, WALL], logits[:, WALL])
    assert torch.allclose(after.logsumexp(1), logits.logsumexp(1), atol=1e-5)
    return ((after[:, WALK] - after[:, ROAD]) - (logits[:, WALK] - logits[:, ROAD]))[0]


@pytest.mark.parametrize("tilt", [0.0, 0.05])
def test_heights_count_from_the_roads_plane(tilt):
    above_m = torch.zeros(COLUMNS)
    above_m[60:80], above_m[80:90] = 0.06, 0.3
    ids = torch.where(above_m > 0, WALK, ROAD).expand(1, ROWS, COLUMNS)
    depth_m = ground(tilt, above_m)
    near = (depth_m[0] < FARTHEST_M - 1) & (slopes(VIEW)[:, None] < -0.1)
    odds = gained(depth_m, ids)
    for columns, expected in ((slice(60), LEAST_ODDS), (slice(60, 80), 0.02 * PER_M), (slice(80, 90), MOST_ODDS)):
        found = odds[:, columns][near[:, columns]]
        assert found.mean().item() == pytest.approx(expected, abs=0.1)


def test_far_off_nothing_changes():
    depth_m = ground()
    odds = gained(depth_m, torch.full((1, ROWS, COLUMNS), ROAD))
    far = depth_m[0] > FARTHEST_M * 1.2
    assert far.any() and odds[far].abs().max() < 1e-5


def test_without_a_road_nothing_changes():
    assert gained(ground(), torch.full((1, ROWS, COLUMNS), WALL)).abs().max() < 1e-5


def test_the_plane_is_that_of_most_points():
    generator = torch.Generator().manual_seed(2)
    x, y = 20 * torch.rand(2, 400, generator=generator) - 10
    z = 0.03 * x - 0.01 * y - 1.7 + 0.01 * torch.randn(400, generator=generator)
    z[:60] += 0.5
    plane = road_plane(x, y, z)
    assert plane is not None and plane.tolist() == pytest.approx([0.03, -0.01, -1.7], abs=0.003)
    assert road_plane(x[:40], y[:40], z[:40]) is None
