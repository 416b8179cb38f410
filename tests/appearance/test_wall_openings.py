"""Windows and doors that hang on walls."""

from __future__ import annotations

import math

import numpy as np
import torch

from lidar2pano.appearance import invented_textures as subject
from lidar2pano.appearance.invented_textures import (
    BAR_M,
    COOLEST,
    HOUSE_M,
    NO_MULLION,
    NO_TRANSOM,
    WARMEST,
    YELLOW,
    Walls,
    facades,
)
from lidar2pano.scene.surfaces import azimuths, slopes
from lidar2pano.views import VIEWS

VIEW = VIEWS["panorama"].scaled(0.5)
ROAD_Z_M = -1.73


def street(
    x: float = 0.0, y: float = 0.0, turn: float = 0.0
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, np.ndarray]:
    """A street between walls at y = 7 m and y = -9 m: `facades`' arguments but for the view."""
    angle = azimuths(VIEW) + turn
    left, right = (7 - y) / angle.sin(), (-9 - y) / angle.sin()
    radius = torch.where(left > 0, left, right).clamp(max=200).float()
    radius_m = radius.expand(1, VIEW.rows, VIEW.columns)
    above_m = torch.tensor([VIEW.origin[2] - ROAD_Z_M])
    height_m = radius_m * slopes(VIEW)[:, None] + above_m
    walls = ((height_m > 0) & (radius_m < 100)).float()
    c, s = math.cos(turn), math.sin(turn)
    pose = np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    pose[:3, 3] -= pose[:3, :3] @ np.array(VIEW.origin)  # x and y are the view's place
    pose[2, 3] = 0
    return walls, radius_m, above_m, pose


