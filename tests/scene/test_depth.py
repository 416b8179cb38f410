"""Depths that keep to what was measured: on walls, on the road, between surfaces and above the highest beam."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lidar2pano.geometry.projection import directions
from lidar2pano.labels import COMMON15
from lidar2pano.scene import depth as module
from lidar2pano.scene.depth import measured_depth
from lidar2pano.scene.surfaces import ROAD_Z_M, SAME_SURFACE, cylinder_points, slopes
from lidar2pano.views import View

ROAD, TREE, WALL, SKY = map(COMMON15.id_of, ("road", "vegetation", "building", "sky"))
ROWS, COLUMNS = 48, 360
VIEW = View(rows=ROWS, columns=COLUMNS, up=0.24, down=-0.28, kind="cylinder", origin=(0.3, 0.1, -0.1))
RINGS = slice(12, None, 3)  # rows that are measured: none above
HEIGHT_M = VIEW.origin[2] - ROAD_Z_M


def channels_of(depth_m: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
    """Channels (1, 5, H, W) of a range image in which some pixels (H, W) bool of depths (H, W) were measured."""
    points = directions(VIEW) * depth_m[..., None]
    return torch.cat([depth_m[None], points.movedim(2, 0), torch.full_like(depth_m, 0.3)[None]])[None] * measured


def along_rays(radius_m: torch.Tensor) -> torch.Tensor:
    return radius_m * torch.sqrt(1 + slopes(VIEW)[:, None].square())


def street(wall_m: float = 8.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Depths and classes (H, W) of a flat road with a wall all around."""
    road_m = torch.where(slopes(VIEW) < 0, -HEIGHT_M / slopes(VIEW), torch.inf)[:, None].expand(ROWS, COLUMNS)
    return along_rays(road_m.clamp(max=wall_m)), torch.where(road_m < wall_m, ROAD, WALL)


def rings() -> torch.Tensor:
    measured = torch.zeros(ROWS, COLUMNS, dtype=torch.bool)
    measured[RINGS] = True
    return measured


def found(guess_m: torch.Tensor, channels: torch.Tensor, ids: torch.Tensor) -> torch.Tensor:
    return measured_depth(guess_m[None], channels, ids[None], torch.tensor([HEIGHT_M]), VIEW)[0]


