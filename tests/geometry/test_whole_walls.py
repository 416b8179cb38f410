"""Walls are building from the roof to the foot; fences stay fences; no surface has patches."""

from __future__ import annotations

import torch

from lidar2pano.geometry.surface import slopes
from lidar2pano.geometry.whole_walls import LORRY_M, ONE_WALL, TALL_M, no_patches, whole_walls
from lidar2pano.views import View

ROAD, WALL, FENCE, TREE, CAR, LORRY = range(6)
ROWS, COLUMNS, EYE_M = 60, 90, 1.73  # height of the sensor above the road
TOP = 40  # row from which on a fence is
VIEW = View(rows=ROWS, columns=COLUMNS, up=0.5, down=-0.3, kind="cylinder")


def scene(ids: torch.Tensor, radius_m: torch.Tensor) -> torch.Tensor:
    """Ids (H, W) of the panorama with whole walls, made of ids and horizontal distances."""
    generator = torch.Generator().manual_seed(1)
    logits = torch.rand(1, 6, ROWS, COLUMNS, generator=generator)
    logits += 5 * torch.nn.functional.one_hot(ids, 6).movedim(2, 0)
    after, height_m = logits.clone(), (radius_m * slopes(VIEW)[:, None] + EYE_M)[None]
    whole_walls(after, ids[None], radius_m[None], height_m, WALL, FENCE, [CAR, LORRY])
    before, now = logits.softmax(1), after.softmax(1)
    assert torch.equal(after[:, [ROAD, TREE]], logits[:, [ROAD, TREE]])
    assert torch.allclose(before[:, WALL] + before[:, FENCE], now[:, WALL] + now[:, FENCE], atol=1e-5)
    return after.argmax(1)[0]


