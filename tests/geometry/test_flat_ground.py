"""What lies flat on the ground, or slopes, is no fence; what stands on it stays one."""

from __future__ import annotations

import math

import pytest
import torch

from lidar2pano.geometry.flat_ground import AROUND, BANK_M, FLAT, HIGH_M, LOW_M, NEAR_M, REACH, STEEP, no_flat_fences
from lidar2pano.geometry.surface import slopes
from lidar2pano.views import View

ROAD, WALL, FENCE, GRASS, SHRUB = range(5)
ROWS, COLUMNS, EYE_M = 60, 48, 1.73  # height of the sensor above the road
VIEW = View(rows=ROWS, columns=COLUMNS, up=0.5, down=-0.6, kind="cylinder")


def levelled(ids: torch.Tensor, radius_m: torch.Tensor) -> torch.Tensor:
    """Ids (H, W) after `no_flat_fences`, of a scene made of ids and horizontal distances."""
    generator = torch.Generator().manual_seed(1)
    logits = torch.rand(1, 5, ROWS, COLUMNS, generator=generator)
    logits += 5 * torch.nn.functional.one_hot(ids, 5).movedim(2, 0)
    after, height_m = logits.clone(), radius_m * slopes(VIEW)[:, None] + EYE_M
    no_flat_fences(after, ids[None], radius_m[None], height_m[None], (ROAD, GRASS), (GRASS, SHRUB), FENCE)
    before, now = logits.softmax(1), after.softmax(1)
    assert torch.equal(after[:, WALL], logits[:, WALL])
    assert torch.allclose(before.sum(1), now.sum(1))
    gained = now > before + 1e-3
    level, bank = (gained[:, each] & (ids != each) for each in (ROAD, SHRUB))
    for there, (one, other) in ((level, (ROAD, GRASS)), (bank, (GRASS, SHRUB))):
        before_it, now_it = ((part[:, one] / part[:, other])[there] for part in (before, now))
        torch.testing.assert_close(before_it, now_it, rtol=1e-3, atol=0)
    assert not (level & bank).any()
    return after.argmax(1)[0]


def slowly(ids: torch.Tensor, radius_m: torch.Tensor) -> torch.Tensor:
    """Where a fence is none, (H, W) bool: the definition, pixel by pixel."""
    z_m = radius_m * slopes(VIEW)[:, None]
    flat = torch.zeros(ROWS, COLUMNS, dtype=torch.bool)
    for row in range(ROWS):
        for column in range(COLUMNS):
            for slope, most_m, farthest_m in ((FLAT, LOW_M, NEAR_M), (STEEP, HIGH_M, BANK_M)):
                level = abs(z_m[row, column] + EYE_M) < most_m and radius_m[row, column] < farthest_m
                for other in (max(row - REACH, 0), min(row + REACH, ROWS - 1)):
                    up, away = (abs(part[other, column] - part[row, column]) for part in (z_m, radius_m))
                    level = level and up <= slope * away
                flat[row, column] |= level and ids[row, column] == FENCE
    return mostly(flat, ids == FENCE)


def mostly(flat: torch.Tensor, fence: torch.Tensor) -> torch.Tensor:
    """Where more than half of a fence is flat: of what adjoins in a column, in the mean over the columns around."""
    share = torch.zeros(ROWS, COLUMNS)
    for column in range(COLUMNS):
        for row in range(ROWS):
            first, last = row, row
            while first > 0 and fence[first - 1, column]:
                first -= 1
            while last < ROWS - 1 and fence[last + 1, column]:
                last += 1
            share[row, column] = flat[first : last + 1, column].float().mean() if fence[row, column] else 0
    found = torch.zeros(ROWS, COLUMNS, dtype=torch.bool)
    for column in range(COLUMNS):
        columns = [(column + step) % COLUMNS for step in range(-AROUND, AROUND + 1)]
        count = fence[:, columns].sum(1)
        found[:, column] = fence[:, column] & (share[:, columns].sum(1) > count / 2 + 1e-4)
    return found


