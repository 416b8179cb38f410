"""Walls are building from the roof to the foot; fences stay fences."""

from __future__ import annotations

import torch

from lidar2pano.geometry.surface import slopes
from lidar2pano.geometry.whole_walls import TALL_M, whole_walls
from lidar2pano.views import View

ROAD, WALL, FENCE, TREE = range(4)
ROWS, COLUMNS, EYE_M = 60, 90, 1.73  # height of the sensor above the road
VIEW = View(rows=ROWS, columns=COLUMNS, up=0.5, down=-0.3, kind="cylinder")


def scene(ids: torch.Tensor, radius_m: torch.Tensor) -> torch.Tensor:
    """Ids (H, W) of the panorama with whole walls, made of ids and horizontal distances."""
    generator = torch.Generator().manual_seed(1)
    logits = torch.rand(1, 4, ROWS, COLUMNS, generator=generator)
    logits += 5 * torch.nn.functional.one_hot(ids, 4).movedim(2, 0)
    after = logits.clone()
    whole_walls(after, ids[None], radius_m[None], (radius_m * slopes(VIEW)[:, None] + EYE_M)[None], WALL, FENCE)
    before, now = logits.softmax(1), after.softmax(1)
    assert torch.equal(after[:, [ROAD, TREE]], logits[:, [ROAD, TREE]])
    assert torch.allclose(before[:, WALL] + before[:, FENCE], now[:, WALL] + now[:, FENCE], atol=1e-5)
    return after.argmax(1)[0]


def wall_on_fence(far_m: float = 8.0, fence_m: float = 8.0, top: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """A fence in the lower half, building above it up to the row `top`, trees above that."""
    ids = torch.full((ROWS, COLUMNS), WALL)
    ids[:top], ids[ROWS // 2 :] = TREE, FENCE
    radius_m = torch.full((ROWS, COLUMNS), far_m)
    radius_m[ROWS // 2 :] = fence_m
    return ids, radius_m


def test_what_carries_a_building_is_building():
    ids = scene(*wall_on_fence())
    assert (ids == WALL).all()


def test_a_fence_before_a_building_stays():
    ids, radius_m = wall_on_fence(far_m=12, fence_m=8)
    assert torch.equal(scene(ids, radius_m), ids)


def test_a_low_wall_beside_a_fence_stays():
    height = 8.0 * slopes(VIEW) + EYE_M
    ids, radius_m = wall_on_fence(top=int((height > TALL_M).sum()))
    assert torch.equal(scene(ids, radius_m), ids)
    ids, radius_m = wall_on_fence(top=int((height > TALL_M).sum()) - 1)
    assert (scene(ids, radius_m) != FENCE).all(), "one row higher it is a house"


def test_a_tree_parts_what_is_below_it_from_the_wall():
    ids, radius_m = wall_on_fence()
    ids[ROWS // 2 - 3 : ROWS // 2, 40:50] = TREE
    found = scene(ids, radius_m)
    assert torch.equal(found[:, 40:50], ids[:, 40:50]) and (found[:, 50:] == WALL).all()


def test_a_wall_far_off_may_come_nearer_bit_by_bit():
    ids, radius_m = wall_on_fence()
    radius_m *= torch.exp(-0.05 * torch.arange(ROWS))[:, None]
    assert (scene(ids, radius_m) == WALL).all()