def wall_on_fence(far_m: float = 8.0, fence_m: float = 8.0, top: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """A fence from the row TOP on, building above it up to the row `top`, trees above that."""
    ids = torch.full((ROWS, COLUMNS), WALL)
    ids[:top], ids[TOP:] = TREE, FENCE
    radius_m = torch.full((ROWS, COLUMNS), far_m)
    radius_m[TOP:] = fence_m
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
    ids[TOP - 3 : TOP, 40:50] = TREE
    found = scene(ids, radius_m)
    assert torch.equal(found[:, 40:50], ids[:, 40:50]) and (found[:, 50:] == WALL).all()


def test_a_wall_far_off_may_come_nearer_bit_by_bit():
    ids, radius_m = wall_on_fence()
    radius_m *= torch.exp(-0.05 * torch.arange(ROWS))[:, None]
    assert (scene(ids, radius_m) == WALL).all()


def with_vehicles(ids: torch.Tensor, radius_m: torch.Tensor) -> torch.Tensor:
    """Ids (H, W) of a panorama of six classes with whole walls."""
    logits = 5.0 * torch.nn.functional.one_hot(ids, 6).movedim(2, 0)[None]
    height_m = (radius_m * slopes(VIEW)[:, None] + EYE_M)[None]
    before = logits.softmax(1)
    whole_walls(logits, ids[None], radius_m[None], height_m, WALL, FENCE, [CAR, LORRY])
    shares = logits.softmax(1)
    torch.testing.assert_close(shares.sum(1), torch.ones_like(shares[:, 0]))
    moved = [WALL, FENCE, CAR, LORRY]
    torch.testing.assert_close(shares[:, moved].sum(1), before[:, moved].sum(1))
    return logits.argmax(1)[0]


def test_a_lorry_is_no_taller_than_lorries_are():
    height_m = 8.0 * slopes(VIEW) + EYE_M
    radius_m = torch.full((ROWS, COLUMNS), 8.0)
    ids = torch.full((ROWS, COLUMNS), LORRY)
    ids[:, 50:] = torch.where(height_m[:, None] < LORRY_M, LORRY, TREE)
    ids[height_m < 0.2] = ROAD
    found = with_vehicles(ids, radius_m)
    assert (height_m > LORRY_M).any() and (found[:, :50] == ids[:, :50]).sum() == (ids[:, :50] == ROAD).sum()
    assert torch.equal(found[:, 50:], ids[:, 50:]), "and what is a lorry up to there stays one"


def lorry_on_wall(wall_m: float = 3.0, below: int = WALL) -> tuple[torch.Tensor, torch.Tensor]:
    """A lorry 3 m away between two rows, wall above it and, 20 rows of it, below; the road at the foot."""
    ids = torch.full((ROWS, COLUMNS), WALL)
    ids[20:30, 30:60], ids[30:50], ids[50:] = LORRY, below, ROAD
    radius_m = torch.full((ROWS, COLUMNS), 3.0)
    radius_m[30:50] = wall_m
    return ids, radius_m


def test_a_lorry_on_a_wall_is_wall():
    found = with_vehicles(*lorry_on_wall())
    assert (found[:50] == WALL).all() and (found[50:] == ROAD).all()


def test_what_stands_on_the_road_or_behind_a_wall_stays():
    on_road, behind = lorry_on_wall(below=ROAD), lorry_on_wall(wall_m=2.0)
    for ids, radius_m in (on_road, behind):
        assert torch.equal(with_vehicles(ids, radius_m), ids)


def marked_along(ids: torch.Tensor, radius_m: torch.Tensor, start: torch.Tensor, solid: set[int], step: int):
    """Whether a pixel (H, W), or one before it on the way by `step` that it is joined to, is in `start`."""
    found = torch.zeros_like(start)
    for column in range(COLUMNS):
        on = False
        for row in range(ROWS)[::step]:
            before = row - step
            joined = 0 <= before < ROWS and {int(ids[row, column]), int(ids[before, column])} <= solid
            if joined:
                joined = abs(float((radius_m[before, column] / radius_m[row, column]).log())) < ONE_WALL
            on = bool(start[row, column]) or (joined and on)
            found[row, column] = on
    return found


def test_whole_walls_as_defined():
    generator = torch.Generator().manual_seed(2)
    ids = torch.randint(6, (ROWS, COLUMNS), generator=generator)
    ids = torch.where(torch.rand(ROWS, COLUMNS, generator=generator) < 0.8, ids.clamp(min=CAR), ids)
    radius_m = 8 * torch.exp(0.06 * torch.randn(ROWS, COLUMNS, generator=generator))
    expected, height_m = ids.clone(), radius_m * slopes(VIEW)[:, None] + EYE_M
    stands = marked_along(ids, radius_m, ids == WALL, {WALL, FENCE, CAR, LORRY}, -1)
    solid, above = {WALL, FENCE, CAR, LORRY}, (ids != ROAD) & (ids != TREE) & (height_m > LORRY_M)
    stands |= marked_along(ids, radius_m, above, solid, 1)
    expected[stands & ((ids == CAR) | (ids == LORRY))] = WALL
    carries = marked_along(expected, radius_m, (expected == WALL) & (height_m > TALL_M), {WALL, FENCE}, 1)
    expected[carries & (ids == FENCE)] = WALL
    found = with_vehicles(ids, radius_m)
    assert torch.equal(found, expected)
    for each in (FENCE, CAR, LORRY):
        assert {WALL, each} <= set(expected[ids == each].tolist()), "some are wall, and some are not"


def without_patches(ids: torch.Tensor, radius_m: torch.Tensor) -> torch.Tensor:
    """Ids (H, W) of a panorama of six classes without trees and fences within walls and fences within trees."""
    logits = 5.0 * torch.nn.functional.one_hot(ids, 6).movedim(2, 0)[None]
    no_patches(logits, ids[None], radius_m[None], [(TREE, WALL), (FENCE, WALL), (FENCE, TREE)])
    shares = logits.softmax(1)
    torch.testing.assert_close(shares.sum(1), torch.ones_like(shares[:, 0]))
    return logits.argmax(1)[0]


def test_foliage_within_a_wall_is_wall_and_before_it_stays():
    ids, radius_m = torch.full((ROWS, COLUMNS), WALL), torch.full((ROWS, COLUMNS), 8.0)
    ids[20:30, 40:50], ids[30:, 60:70], ids[:20, 75:] = TREE, TREE, TREE
    found = without_patches(ids, radius_m)
    assert (found[:, 40:50] == WALL).all(), "wall above and below"
    assert torch.equal(found[:, 50:], ids[:, 50:]), "from the road or the sky on it is a tree"
    radius_m[20:30, 40:50] = 6.0
    assert torch.equal(without_patches(ids, radius_m), ids)


def test_patches_as_defined():
    generator = torch.Generator().manual_seed(4)
    ids = torch.randint(WALL, CAR, (ROWS, COLUMNS), generator=generator)
    radius_m = 8 * torch.exp(0.05 * torch.randn(ROWS, COLUMNS, generator=generator))
    expected = ids.clone()
    for row in range(ROWS):
        for column in range(COLUMNS):
            within, ends = {TREE: [WALL], FENCE: [WALL, TREE]}.get(int(ids[row, column]), []), []
            for step in (-1, 1):
                at = row
                while ids[at, column] == ids[row, column] and 0 <= at + step < ROWS:
                    at += step
                    if abs(float((radius_m[at, column] / radius_m[at - step, column]).log())) >= ONE_WALL:
                        break
                else:
                    ends.append(int(ids[at, column]))
            if len(ends) == 2 and ends[0] == ends[1] and ends[0] in within:
                expected[row, column] = ends[0]
    assert torch.equal(without_patches(ids, radius_m), expected)
    assert {(TREE, WALL), (FENCE, WALL), (FENCE, TREE)} <= set(
        zip(ids[expected != ids].tolist(), expected[expected != ids].tolist(), strict=True)
    )
