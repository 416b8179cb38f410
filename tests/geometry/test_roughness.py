"""Walls are even and foliage is rough, asphalt and grass likewise, and that decides between them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from lidar2pano.geometry import roughness as module
from lidar2pano.geometry.projection import directions
from lidar2pano.geometry.roughness import Evidence, roughness, weigh_by_roughness
from lidar2pano.geometry.surface import slopes
from lidar2pano.views import View

WALL, LEAVES, ROAD = range(3)
ROWS, COLUMNS = 16, 96
VIEW = View(rows=ROWS, columns=COLUMNS, up=0.2, down=-0.2, kind="cylinder")


def channels_of(radius_m: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
    """Channels (1, 5, H, W) of horizontal distances (H, W), measured where `measured` (H, W) says."""
    points = directions(VIEW) * (radius_m * torch.sqrt(1 + slopes(VIEW)[:, None].square()))[..., None]
    return torch.cat([points.norm(dim=2)[None], points.movedim(2, 0), radius_m[None]])[None] * measured


def scene(deviation_m: float = 0.2, seed: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    """Distances of a wall askew in the first half of the columns, of foliage in the second, and what is measured."""
    generator = torch.Generator().manual_seed(seed)
    azimuth = torch.linspace(0.5, -0.5, COLUMNS)
    radius_m = (8 / torch.cos(azimuth - 0.4)).expand(ROWS, COLUMNS).clone()
    rough = deviation_m * torch.randn(ROWS, COLUMNS // 2, generator=generator)
    radius_m[:, COLUMNS // 2 :] = 9 + rough
    measured = torch.zeros(ROWS, COLUMNS, dtype=torch.bool)
    measured[4::3] = True
    measured[:, :: COLUMNS // 4] = False
    return radius_m, measured


def slowly(channels: torch.Tensor) -> np.ndarray:
    """The definition, block by block: (H, W) metres."""
    flat = torch.hypot(channels[0, 1], channels[0, 2]).double().numpy()
    high, wide = module.BLOCK
    total, count = np.zeros((ROWS // high, COLUMNS // wide)), np.zeros((ROWS // high, COLUMNS // wide))
    for row in range(ROWS):
        for column in range(COLUMNS):
            for away in module.BESIDE_PX:
                here, left, right = (flat[row, at % COLUMNS] for at in (column, column - away, column + away))
                if here and left and right:
                    off = abs((1 / left + 1 / right) / 2 - 1 / here) * here**2
                    total[row // high, column // wide] += np.log(min(off + module.LEAST_M, module.MOST_M))
                    count[row // high, column // wide] += 1
    out, reach = np.full(total.shape, np.nan), module.AROUND // 2
    for row in range(len(out)):
        for column in range(out.shape[1]):
            rows = range(max(row - reach, 0), min(row + reach + 1, len(out)))
            around = [(r, c % out.shape[1]) for r in rows for c in range(column - reach, column + reach + 1)]
            total_here, count_here = (sum(part[at] for at in around) for part in (total, count))
            if count_here > module.ENOUGH:
                out[row, column] = total_here / count_here
    complete = out.copy()
    for row, column in np.argwhere(np.isnan(out)):
        below = [one for one in out[row:, column] if not np.isnan(one)]
        above = [one for one in out[: row + 1, column] if not np.isnan(one)]
        complete[row, column] = below[0] if below else above[-1] if above else np.nan
    return np.exp(complete).repeat(high, 0).repeat(wide, 1)


def test_roughness_agrees_with_its_definition():
    channels = channels_of(*scene())
    channels[..., 20:60] = 0  # columns without any point
    assert np.allclose(roughness(channels)[0], slowly(channels), rtol=1e-3, equal_nan=True)
    assert roughness(channels).isnan().any()


def test_a_wall_is_even_however_it_stands_and_foliage_is_as_rough_as_it_is():
    found = roughness(channels_of(*scene()))[0]
    inner = slice(16, COLUMNS // 2 - 16)
    assert found[:, inner].max() < 0.01
    leaves = found[:, COLUMNS // 2 + 16 : -16]
    assert 0.1 < leaves.median() < 0.3


def weighed(logits: torch.Tensor, channels: torch.Tensor, **changes) -> torch.Tensor:
    """Logits after the evidence for leaves against walls, all of it 10 m away."""
    evidence = Evidence(LEAVES, [WALL], limit_m=0.05, growth=0.0, power=1.0)._replace(**changes)
    after = logits.clone()
    weigh_by_roughness(after, channels, torch.full((1, ROWS, COLUMNS), 10.0), [evidence])
    return after


@pytest.mark.parametrize("deviation_m", [0.01, 0.3])
def test_doubtful_pixels_become_what_the_surface_says(deviation_m):
    logits = torch.zeros(1, 3, ROWS, COLUMNS)
    logits[:, ROAD, 12:] = 5.0
    after = weighed(logits, channels_of(*scene(deviation_m))).softmax(1)
    assert torch.allclose(after[:, ROAD], logits.softmax(1)[:, ROAD], atol=1e-6), "others stay"
    inner = slice(COLUMNS // 2 + 16, -16)
    expected = LEAVES if deviation_m > 0.05 else WALL
    assert (after[0, :2].argmax(0)[:, inner] == expected).all()
    assert (after[0, :2].argmax(0)[:, 16 : COLUMNS // 2 - 16] == WALL).all()


@pytest.mark.parametrize(("even", "power"), [([WALL], 1.0), ([WALL, ROAD], 0.5)])
def test_odds_change_by_a_power_of_the_ratio(even, power):
    logits = torch.randn(1, 3, ROWS, COLUMNS, generator=torch.Generator().manual_seed(2))
    channels = channels_of(*scene())
    after = weighed(logits, channels, even=even, power=power)
    odds = [each[:, LEAVES] - each[:, even].logsumexp(1) for each in (logits, after)]
    limit = math.exp(module.MOST_ODDS)
    expected = (roughness(channels) / 0.05).pow(power).clamp(1 / limit, limit)
    assert torch.allclose((odds[1] - odds[0]).exp(), expected, rtol=1e-3)
    assert torch.allclose(after.logsumexp(1), logits.logsumexp(1), atol=1e-4)
    among = [each[:, ROAD] - each[:, WALL] for each in (logits, after)]
    assert torch.allclose(*among, atol=1e-4) == (ROAD in even), "shares of those that are even stay"


def test_far_off_more_is_allowed():
    logits, channels = torch.zeros(1, 3, ROWS, COLUMNS), channels_of(*scene())
    depth_m = torch.full((1, ROWS, COLUMNS), 20.0)
    evidence = Evidence(LEAVES, [WALL], limit_m=0.05, growth=0.8, power=1.0)
    weigh_by_roughness(logits, channels, depth_m, [evidence])
    near = weighed(torch.zeros(1, 3, ROWS, COLUMNS), channels, limit_m=0.05 * 2**0.8)
    assert torch.allclose(logits, near, atol=1e-4)


def test_surfaces_rougher_than_all_change_odds_by_so_much_at_most():
    logits = torch.zeros(1, 3, ROWS, COLUMNS)
    after = weighed(logits, channels_of(*scene(3.0)), power=9.0)
    assert (after[:, LEAVES] - after[:, WALL]).abs().max() == pytest.approx(module.MOST_ODDS)


def test_without_points_nothing_changes():
    logits = torch.randn(1, 3, ROWS, COLUMNS, generator=torch.Generator().manual_seed(2))
    assert torch.allclose(weighed(logits, torch.zeros(1, 5, ROWS, COLUMNS)), logits, atol=1e-5)


def test_it_turns_with_the_scene():
    channels = channels_of(*scene())
    assert torch.allclose(roughness(channels.roll(8, 3)), roughness(channels).roll(8, 2), rtol=1e-4)
