"""Cars' windows, tyres and paint: where a LiDAR hardly measures anything, shape alone says where they are.

The nearest surface of every column of a panorama is cut into cars, and a rectangle is laid around each (the smallest
in area, Zhang et al. 2017). Heights and places along its sides then say what is glass, rubber or painted metal.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidar2pano.geometry.columns import median_around, pixel_share, surface_profile, world_columns
from lidar2pano.geometry.surface import slopes
from lidar2pano.views import View

EVERY = 2  # rows of a raster for each that cars are looked for in
LOWEST_M, HIGHEST_M, FARTHEST_M = 0.1, 2.6, 45.0  # above the road; from the view's axis
LEAST = 0.75  # rows that show a car; with fewer the column has none
REACH = 8  # columns on either side, of which the median is taken
SAME_SURFACE, SAME_CAR = 0.12, 0.3  # of the logarithm of the distance
GAP_M, GAP = 0.6, 0.02  # columns farther apart than GAP_M + GAP x distance are of two cars
LONGEST_M, MOST_PARTS = 5.4, 16  # what is longer is cut into equal cars, at most so many
ANGLES = 15  # of rectangles that are tried, per quarter turn
THICK_M = 0.1  # added to rectangles' sides, so that a straight row of points has an area
SIDE_M = 2.4  # length from which on it is a car's side and not its front or rear
LONG_M, WHEEL_M, AXLE = 3.2, 0.33, 0.29  # length from which on wheels are in view; radius; share of the length aside
UNDER_M = 0.18  # below that it is dark
TOP_M, HIGH = (1.35, 2.4), 0.8  # of roofs; columns that do not reach that share of them show the bonnet or boot
GLASS = (0.63, 0.92)  # between these shares of the roof's height
SIDE_GLASS, END_GLASS, WIDEST_M = 0.37, 0.42, 1.7  # shares of the length, or width, to which glass goes on either side
PILLAR_M = 0.04  # half of the width of one between a car's doors
GLASS_TONE, RUBBER_TONE = -0.3, -0.5
BRIGHTEST, COLOURED = 0.7, 2.5  # tone of the brightest paint; how fast the few coloured cars gain colour
PAINT_WAVES_M = (17.0, 27.0, 13.0)  # cars so far apart differ in paint


class Rectangles(NamedTuple):
    """The smallest rectangle around each car, by column: its middle (2, W), its length, and the column's place in it.

    along, across  (W,) from the middle, metres.
    """

    middle: Tensor
    length_m: Tensor
    along_m: Tensor
    across_m: Tensor


class Cars(NamedTuple):
    """The car of every column, each (W,): distance of its surface from the view's axis, NaN where there is none.

    top_m  height of the roof;  high: whether the column reaches it;  side: whether it shows a long side.
    paint  (3, W): how much brighter than the mean car it is in red, green and blue;  box: the rectangle around it.
    """

    distance_m: Tensor
    top_m: Tensor
    high: Tensor
    side: Tensor
    paint: Tensor
    box: Rectangles


def car_tones(
    cars: Tensor, radius_m: Tensor, above_m: Tensor, view: View, T_world_sensor: np.ndarray | None = None
) -> Tensor:
    """How much brighter than the mean car each pixel is, (B, 3, H, W) in red, green and blue; 0 where no car is.

    cars      (B, H, W): probability that a pixel shows a car.
    radius_m  (B, H, W): distance from the view's axis;  above_m: (B,), how high the view's origin is above the road.
    T_world_sensor  (4, 4): where the paint hangs; None: on the sensor frame.
    """
    return torch.stack([_tones(*scene, view, T_world_sensor) for scene in zip(cars, radius_m, above_m, strict=True)])


def _tones(cars: Tensor, radius_m: Tensor, above_m: Tensor, view: View, pose: np.ndarray | None) -> Tensor:
    slope = slopes(view, device=cars.device)[:, None]
    rows = slice(EVERY // 2, None, EVERY)
    found = _cars(cars[rows], radius_m[rows], radius_m[rows] * slope[rows] + above_m, view, pose)
    tones = cars.new_zeros(len(found.paint), *cars.shape)
    columns = found.distance_m.isfinite().nonzero()[:, 0]
    if len(columns):
        found = _of_columns(found, columns)
        tone = _tones_of(found, slope * found.distance_m + above_m, found.distance_m / view.focal_px)
        apart = (radius_m[:, columns] / found.distance_m).log().abs()
        tones[..., columns] = tone * (cars[:, columns] * (1 - (apart / SAME_CAR - 1).clamp(0, 1)))
    return tones


def _of_columns(found: Cars, columns: Tensor) -> Cars:
    *parts, box = found
    return Cars(*(part[..., columns] for part in parts), box=Rectangles(*(part[..., columns] for part in box)))


def _tones_of(found: Cars, height_m: Tensor, pixel_m: Tensor) -> Tensor:
    """Tones (3, H, n) of n columns' cars, whose pixels are height_m (H, n) above the road and of size pixel_m (n,)."""
    half, middle = (GLASS[1] - GLASS[0]) / 2 * found.top_m, sum(GLASS) / 2 * found.top_m
    glass = pixel_share(half - (height_m - middle).abs(), pixel_m)
    length_m, along_m = found.box.length_m, found.box.along_m
    reach = torch.where(found.side, SIDE_GLASS * length_m, END_GLASS * length_m.clamp(max=WIDEST_M))
    place = torch.where(found.side, along_m, found.box.across_m).abs()
    pillar = torch.where(found.side, pixel_share(PILLAR_M - place, pixel_m), 0.0)
    glass = glass * (pixel_share(reach - place, pixel_m) * (1 - pillar) * found.high)
    aside = (along_m.abs() - AXLE * length_m).abs()
    wheel = pixel_share(WHEEL_M - torch.hypot(aside.expand_as(height_m), height_m - WHEEL_M), pixel_m)
    rubber = torch.maximum(wheel * (found.side & (length_m > LONG_M)), pixel_share(UNDER_M - height_m, pixel_m))
    tone = found.paint[:, None] + glass * (GLASS_TONE - found.paint[:, None])
    return tone + rubber * (RUBBER_TONE - tone)