def meadow(fence_m: float = math.inf, high_m: float = 1.0) -> torch.Tensor:
    """Horizontal distances (H, W) of level ground up to 60 m, with a fence on it so far away."""
    slope = slopes(VIEW)[:, None].expand(-1, COLUMNS)
    radius_m = torch.where(slope < 0, EYE_M / -slope.clamp(max=-1e-6), math.inf).clamp(max=60)
    stands = (radius_m >= fence_m) & (fence_m * slope + EYE_M < high_m)
    return torch.where(stands, fence_m, radius_m)


def test_a_fence_that_lies_flat_is_ground_down_to_the_last_row():
    radius_m = meadow()
    found = levelled(torch.where(radius_m < NEAR_M, FENCE, WALL), radius_m)
    assert (found != FENCE).all() and (found[-1] != WALL).all()
    assert (levelled(torch.where(radius_m > 4, FENCE, GRASS), radius_m)[0] == FENCE).all(), "most of it is too far away"


def test_a_fence_that_stands_there_stays_down_to_its_foot():
    radius_m = meadow(fence_m=6.0)
    ids = torch.where(radius_m == 6, FENCE, GRASS)
    assert (ids == FENCE).sum() > 2 * COLUMNS, "the test has a fence"
    assert torch.equal(levelled(ids, radius_m), ids)


def bank(rise: float) -> torch.Tensor:
    """Horizontal distances (H, W) of a slope that rises so steeply from the road's edge, 4 m away, on."""
    slope = slopes(VIEW)[:, None].expand(-1, COLUMNS)
    return torch.minimum(meadow(), torch.where(slope < rise, (EYE_M + 4 * rise) / (rise - slope), math.inf)).clamp(
        max=60
    )


def test_a_slope_is_a_bank_and_what_is_steeper_a_fence():
    radius_m = bank(0.8)
    on_it = (radius_m > 4.5) & (radius_m < 7)
    assert on_it.sum() > 5 * COLUMNS
    found = levelled(torch.where(on_it, FENCE, WALL), radius_m)
    assert set(found[on_it].unique().tolist()) == {GRASS, SHRUB}, "as they share what they have"
    radius_m = bank(2.5)
    ids = torch.where((radius_m > 4.3) & (radius_m < 5), FENCE, WALL)
    assert (ids == FENCE).any() and torch.equal(levelled(ids, radius_m), ids)


def test_a_fence_that_is_torn_here_and_there_stays():
    """Stairs between beams, in a few columns: what the columns around say counts."""
    radius_m = meadow(fence_m=6.0)
    ids = torch.where(radius_m == 6, FENCE, GRASS)
    torn = radius_m.clone()
    torn[:, 20:24] = meadow()[:, 20:24]
    assert torch.equal(levelled(ids, torn), ids)
    torn[:, 5:45] = meadow()[:, 5:45]
    assert (levelled(ids, torn)[:, 15:35] != FENCE).all()


def test_what_lies_higher_is_left_alone():
    """Level ground above the road's: up to HIGH_M it may be a bank's top."""
    for above_m, classes in ((LOW_M + 0.1, {GRASS, SHRUB}), (HIGH_M + 0.1, {FENCE})):
        radius_m = torch.full((ROWS, COLUMNS), 60.0)
        slope = slopes(VIEW)[:, None].expand(-1, COLUMNS)
        level = (slope * (above_m - EYE_M) > 0) & ((above_m - EYE_M) / slope < 20)
        radius_m = torch.where(level, (above_m - EYE_M) / slope, radius_m)
        assert level.sum() > 5 * COLUMNS
        inner = level & level.roll(REACH, 0) & level.roll(-REACH, 0)
        found = levelled(torch.where(inner, FENCE, WALL), radius_m)
        assert set(found[inner].unique().tolist()) == classes


@pytest.mark.parametrize("seed", [1, 2])
def test_uneven_ground_is_levelled_as_defined(seed):
    generator = torch.Generator().manual_seed(seed)
    radius_m = meadow(fence_m=9.0) * torch.exp(0.05 * torch.randn(ROWS, COLUMNS, generator=generator))
    ids = torch.where(torch.rand(ROWS, COLUMNS, generator=generator) < 0.5, FENCE, WALL)
    flat = slowly(ids, radius_m)
    assert 100 < flat.sum() < (ids == FENCE).sum() - 100
    assert torch.equal(levelled(ids, radius_m) != FENCE, flat | (ids != FENCE))
