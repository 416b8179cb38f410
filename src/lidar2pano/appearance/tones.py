"""Invented colours: facades with windows and doors, houses of several paints, trees in the sun, clothes, signs.

A scan measures where walls stand, and its classes say that they are walls; it hardly shows their colours. Every wall is
divided into houses, floors and windows, at random but always alike: an opening's place depends on the place in space
alone, as with `solid_noise`. Grammars of facades are Mueller et al.'s (2006); this is their simplest case.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d, one_hot, pad

from lidar2pano.appearance.columns import pixel_share, surface_profile
from lidar2pano.labels import COMMON15
from lidar2pano.scene.surfaces import slopes, world_columns
from lidar2pano.views import View

REACH = 40  # columns at each side whose walls say how a wall runs
SAME_WALL = 0.25  # relative difference of the distances of what still belongs to the same wall
FARTHEST_M = 60.0  # walls beyond show no windows
LOWEST_M, HIGHEST_M = 0.5, 9.0  # heights above the road at which the distance of a wall is read
DIRECTIONS = 8  # in which walls run, per half turn: rounded, so that windows stand still while estimates waver
HOUSE_M = 11.0  # width of a house
COOLEST, WARMEST = -0.05, 0.25  # how much redder and less blue than grey houses are: plaster, sandstone, brick
YELLOW = 0.4  # how much greener they are, of that
EVERY = 4  # rows of a raster for each that distances are read from
LEAST = 0.3  # rows of a column that show a wall; with fewer the column has none
BAR_M = 0.08  # width of mullions and transoms, which divide windows into panes
NO_MULLION, NO_TRANSOM = 0.25, 0.4  # share of houses whose windows have none
# Openings are whole where a wall is the likeliest: the classes' noise made slats of panes.
WALL_SHARE = 2.0
AWAY = 1 << 20  # houses; keeps their numbers positive
DRAWN = 10_000_030  # which houses there are: with these, the ones beside a sensor whose pose is not known are light
LEGS_M, HEAD_M, HAIR_M = 0.85, 1.45, 1.66  # where legs, trunk and face end
# Red, green and blue in [-1, 1], less those of the mean person; outfits beside each other are blended.
TOPS = (
    (-0.25, -0.25, -0.2),
    (0.1, -0.15, -0.15),
    (0.5, 0.5, 0.48),
    (0.05, 0.1, 0.3),
    (0.2, 0.2, 0.2),
    (-0.1, 0.0, -0.12),
)
TROUSERS = (
    (-0.15, -0.08, 0.1),
    (-0.3, -0.3, -0.3),
    (-0.12, -0.06, 0.12),
    (0.08, 0.03, -0.06),
    (-0.3, -0.3, -0.28),
    (-0.15, -0.08, 0.08),
)
# Likewise, less the mean sign: the back, which is grey, yellow, white, blue, and grey again. (Red ones were lollipops.)
SIGNS = ((0.1, 0.1, 0.05), (0.6, 0.45, -0.2), (0.6, 0.6, 0.55), (-0.25, -0.05, 0.4), (0.1, 0.1, 0.05))
SKIN, HAIR = (0.4, 0.22, 0.12), (-0.3, -0.32, -0.34)
NAMES = ("building", "person", "traffic-sign", "vegetation")
BUILDING, PERSON, SIGN, VEGETATION = map(COMMON15.id_of, NAMES)
# Half of the deviations from image to image of how bright a class is in KITTI, colours in [-1, 1]: all of them, and
# what noise has beyond its deviation, burn things out.
VARIED = dict.fromkeys(("car", "truck", "other-vehicle", "fence"), 0.15) | {"pole": 0.1}
# How much brighter than the mean trees are in the sun of a painter that has one: up to LIT_M, and none at twice that,
# for there painters paint them darker than photographs are; those that it shines on as one sees them, which are on the
# world's left, and by as much less those before it. With or without it some are, by noise, at most.
LIT, LIT_M, SUNNY_SIDE, SUNLIT = 0.22, 15.0, 0.15, 0.2
LEAVES = (1.0, 1.03, 0.78)  # of red, green and blue in a brighter tree of KITTI's images
LIKELY = 0.05  # probability of people and of signs from which on they are given colours
HOUSES_VARIED = 0.5  # how much brighter or darker than the mean a house is, at most


class Facades(NamedTuple):
    """What walls show: `openings` (B, H, W) in [0, 1], the share of each pixel that is a window or a door.

    tone  (B, 3, W): how bright the house of each column is in red, green and blue, about uniform in [-1, 1].
    """

    openings: Tensor
    tone: Tensor


class Walls(NamedTuple):
    """The wall of every column, each (B, W): distance from the view's axis, where along it, numbers of its house.

    house  int64, random but the same for one house;  along_m: from the house's left end;  width_m: of a pixel along it.
    """

    radius_m: Tensor
    along_m: Tensor
    width_m: Tensor
    house: Tensor


def facades(
    walls: Tensor, radius_m: Tensor, above_m: Tensor, view: View, T_world_sensor: np.ndarray | None = None
) -> Facades:
    """Openings and tones of walls.

    walls     (B, H, W): probability that a pixel shows a building.
    radius_m  (B, H, W): distance from the view's axis;  above_m: (B,), how high the view's origin is above the road.
    T_world_sensor  (4, 4): where the facades hang; None: on the sensor frame.
    """
    slope, above_m = slopes(view, device=walls.device)[:, None], above_m[:, None, None]
    profile, weight = wall_profile(*(part[:, ::EVERY] for part in (walls, radius_m, radius_m * slope + above_m)))
    found = _walls(profile, weight, view, T_world_sensor)
    level_m = slope * found.radius_m[:, None] + above_m
    elsewhere = ((radius_m / found.radius_m[:, None] - 1).abs() / SAME_WALL - 1).clamp(0, 1)
    openings = _openings(found, level_m, view) * (WALL_SHARE * walls).clamp(max=1) * (1 - elsewhere)
    warm = COOLEST + (WARMEST - COOLEST) * _uniform(found.house, 9)
    tone = (2 * _uniform(found.house, 0) - 1)[:, None] + torch.stack([warm, YELLOW * warm, -warm], 1)
    return Facades(openings, tone)


def wall_profile(walls: Tensor, radius_m: Tensor, height_m: Tensor) -> tuple[Tensor, Tensor]:
    """Logarithm of the distance (B, W) of each column's wall, and how many rows (B, W) it was read from."""
    inside = (height_m > LOWEST_M) & (height_m < HIGHEST_M) & (radius_m < FARTHEST_M)
    profile, total = surface_profile(walls * inside, radius_m, SAME_WALL, LEAST, REACH // 2)
    return profile.nan_to_num(math.log(FARTHEST_M)), total


def _walls(profile: Tensor, weight: Tensor, view: View, T_world_sensor: np.ndarray | None) -> Walls:
    """Straight walls through the profile around every column, and the houses they are divided into."""
    ray, start = world_columns(view, T_world_sensor, profile.device)
    point = profile.exp().double()[:, None] * ray  # (B, 2, W) from the view's axis
    mean, tangent = _lines(point, profile, weight)
    number = _direction(tangent, weight)
    normal = torch.stack([-tangent[:, 1], tangent[:, 0]], 1)
    facing = (normal * ray).sum(1)
    radius = (normal * mean).sum(1) / torch.where(facing.abs() < 0.05, 0.05 * facing.sign() + 1e-9, facing)
    radius = torch.where((radius / profile.exp()).log().abs() < 0.3, radius, profile.exp())  # else no wall is there
    run = number * (math.pi / DIRECTIONS)
    along = ((radius[:, None] * ray + start[:, None]) * torch.stack([run.cos(), run.sin()], 1)).sum(1)
    house = (along / HOUSE_M).floor()
    width = radius / view.focal_px / facing.abs().clamp(min=0.05)
    beyond = mean[:, 1] * run.cos() > mean[:, 0] * run.sin()  # of the two that face each other across a street
    mixed = _mixed(((house.long() + AWAY) * 2 + beyond) * DIRECTIONS + number.long() + DRAWN)
    return Walls(radius.float(), (along - house * HOUSE_M).float(), width.float(), mixed)


def _lines(point: Tensor, profile: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Means and unit tangents (B, 2, W) of the lines through the points (B, 2, W) around each column.

    Neighbours count by their weight and by how near their distance is to the column's own; columns are circular.
    """
    sums = torch.zeros(6, *profile.shape, dtype=torch.float64, device=profile.device)
    x, y = point.unbind(1)
    terms = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y]) * weight
    for shift in range(-REACH, REACH + 1, 2):
        near = torch.exp(-((profile.roll(shift, 1) - profile) / SAME_WALL).square())
        sums += terms.roll(shift, 2) * near
    count = sums[0].clamp(min=1e-6)
    mx, my = sums[1] / count, sums[2] / count
    xx, xy, yy = sums[3] / count - mx * mx, sums[4] / count - mx * my, sums[5] / count - my * my
    turn = torch.atan2(2 * xy, xx - yy) / 2
    return torch.stack([mx, my], 1), torch.stack([turn.cos(), turn.sin()], 1)


def _direction(tangent: Tensor, weight: Tensor) -> Tensor:
    """Number (B, W) of the direction in which most walls around a column run, of DIRECTIONS per half turn."""
    number = (torch.atan2(tangent[:, 1], tangent[:, 0]) * (DIRECTIONS / math.pi)).round().remainder(DIRECTIONS)
    votes = one_hot(number.long(), DIRECTIONS).movedim(2, 1) * weight[:, None]
    return avg_pool1d(pad(votes.float(), (REACH, REACH), mode="circular"), 2 * REACH + 1, 1).argmax(1)


def _openings(walls: Walls, level_m: Tensor, view: View) -> Tensor:
    """Share (B, H, W) of each pixel that is a pane or a door, of walls whose pixels are level_m above the road."""
    house = walls.house
    storey = (2.6 + 0.7 * _uniform(house, 1))[:, None]
    sill, tall = (0.7 + 0.4 * _uniform(house, 2))[:, None], (1.1 + 0.5 * _uniform(house, 3))[:, None]
    count = (3 + 3 * _uniform(house, 4)).floor()
    wide = 0.9 + 0.6 * _uniform(house, 5)
    base = (0.1 + 0.7 * _uniform(house, 6))[:, None]
    every = HOUSE_M / count
    window = (walls.along_m / every).floor()
    aside = (walls.along_m - (window + 0.5) * every).abs()
    is_door = window == (count * _uniform(house, 7)).floor()
    floor = ((level_m - base) / storey).floor()
    up = level_m - base - floor * storey
    door = (is_door[:, None] & (floor == 0)).float()
    middle = torch.lerp(sill + tall / 2, torch.full_like(sill, 1.0), door)
    tall = torch.lerp(tall, torch.full_like(tall, 2.1), door)
    pixel_m = walls.radius_m / view.focal_px
    across = pixel_share(wide / 2 - aside, walls.width_m) * (every / walls.width_m / 2 - 1).clamp(0, 1)
    upward = pixel_share(tall / 2 - (up - middle).abs(), pixel_m[:, None])
    mullion = _bar(aside, walls.width_m) * (_uniform(house, 10) >= NO_MULLION)
    transom = _bar(up - middle - tall / 6, pixel_m[:, None]) * (_uniform(house, 11) >= NO_TRANSOM)[:, None]
    glass = 1 - (1 - door) * torch.maximum(mullion[:, None], transom)
    blind = _uniform(_mixed(house + window.long() * 7 + 1), 0)  # a column of windows may be missing
    storeys = (2 + 3 * _uniform(house, 8)).floor()[:, None]
    there = (floor >= 0) & (floor < storeys) & (blind > 0.1)[:, None]
    return across[:, None] * upward * glass * there


def _bar(middle_m: Tensor, pixel_m: Tensor) -> Tensor:
    """The share of pixels that is a bar, so far from its middle; bars as fine as a pixel fade out, as they flicker."""
    share = pixel_share(BAR_M / 2 - middle_m, pixel_m) - pixel_share(-BAR_M / 2 - middle_m, pixel_m)
    return share * (BAR_M / pixel_m - 1).clamp(0, 1)


def _mixed(number: Tensor) -> Tensor:
    """Numbers int64 in [0, 2^31) that look random, of numbers (splitmix's multipliers, 31 bits)."""
    mask = 0x7FFFFFFF
    number = number & mask
    number = ((number ^ (number >> 15)) * 0x2C1B3C6D) & mask
    number = ((number ^ (number >> 12)) * 0x297A2D39) & mask
    return number ^ (number >> 15)


def _uniform(house: Tensor, which: int) -> Tensor:
    """Uniform numbers (B, W) float32 in [0, 1), one kind for each `which`."""
    return _mixed(house * 31 + which * 0x1B873593 + 1).float() / 0x80000000


def clothing(height_m: Tensor, noise: Tensor) -> Tensor:
    """How much brighter than the mean person people are at N pixels, in red, green and blue in [-1, 1]: (N, 3) float32.

    height_m  (N,): above the road, metres;  noise: (N,) in [-1, 1], about the same all over a person: the outfit.
    """
    tops, trousers = (_blended(colours, noise) for colours in (TOPS, TROUSERS))
    height_m = height_m[:, None]
    head = torch.where(height_m < HAIR_M, noise.new_tensor(SKIN), noise.new_tensor(HAIR))
    return torch.where(height_m < LEGS_M, trousers, torch.where(height_m < HEAD_M, tops, head))


def sign_colours(noise: Tensor) -> Tensor:
    """How much brighter than the mean sign signs are at N pixels, in red, green and blue in [-1, 1]: (N, 3) float32.

    noise  (N,) in [-1, 1], about the same all over a sign.
    """
    return _blended(SIGNS, noise)


def _blended(colours: Sequence[tuple[float, ...]], noise: Tensor) -> Tensor:
    """Of colours from -1 to 1 at even distances those at N places, (N, 3): each is the mean of the two beside it."""
    at = (noise + 1) / 2 * (len(colours) - 1)
    low = at.long().clamp(0, len(colours) - 2)
    table = noise.new_tensor(colours)
    return torch.lerp(table[low], table[low + 1], (at - low)[:, None])


def invented_tones(
    segments: Tensor,
    height_m: Tensor,
    radius_m: Tensor,
    noise: Tensor,
    house: Tensor,
    openings: Tensor,
    left: Tensor | None = None,
) -> Tensor:
    """How much brighter than the mean of its class each pixel is, in red, green and blue in [-1, 1]: (B, 3, H, W).

    segments   (B, classes, H, W): probabilities;  height_m, radius_m: (B, H, W) above the road, and from the axis.
    noise      (B, H, W) in [-1, 1], about the same all over a thing.
    house, openings  of `facades`;  left: (W,) of unit vectors to what columns show, how far to the world's left; None:
               there is no sun.
    """
    varied = segments.new_tensor([VARIED.get(name, 0.0) for name in COMMON15.classes], dtype=torch.float32)
    brighter = torch.einsum("bchw,c->bhw", segments.float(), varied) * noise
    trees = segments[:, VEGETATION].float() * _sunlight(noise, radius_m, left)
    tones = brighter[:, None] + trees[:, None] * noise.new_tensor(LEAVES)[:, None, None]
    tones = tones + segments[:, BUILDING, None] * _house_tones(house, openings)
    _add_colours(tones, segments, height_m, noise)
    return tones


def _add_colours(tones: Tensor, segments: Tensor, height_m: Tensor, noise: Tensor) -> None:
    """Add to tones (B, 3, H, W) those of people and signs, which are few pixels."""
    people, signs = ((segments[:, each] > LIKELY).nonzero(as_tuple=True) for each in (PERSON, SIGN))
    dressed, lettered = clothing(height_m[people], noise[people]), sign_colours(noise[signs])
    for each, at, colours in ((PERSON, people, dressed), (SIGN, signs, lettered)):
        tones.movedim(1, 3)[at] += segments[:, each][at].float()[:, None] * colours


def _sunlight(noise: Tensor, radius_m: Tensor, left: Tensor | None) -> Tensor:
    """How much brighter than the mean trees are (B, H, W), by noise (B, H, W) and where they stand: see LIT."""
    bright = noise.clamp(min=0).mul_(SUNLIT)
    if left is not None:
        bright.add_((2 - radius_m / LIT_M).clamp_(0, 1), alpha=LIT).add_(SUNNY_SIDE * left)
    return bright


def _house_tones(house: Tensor, openings: Tensor) -> Tensor:
    """How much brighter than the mean (B, 3, H, W) houses are, of `facades`: the windows of bright ones are not.

    (Panes as bright as the plaster around them were hardly seen.)
    """
    tones = (HOUSES_VARIED * house)[:, :, None]
    return tones - openings[:, None] * tones.clamp(min=0)