def random_scene() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A guess, channels and classes in which anything may be beside anything."""
    generator = torch.Generator().manual_seed(5)
    true_m = 3 + 40 * torch.rand(ROWS // 8, COLUMNS // 6, generator=generator).repeat_interleave(8, 0)
    true_m = true_m.repeat_interleave(6, 1)
    guess_m = true_m * torch.exp(0.2 * torch.randn(ROWS, COLUMNS, generator=generator))
    measured = torch.rand(ROWS, COLUMNS, generator=generator) < 0.2
    measured[:10], measured[:, 100:110] = False, False
    drawn = torch.randint(0, 4, (ROWS // 8, COLUMNS // 6), generator=generator).repeat_interleave(8, 0)
    ids = torch.tensor([ROAD, TREE, WALL, SKY])[drawn]
    return guess_m, channels_of(true_m, measured), ids.repeat_interleave(6, 1)


class Slow:
    """The definition, pixel by pixel, but for the mean at the end (`evened_slowly`): inverse horizontal distances."""

    def __init__(self, guess_m: torch.Tensor, channels: torch.Tensor, ids: torch.Tensor) -> None:
        radius_m = cylinder_points(guess_m[None], VIEW)[0][0]
        self.plane = [max(-slope / HEIGHT_M, 1 / 1000) for slope in slopes(VIEW).tolist()]
        self.flat = torch.hypot(channels[0, 1], channels[0, 2]).double().numpy()
        self.guess, self.ids = (1 / radius_m.double()).numpy(), ids
        self.tops = [self.topmost(column) for column in range(COLUMNS)]

    def topmost(self, column: int) -> tuple[int, float] | None:
        """The first row of a point of a column or its neighbours, and the inverse distance."""
        for row in range(ROWS):
            for away in range(module.TOPMOST_PX + 1):
                beside = [self.flat[row, (column + step) % COLUMNS] for step in (-away, away)]
                if any(beside):
                    return row, 1 / min(each for each in beside if each)
        return None

    def surface(self, row: int, column: int, at: int) -> float:
        """What was met in `row`, seen in the row `at`: level if it is road, else upright."""
        inverse = 1 / self.flat[row, column]
        lift = inverse / self.plane[row]
        return self.plane[at] * lift if 1 / module.ON_GROUND < lift < module.ON_GROUND else inverse

    def over(self, row: int, column: int) -> float:
        """Above a column's points."""
        top = self.tops[column]
        if not top or self.ids[row, column] != self.ids[top[0], column]:
            return self.guess[row, column]
        if self.ids[row, column] != TREE:
            return top[1]
        around = [at % COLUMNS for at in range(column - module.CROWN_PX, column + module.CROWN_PX + 1)]
        near = [(one, at) for at in around if (one := self.tops[at])]
        mean = float(np.mean([one[1] for one, at in near if self.ids[one[0], at] == TREE]))
        return mean * (self.guess[row, column] / mean) ** module.CROWN_GUESSED

    def between(self, row: int, column: int, first: int, last: int) -> float:
        """Between the points of two rows of a column."""
        upper, lower = 1 / self.flat[first, column], 1 / self.flat[last, column]
        if max(upper, lower) < SAME_SURFACE * min(upper, lower):
            return upper + (lower - upper) * (row - first) / max(last - first, 1)
        along = self.surface(last, column, row)
        return min((upper, along), key=lambda each: abs(np.log(self.guess[row, column] / each)))

    def __call__(self, row: int, column: int) -> float:
        """Anywhere."""
        rows = np.flatnonzero(self.flat[:, column])
        above, below = rows[rows <= row], rows[rows >= row]
        if not len(above):
            return self.over(row, column)
        if not len(below):
            return max(self.surface(above[-1], column, row), self.plane[row])
        return self.between(row, column, above[-1], below[0])


def evened_slowly(inverse: np.ndarray) -> np.ndarray:
    """Means over opposite pixels that are on one plane with what lies between them: down the rows, then along them."""
    for axis in (0, 1):
        out = inverse.copy()
        for row in range(ROWS):
            for column in range(COLUMNS):
                kept = [inverse[row, column]]
                for away in module.EVEN_PX:
                    if axis == 0 and not away <= row < ROWS - away:
                        continue
                    step = np.array([away, 0] if axis == 0 else [0, away])
                    ends = [np.array([row, column]) + step, np.array([row, column]) - step]
                    mean = np.mean([inverse[at[0], at[1] % COLUMNS] for at in ends])
                    if abs(mean - inverse[row, column]) < module.ON_PLANE * inverse[row, column]:
                        kept.append(mean)
                out[row, column] = np.mean(kept)
        inverse = out
    return inverse


def test_depths_agree_with_their_definition():
    scene = random_scene()
    slow = Slow(*scene)
    inverse = np.array([[slow(row, column) for column in range(COLUMNS)] for row in range(ROWS)])
    expected = along_rays(1 / torch.from_numpy(evened_slowly(inverse)))
    off = (found(*scene).double() / expected).log().abs()
    assert (off < 1e-4).double().mean() > 0.999, "but where rounding decides on which side of a limit a pixel is"


def test_what_was_measured_stays():
    guess_m, channels, ids = random_scene()
    measured = channels[0, 0] > 0
    ratio = found(guess_m, channels, ids)[measured] / channels[0, 0][measured]
    assert (ratio.log().abs() < 2 * module.ON_PLANE).all()
    assert (guess_m[measured] / channels[0, 0][measured]).log().abs().max() > 0.5, "the guess is far off"


def test_a_wavy_guess_becomes_the_street_that_was_measured():
    true_m, ids = street()
    waves = 1 + 0.25 * torch.sin(torch.arange(ROWS) * 2.1)[:, None] * torch.cos(torch.arange(COLUMNS) * 0.7)
    depth_m = found(true_m * waves, channels_of(true_m, rings()), ids)
    off = (depth_m / true_m).log().abs()
    assert off[: RINGS.start].max() < 1e-4, "the wall goes on above the highest ring"
    kerb = (ids != ids.roll(1, 0)).any(1).nonzero().max()
    away = (torch.arange(ROWS) - kerb).abs() > 5
    assert off[away].max() < 1e-3
    assert off.max() < 0.1, "between the last ring on the road and the first on the wall"


