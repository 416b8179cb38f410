"""Walls are even and foliage is rough, and that decides between the two."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lidar2pano.geometry import roughness as module
from lidar2pano.geometry.projection import directions
from lidar2pano.geometry.roughness import foliage_or_wall, roughness
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
    carried = out.copy()
    for row, column in np.argwhere(np.isnan(out)):
        below = [one for one in out[row:, column] if not np.isnan(one)]
        above = [one for one in out[: row + 1, column] if not np.isnan(one)]
        carried[row, column] = below[0] if below else above[-1] if above else np.nan
    return np.exp(carried).repeat(high, 0).repeat(wide, 1)


def test_roughness_agrees_with_its_definition():
    channels = channels_of(*scene())
    channels[..., 20:60] = 0  # columns without any point
    assert np.allclose(roughness(channels)[0], slowly(channels), rtol=1e-3, equal_nan=True)
    assert roughness(channels).isnan().any()


def test_a_wall_is_even_however_it_stands_and_foliage_is_as_rough_as_it_is():
    found = roughness(channels_of(*scene()))[0]
    inner = slice(16, COLUMNS // 2 - 16)
    assert found[:, inner].max() < 2 * module.LEAST_M
    leaves = found[:, COLUMNS // 2 + 16 : -16]
    assert 0.1 < leaves.median() < 0.3


@pytest.mark.parametrize("deviation_m", [0.01, 0.3])
def test_doubtful_pixels_become_what_the_surface_says(deviation_m):
    logits = torch.zeros(1, 3, ROWS, COLUMNS)
    logits[:, ROAD, 12:] = 5.0
    before = logits.softmax(1)
    foliage_or_wall(logits, channels_of(*scene(deviation_m)), WALL, LEAVES)
    after = logits.softmax(1)
    assert torch.allclose(after[:, ROAD], before[:, ROAD], atol=1e-6), "others stay"
    inner = slice(COLUMNS // 2 + 16, -16)
    expected = LEAVES if deviation_m > module.EVEN_M else WALL
    assert (after[0, :2].argmax(0)[:, inner] == expected).all()
    assert (after[0, :2].argmax(0)[:, 16 : COLUMNS // 2 - 16] == WALL).all()


def test_odds_change_by_the_ratio():
    logits = torch.randn(1, 3, ROWS, COLUMNS, generator=torch.Generator().manual_seed(2))
    channels, before = channels_of(*scene()), logits.clone()
    foliage_or_wall(logits, channels, WALL, LEAVES)
    gained = (logits[:, LEAVES] - logits[:, WALL]) - (before[:, LEAVES] - before[:, WALL])
    assert torch.allclose(gained.exp(), roughness(channels) / module.EVEN_M, rtol=1e-3)


def test_without_points_nothing_changes():
    logits = torch.randn(1, 3, ROWS, COLUMNS, generator=torch.Generator().manual_seed(2))
    before = logits.clone()
    foliage_or_wall(logits, torch.zeros(1, 5, ROWS, COLUMNS), WALL, LEAVES)
    assert torch.allclose(logits, before, atol=1e-5)


def test_it_turns_with_the_scene():
    channels = channels_of(*scene())
    assert torch.allclose(roughness(channels.roll(8, 3)), roughness(channels).roll(8, 2), rtol=1e-4)