def left_wall(x: float, y: float, turn: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Openings of the wall on the left, and the places in the world (x, height) that the pixels show."""
    walls, radius_m, above_m, pose = street(x, y, turn)
    found = facades(walls, radius_m, above_m, VIEW, pose).openings[0]
    height_m = radius_m * slopes(VIEW)[:, None] + above_m
    angle = azimuths(VIEW) + turn
    ahead = (radius_m[0] * angle.cos() + x).float()
    near = (angle.sin() > 0.6).expand_as(found)
    return found[near], ahead[near], height_m[0][near]


def test_openings_stay_where_they_are_when_the_sensor_moves():
    grids = []
    for place in ((0.0, 0.0, 0.0), (1.5, 0.5, 0.0), (-0.7, -1.0, 0.3)):
        openings, ahead, height = left_wall(*place)
        grid = torch.full((60, 30), torch.nan)  # 10 cm
        column, row = ((ahead + 3) * 10).floor().long(), (height * 10).floor().long()
        inside = (column >= 0) & (column < 60) & (row >= 0) & (row < 30) & ((openings - 0.5).abs() > 0.45)
        grid[column[inside], row[inside]] = openings[inside].round()
        grids.append(grid)
    for other in grids[1:]:
        both = grids[0].isfinite() & other.isfinite()
        assert both.sum() > 400
        assert (grids[0] == other)[both].float().mean() > 0.93
        assert 0.1 < grids[0][both].mean() < 0.6, "there are openings, and there is wall"


def test_turning_by_whole_columns_turns_the_answer():
    walls, radius_m, above_m, pose = street()
    columns = 96
    angle = 2 * math.pi * columns / VIEW.columns
    turned = pose @ np.array(
        [
            [math.cos(angle), -math.sin(angle), 0, 0],
            [math.sin(angle), math.cos(angle), 0, 0],
            [0, 0, 1, 0],
            [0, 0, 0, 1.0],
        ]
    )
    origin = np.array([*VIEW.origin, 1.0])
    turned[:3, 3] += (pose @ origin - turned @ origin)[:3]  # about the view's axis
    straight = facades(walls, radius_m, above_m, VIEW, pose)
    other = facades(*(part.roll(columns, 2) for part in (walls, radius_m)), above_m, VIEW, turned)
    same = (straight.openings.roll(columns, 2) - other.openings).abs() < 0.02
    assert same.float().mean() > 0.99
    assert (straight.tone.roll(columns, 2) == other.tone).float().mean() > 0.98


def test_where_nothing_is_a_wall_nothing_opens():
    walls, radius_m, above_m, pose = street()
    assert not facades(torch.zeros_like(walls), radius_m, above_m, VIEW, pose).openings.any()
    whole, likely, unlikely = (facades(walls * p, radius_m, above_m, VIEW, pose).openings for p in (1, 0.6, 0.25))
    assert ((whole - likely).abs() < 0.02).float().mean() > 0.99, (
        "where it is likelier than all others it has whole windows"
    )
    assert unlikely.max() <= 0.5 and unlikely.isfinite().all()


def test_what_stands_before_or_behind_a_wall_has_no_openings():
    walls, radius_m, above_m, pose = street()
    behind = radius_m.clone()
    behind[:, :20] *= 2
    found = facades(walls, behind, above_m, VIEW, pose).openings
    assert not found[:, :20].any() and found[:, 20:].any()


def test_houses_have_one_tone_each():
    tone = facades(*street()[:3], VIEW).tone[0]
    grey, warm = (tone[0] + tone[2]) / 2, (tone[0] - tone[2]) / 2
    assert grey.abs().max() <= 1 and grey.std() > 0.3
    assert warm.min() >= COOLEST - 1e-6 and warm.max() <= WARMEST + 1e-6 and warm.std() > 0.02
    assert torch.allclose(tone[1], grey + YELLOW * warm, atol=1e-6)
    assert (tone[:, 1:] != tone[:, :-1]).any(0).sum() < 60


def test_houses_that_face_each_other_differ():
    """Left and right at the same place along the street: other tones, and with a sensor at the origin light ones."""
    tone = facades(*street()[:3], VIEW).tone[0, 1]
    angle = azimuths(VIEW)
    left, right = (tone[int((angle - math.radians(at)).abs().argmin())] for at in (75, -75))
    assert left != right and left > 0 and right > 0


def uniform(house: int, which: int) -> float:
    return mixed(house * 31 + which * 0x1B873593 + 1) / 0x80000000


def mixed(number: int) -> int:
    number &= 0x7FFFFFFF
    number = ((number ^ (number >> 15)) * 0x2C1B3C6D) & 0x7FFFFFFF
    number = ((number ^ (number >> 12)) * 0x297A2D39) & 0x7FFFFFFF
    return number ^ (number >> 15)


def opening(house: int, along: float, level: float) -> bool:
    """Whether a place on a wall is a pane or a door, of `_openings` without its soft edges."""
    storey, base = 2.6 + 0.7 * uniform(house, 1), 0.1 + 0.7 * uniform(house, 6)
    count = math.floor(3 + 3 * uniform(house, 4))
    window, floor = math.floor(along / (HOUSE_M / count)), math.floor((level - base) / storey)
    if not 0 <= floor < math.floor(2 + 3 * uniform(house, 8)) or uniform(mixed(house + window * 7 + 1), 0) <= 0.1:
        return False
    middle, tall = 0.7 + 0.4 * uniform(house, 2), 1.1 + 0.5 * uniform(house, 3)
    middle += tall / 2
    divided = uniform(house, 10) >= NO_MULLION, uniform(house, 11) >= NO_TRANSOM
    if floor == 0 and window == math.floor(count * uniform(house, 7)):
        middle, tall, divided = 1.0, 2.1, (False, False)
    up, aside = level - base - floor * storey - middle, along - (window + 0.5) * HOUSE_M / count
    bar = (divided[0] and abs(aside) < BAR_M / 2) or (divided[1] and abs(up - tall / 6) < BAR_M / 2)
    return abs(up) < tall / 2 and abs(aside) < (0.9 + 0.6 * uniform(house, 5)) / 2 and not bar


def test_bars_are_of_their_width_and_those_too_fine_fade_out():
    middle_m = torch.linspace(-0.5, 0.5, 2001)
    for pixel_m, expected in ((0.01, 1.0), (0.04, 1.0), (0.05, 0.6), (0.08, 0.0), (0.2, 0.0)):
        share = subject._bar(middle_m, torch.tensor(pixel_m))
        assert math.isclose(float(share.mean()) * 1.0005, expected * BAR_M, abs_tol=1e-3)
        assert share.max() <= 1 and not share[middle_m.abs() > (BAR_M + pixel_m) / 2].any()


def test_openings_agree_with_their_definition():
    generator = torch.Generator().manual_seed(3)
    house = torch.randint(0, 2**31, (1, 300), generator=generator)
    along, level = (
        HOUSE_M * torch.rand(1, 300, generator=generator),
        12 * torch.rand(1, 40, 300, generator=generator) - 1,
    )
    walls = Walls(torch.full((1, 300), 3.0), along, torch.full((1, 300), 1e-3), house)
    found = subject._openings(walls, level, VIEW)[0]
    clear = (found < 0.01) | (found > 0.99)
    expected = torch.tensor(
        [[opening(int(house[0, j]), float(along[0, j]), float(level[0, i, j])) for j in range(300)] for i in range(40)]
    )
    assert clear.float().mean() > 0.95 and 0.1 < expected.float().mean() < 0.5
    assert torch.equal(found[clear] > 0.5, expected[clear])