def test_above_the_highest_ring_other_classes_keep_the_guess():
    true_m, ids = street()
    ids[:4] = SKY
    depth_m = found(torch.full_like(true_m, 30.0), channels_of(true_m, rings()), ids)
    assert torch.allclose(depth_m[:4], torch.tensor(30.0), rtol=1e-3) and (depth_m[4:12] < 10).all()


def test_a_crown_stands_above_its_own_points_on_average():
    true_m, ids = street()
    ids[ids == WALL] = TREE
    generator = torch.Generator().manual_seed(2)
    true_m[:24] *= torch.exp(0.1 * torch.randn(24, COLUMNS, generator=generator))
    crown = found(true_m, channels_of(true_m, rings()), ids)[0]
    assert crown.log().std() < 0.05 < true_m[RINGS.start].log().std()
    assert crown.mean() == pytest.approx(along_rays(torch.full((ROWS, 1), 8.0))[0, 0].item(), rel=0.05)


def test_a_guess_draws_crowns_a_little_and_walls_not():
    true_m, ids = street()
    channels = channels_of(true_m, rings())
    ids[:, :180] = torch.where(ids[:, :180] == WALL, TREE, ids[:, :180])
    ratio = (found(true_m / 2, channels, ids) / true_m)[: RINGS.start].log2()
    assert torch.allclose(ratio[:, 20:160], torch.tensor(-module.CROWN_GUESSED), atol=1e-3)
    assert ratio[:, 200:340].abs().max() < 1e-3


def test_between_two_surfaces_the_guess_decides():
    column, upper, lower = 50, 20.0, 5.0
    measured = torch.zeros(ROWS, COLUMNS, dtype=torch.bool)
    measured[[14, 28], column] = True
    true_m = torch.full((ROWS, COLUMNS), upper)
    true_m[28] = lower
    guess_m = torch.full((ROWS, COLUMNS), upper)
    guess_m[20:] = 6.0
    ids = torch.full((ROWS, COLUMNS), WALL)
    radius_m = cylinder_points(found(guess_m, channels_of(true_m, measured), ids)[None], VIEW)[0][0, :, column]
    expected = cylinder_points(true_m[None], VIEW)[0][0]
    assert torch.allclose(radius_m[14:20], expected[14, column], rtol=0.01)
    assert torch.allclose(radius_m[20:29], expected[28, column], rtol=0.01)


def test_columns_without_points_keep_the_guess():
    guess_m = 3 + 20 * torch.rand(ROWS, COLUMNS, generator=torch.Generator().manual_seed(3))
    nothing = torch.zeros(1, 5, ROWS, COLUMNS)
    depth_m = found(guess_m, nothing, torch.full((ROWS, COLUMNS), WALL))
    assert torch.allclose(depth_m, guess_m, rtol=module.ON_PLANE)


def test_it_turns_with_the_scene():
    guess_m, channels, ids = random_scene()
    turned = found(guess_m.roll(37, 1), channels.roll(37, 3), ids.roll(37, 1))
    assert torch.allclose(turned, found(guess_m, channels, ids).roll(37, 1), rtol=1e-5)


def test_a_sphere_and_few_rows_go_through():
    sphere = View(rows=12, columns=72, up=10, down=-20)
    depth_m = torch.rand(1, 12, 72) + 3
    ids, channels = torch.zeros(1, 12, 72, dtype=torch.long), torch.zeros(1, 5, 12, 72)
    assert torch.equal(measured_depth(depth_m, channels, ids, torch.tensor([1.7]), sphere), depth_m)
    low = View(rows=5, columns=72, up=0.2, down=-0.2, kind="cylinder")
    few = measured_depth(depth_m[:, :5], channels[:, :, :5], ids[:, :5], torch.tensor([1.7]), low)
    assert torch.allclose(few, depth_m[:, :5], rtol=module.ON_PLANE)