def _cars(cars: Tensor, radius_m: Tensor, height_m: Tensor, view: View, pose: np.ndarray | None) -> Cars:
    inside = (height_m > LOWEST_M) & (height_m < HIGHEST_M) & (radius_m < FARTHEST_M)
    (profile,), (total,) = surface_profile((cars * inside)[None], radius_m[None], SAME_SURFACE, LEAST, REACH)
    distance_m, here = profile.exp(), total > LEAST
    ray, start = world_columns(view, pose, cars.device)
    point = distance_m * ray.to(distance_m)
    apart = torch.hypot(*(point - point.roll(1, 1)).unbind(0)) > GAP_M + GAP * distance_m
    number = _cut(point, _numbers(apart | ~here | ~here.roll(1)))
    box = _rectangles(point, number)
    tops = torch.where((cars > 0.5) & inside, height_m, 0).amax(0)
    tops = median_around(torch.where(here, tops, torch.nan)[None], REACH)[0].nan_to_num(0)
    top = _over(number, tops, "amax").clamp(*TOP_M)
    missing = torch.where(here, 0.0, torch.nan)
    return Cars(
        distance_m=distance_m + missing,
        top_m=top,
        high=tops > HIGH * top,
        side=(box.length_m > SIDE_M) & _on_side(box, number),
        paint=_paint(box.middle + start[:, None].to(point)),
        box=box,
    )


def _cut(point: Tensor, number: Tensor) -> Tensor:
    """Numbers (W,) of the cars when what is longer than a car is cut: parked cars touch in the picture."""
    box = _rectangles(point, number)
    parts = (box.length_m / LONGEST_M).ceil().clamp(1, MOST_PARTS).nan_to_num(1)
    part = (parts * (box.along_m / box.length_m + 0.5)).nan_to_num(0).floor().clamp(0, MOST_PARTS - 1)
    return torch.unique(number * MOST_PARTS + part.long(), return_inverse=True)[1]


def _numbers(first: Tensor) -> Tensor:
    """The number (W,) of each column's car, where `first` says that a car begins; circular."""
    begin = int(first.to(torch.uint8).argmax())
    return first.roll(-begin).long().cumsum(0).roll(begin) - int(first.any())


def _over(number: Tensor, values: Tensor, how: str) -> Tensor:
    """The least, greatest or mean (`how`, of scatter_reduce) of values (..., W) of a car, in each of its columns."""
    index = number.expand_as(values)
    found = torch.zeros_like(values).scatter_reduce(-1, index, values, how, include_self=False)
    return found.gather(-1, index)


def _rectangles(point: Tensor, number: Tensor) -> Rectangles:
    """The rectangles around the points (2, W) of each number."""
    angle = torch.arange(ANGLES, device=point.device) * (math.pi / 2 / ANGLES)
    turned = torch.stack([angle.cos(), angle.sin(), -angle.sin(), angle.cos()]).view(2, 2, ANGLES).to(point)
    places = torch.einsum("ijA,jW->iAW", turned, point)
    low, high = _over(number, places, "amin"), _over(number, places, "amax")
    best = (high - low + THICK_M).prod(0).argmin(0)
    place, low, high = (part.gather(1, best.expand(2, 1, -1))[:, 0] for part in (places, low, high))
    middle = torch.einsum("ijW,iW->jW", turned[:, :, best], (low + high) / 2)
    size, aside = high - low + THICK_M, place - (low + high) / 2
    longer = size[0] > size[1]
    along, across = torch.where(longer, aside, aside.flip(0))
    return Rectangles(middle, size.amax(0), along, across)


def _on_side(box: Rectangles, number: Tensor) -> Tensor:
    """Whether each column is nearer to a long side of its rectangle than to a short one."""
    along, across = (_over(number, part.abs(), "amax") - part.abs() for part in (box.along_m, box.across_m))
    return across <= along


def _paint(place: Tensor) -> Tensor:
    """A tone (3, W) for cars that stand at `place` (2, W) in the world, metres: most are grey, a few red or blue."""
    waves = [
        torch.sin(2 * math.pi / length * (place[0] * math.cos(1.1 * k) + place[1] * math.sin(1.1 * k)) + k)
        for k, length in enumerate(PAINT_WAVES_M)
    ]
    bright, hue = (waves[0] + waves[1]) / 1.5, waves[2]
    light = BRIGHTEST * (bright + 0.3).clamp(0, 1)
    red, blue = (COLOURED * (hue - 0.75)).clamp(min=0), (COLOURED * (-hue - 0.75)).clamp(min=0)
    return torch.stack([light + red - blue / 2, light - red / 2 - blue / 4, light - red / 2 + blue])
