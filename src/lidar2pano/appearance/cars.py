"""Whole cars for a painter: boxes fitted to what a LiDAR shows of them, and the bodies drawn in these boxes.

The nearest surface of every column is cut into cars, and a rectangle is laid around each (the smallest in area, Zhang
et al. 2017). Of bodies of a car's size in places around it, moved step by step, the one is taken that covers best the
pixels of the car (analysis by synthesis). A LiDAR shows one side of a car, with holes where windows and dark paint are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool1d, pad

from lidar2pano.appearance.car_body import TALL_M, Boxes, Hits, distances, first_hits, tones_of
from lidar2pano.appearance.columns import median_around, surface_profile
from lidar2pano.geometry.rasters import as_float
from lidar2pano.labels import COMMON15
from lidar2pano.scene.record import Scene
from lidar2pano.scene.surfaces import cylinder_points, slopes, world_columns
from lidar2pano.views import View

EVERY = 2  # rows of a raster for each that cars are looked for in
LOWEST_M, BELT_M, HIGHEST_M, FARTHEST_M = 0.15, 1.0, 2.6, 32.0  # above the road; from the view's axis
# Cars within BESIDE_M are cut off by the picture's lower edge. Hardly more than their windows is in view, and what is
# seen through these: of a column's distances the nearest ones count, up to CUT_M above that edge at any height, and a
# gap of up to 2 x WINDOW columns is a window.
BESIDE_M, CUT_M, NEARNESS, WINDOW = 4.0, 0.4, 8.0, 30
LEAST = 0.75  # rows that show a car; with fewer the column has none
REACH, HOLE = 8, 4  # columns on either side, of which the median is taken; half of the widest gap in a car
SAME_DISTANCE, SAME_CAR = 0.12, 0.35  # of the logarithm of the distance
THROUGH_GLASS, THROUGH_WINDOWS = 0.6, 1.5  # likewise, by how much what one sees through a car is farther away; beside
GAP_M, GAP, GAP_BESIDE_M = 0.6, 0.02, 1.1  # columns farther apart than GAP_M + GAP x distance are of two cars; beside
PARKED_M, MOST_PARTS = 5.2, 16  # a row of parked cars is cut into pieces of about that length, at most so many
ANGLES = 30  # of rectangles that are tried, per quarter turn
THICK_M = 0.1  # added to rectangles' sides, so that a straight row of points has an area
COLUMNS, MOST = 12, 16  # a car fills so many columns at least; of a scene the nearest count, so many at most
# A rectangle whose longer side is longer than that is around a car's side, not its front or back; of cars that are in
# view from this height above the road on it has to be said, for bodies either way cover them.
WIDEST_M, CUT_FROM_M = 2.6, 0.3
LENGTH_M, WIDTH_M, TOP_M = (3.3, 5.0), (1.5, 1.95), (1.35, 2.3)  # least and greatest of cars
AROUND_M, OVER_M, ACROSS, DOWN = 1.2, 0.3, 32, 20  # what is looked at of a car: so far around it, columns, rows
MOVES = (0.4, 0.25, 0.12, 0.08, 0.3)  # by which a box is tried elsewhere: along, across, turned, up, longer
ROUNDS, TURN = (1.0, 0.9, 0.7, 0.6, 0.5, 0.4), 0.6  # shares of MOVES, one after the other; before TURN it is turned
OFF, IN_FRONT_M = 1.0, 0.3  # how much a difference of distances counts; what is so much nearer than a car hides it
BARE = 0.95  # probability from which on a pixel surely shows the ground; a body on it counts twice against a fit
KEPT, SAME_PLACE_M = 0.05, 1.5  # what a car's box of the scan before counts more; how far its middle is at most
HALF = 0.5  # probability from which on a pixel shows a thing
COVERED = 0.6  # least share of overlap in union of a car that is drawn
# Probabilities of what has to go where no body was drawn: less is no car, more is another, but for a car beside one.
FAINT, SURE = 0.02, 0.9
SHADE, SHADE_M, PALE = 0.35, 0.3, 0.01  # tone and breadth of the shadow beside a car; no shadow that is paler
PAINT_WAVES_M = (17.0, 27.0, 13.0)  # cars so far apart differ in paint
BRIGHTEST, DARKEST = 0.5, -0.2  # tones of white and of black paint
RED, BLUE = (0.0, -0.4, -0.3), (-0.25, -0.1, 0.15)  # tones of coloured paint, which is not bright
DULL, COLOURED = (0.35, 0.8), (0.8, 1.0)  # of the sine that says so: between white, grey and colours lies a metre


class Measured(NamedTuple):
    """What a panorama shows of cars.

    cars, ground  (H, W): probabilities;  radius_m: (H, W), distance from the view's axis.
    above_m       (): how high the viewpoint is above the road;  number: (W,), of the car of each column, -1 for none.
    """

    cars: Tensor
    ground: Tensor
    radius_m: Tensor
    above_m: Tensor
    number: Tensor
    view: View


class Found(NamedTuple):
    """The rectangle (n) around the visible part of each car, its highest point, and its distance from the view's axis.

    middle, axis  (2, n): centre and direction of the longer side;  number: (n,), as in Measured.
    """

    middle: Tensor
    axis: Tensor
    length_m: Tensor
    width_m: Tensor
    top_m: Tensor
    distance_m: Tensor
    number: Tensor


class Sample(NamedTuple):
    """Q x R rays at each of n cars, and what the picture has there: whether it is the car, which distance it has.

    ray  (2, n, 1, Q);  slope: (n, 1, R);  the others: (n, 1, Q, R).
    hides_m  what else is in the picture hides a body that is farther away;  bare: whether it is surely ground.
    counts   whether the ray is in the picture.
    """

    ray: Tensor
    slope: Tensor
    above_m: Tensor
    car: Tensor
    radius_m: Tensor
    hides_m: Tensor
    bare: Tensor
    counts: Tensor


def found_cars(cars: Tensor, ground: Tensor, radius_m: Tensor, above_m: Tensor, view: View) -> tuple[Found, Measured]:
    """The nearest cars that fill enough columns; arguments as of Measured."""
    rows = slice(EVERY // 2, None, EVERY)
    slope, radii_m = slopes(view, device=cars.device)[:, None], radius_m[rows]
    height_m, over_edge_m = radii_m * slope[rows] + above_m, radii_m * (slope[rows] - slope[-1])
    inside = (height_m > LOWEST_M) & (height_m < HIGHEST_M) & (radii_m < FARTHEST_M)
    low, beside = height_m < BELT_M, radii_m < BESIDE_M
    profile, total = _profile(cars[rows] * (inside & low), radii_m)
    nearest, near = _profile(cars[rows] * (inside & beside & (low | (over_edge_m < CUT_M))), radii_m, NEARNESS)
    nearest, here = _without_windows(nearest), _closed(torch.maximum(total, near) > LEAST)
    distance_m = torch.where(nearest < math.log(BESIDE_M), nearest, profile).exp()
    ray, _ = world_columns(view, None, cars.device)
    point = (distance_m * ray.to(distance_m)).nan_to_num(0)
    gap_m = torch.where(distance_m < BESIDE_M, GAP_BESIDE_M, GAP_M + GAP * distance_m)
    apart = torch.hypot(*(point - point.roll(1, 1)).unbind(0)) > gap_m
    number = _cut(point, _numbers(apart | ~here | ~here.roll(1)))
    tops = torch.where((cars[rows] > HALF) & inside, height_m, 0).amax(0)
    tops = median_around(torch.where(here, tops, torch.nan)[None], REACH)[0].nan_to_num(0)
    top_m, mean_m = _over(number, tops, "amax"), _over(number, distance_m.nan_to_num(torch.inf), "mean")
    enough = here & (_over(number, here.float(), "sum") >= COLUMNS) & (top_m > TOP_M[0] / 2)
    column = torch.arange(len(number), device=number.device)
    column = column[enough & (_over(number, column, "amin") == column)]  # one of each car
    column = column[mean_m[column].argsort()[:MOST]]
    parts = (*_rectangles(point, number), top_m.clamp(*TOP_M), mean_m, number)
    measured = Measured(cars, ground, radius_m, above_m, torch.where(here, number, -1), view)
    return Found(*(part[..., column] for part in parts)), measured


def _profile(weight: Tensor, radius_m: Tensor, nearness: float = 0.0) -> tuple[Tensor, Tensor]:
    """`surface_profile` (W,) and (W,) of one scene (H, W)."""
    (profile,), (total,) = surface_profile(weight[None], radius_m[None], SAME_DISTANCE, LEAST, REACH, nearness)
    return profile, total


def _without_windows(profile: Tensor) -> Tensor:
    """Logarithms of distances (W,), NaN where there is none; as of what is beside where that is nearer on both sides.

    The closing of mathematical morphology, of nearness; circular.
    """
    closed = _greatest_around(-_greatest_around(-profile.nan_to_num(math.inf)))
    return torch.where(profile - closed < SAME_DISTANCE, profile, closed)


def _greatest_around(values: Tensor) -> Tensor:
    return max_pool1d(pad(values[None], (WINDOW, WINDOW), mode="circular"), 2 * WINDOW + 1, 1)[0]


def _closed(here: Tensor) -> Tensor:
    """Columns (W,) bool with gaps of at most 2 x HOLE columns closed; circular."""
    shifts = range(-HOLE, HOLE + 1)
    grown = torch.stack([here.roll(shift) for shift in shifts]).any(0)
    return torch.stack([grown.roll(shift) for shift in shifts]).all(0)


def fitted(found: Found, measured: Measured, earlier: Boxes | None = None) -> tuple[Boxes, Tensor]:
    """The box (n,) of each car that fits best, and the overlap of its body with the car in the picture, in [0, 1].

    earlier  (m,): boxes of the scan before. A car keeps its own unless another one fits better by KEPT, so that what
             stands does not waver in a drive; then the overlap counts KEPT more.
    """
    sample = _sampled(found, measured)
    boxes, score, covered = _best(_placed(found, measured), sample)
    for step in ROUNDS:
        if step == TURN:
            boxes, score, covered = _best(_turned(boxes, found.top_m), sample)
        boxes, score, covered = _nudged(boxes, score, covered, step, sample)
    if earlier is None:
        return boxes, covered
    apart_m, nearest = torch.cdist(boxes.middle.T, earlier.middle.T).min(1)
    both = _alternatives([boxes, earlier.of(nearest)])
    scores, shares = _scores(both, sample)
    scores[:, 1] += torch.where(apart_m < SAME_PLACE_M, KEPT, -math.inf)
    shares[:, 1] += KEPT
    boxes, _, covered = _picked(both, scores, shares)
    return boxes, covered


def _placed(found: Found, measured: Measured) -> Boxes:
    """Boxes (n, 12) that the visible parts of cars may belong to: two directions, three places along, two across."""
    made, in_view_m = [], measured.above_m + found.distance_m * slopes(measured.view)[-1]
    sideways = (found.length_m > WIDEST_M) & (in_view_m > CUT_FROM_M)
    for lengthwise, ends in product((True, False), product((1.0, 0.0, -1.0), (1.0, 0.0))):
        across = torch.stack([-found.axis[1], found.axis[0]])
        along = lengthwise | sideways
        axes = torch.where(along, found.axis, across), torch.where(along, across, found.axis)
        visible = torch.where(along, found.length_m, found.width_m), torch.where(along, found.width_m, found.length_m)
        middle, sizes = found.middle, []
        for axis, extent, end, limits in zip(axes, visible, ends, (LENGTH_M, WIDTH_M), strict=True):
            size = extent.clamp(*limits)
            away = (found.middle * axis).sum(0).sign()
            middle = middle + axis * (end * away * (size - extent) / 2)
            sizes.append(size)
        base_m, body = torch.zeros_like(found.top_m), (found.top_m > TALL_M[1]).long() * 2
        made.append(Boxes(middle, axes[0], sizes[0], sizes[1], found.top_m, base_m, body))
    return _alternatives(made)


def _alternatives(made: list[Boxes]) -> Boxes:
    """Boxes (n, K) of K lists of n each."""
    return Boxes(*(torch.stack(parts, -1) for parts in zip(*made, strict=True)))


def _turned(boxes: Boxes, top_m: Tensor) -> Boxes:
    """The boxes with two bodies of their height, nose first and tail first: (n, 4)."""
    bodies = (torch.where(top_m < TALL_M[1], 0, 2), torch.where(top_m > TALL_M[0], 2, 1))
    made = [boxes._replace(ahead=sign * boxes.ahead, body=body) for sign, body in product((1, -1), bodies)]
    return _alternatives(made)


def _nudged(boxes: Boxes, score: Tensor, covered: Tensor, step: float, sample: Sample) -> tuple[Boxes, Tensor, Tensor]:
    """The boxes, moved by a step of MOVES there or back where that is better: the best one alone, or all at once."""
    tried = [_moved(boxes, move, sign * step) for move, sign in product(range(len(MOVES)), (1, -1))]
    each, covered_by_each = _scores(_alternatives(tried), sample)
    forth, back = each[:, ::2], each[:, 1::2]
    better = torch.maximum(forth, back) > score[:, None]
    by = torch.where(better, torch.where(forth > back, step, -step), 0.0)
    joint = boxes
    for move in range(len(MOVES)):
        joint = _moved(joint, move, by[:, move])
    of_joint, covered_by_joint = _scores(_alternatives([joint]), sample)
    scores = torch.cat([score[:, None], of_joint, each], 1)
    shares = torch.cat([covered[:, None], covered_by_joint, covered_by_each], 1)
    return _picked(_alternatives([boxes, joint, *tried]), scores, shares)


def _moved(boxes: Boxes, move: int, step: Tensor | float) -> Boxes:
    """The boxes, moved by a step (n,) of MOVES."""
    by = step * torch.full_like(boxes.top_m, MOVES[move])
    match move:
        case 0 | 1:
            return boxes._replace(middle=boxes.middle + by * (boxes.ahead, boxes.left)[move])
        case 2:
            return boxes._replace(ahead=by.cos() * boxes.ahead + by.sin() * boxes.left)
        case 3:
            return boxes._replace(base_m=boxes.base_m + by)
        case _:
            return boxes._replace(length_m=(boxes.length_m + by).clamp(*LENGTH_M))


def _sampled(found: Found, measured: Measured) -> Sample:
    view, device = measured.view, measured.cars.device
    azimuth = torch.atan2(found.middle[1], found.middle[0])[:, None]
    half = (AROUND_M + found.length_m / 2) / found.distance_m
    angle = azimuth + half.clamp(max=1.5)[:, None] * torch.linspace(1, -1, ACROSS, device=device)
    rows = slopes(view, device=device)
    highest = ((found.top_m + OVER_M - measured.above_m) / found.distance_m).clamp(max=rows[0])
    lowest = (-measured.above_m / (0.85 * found.distance_m)).clamp(min=rows[-1])
    share = torch.linspace(0.02, 0.98, DOWN, device=device)
    slope = highest[:, None] + (lowest - highest)[:, None] * share
    column = torch.remainder(math.radians(view.left) - angle, 2 * math.pi) * view.focal_px
    inside = (column < view.columns)[:, :, None]
    column = column.long().clamp(max=view.columns - 1)[:, :, None]
    row = _row(slope, view)[:, None]
    car, ground, radius_m = (part[row, column] for part in (measured.cars, measured.ground, measured.radius_m))
    owner = measured.number[column]
    farther, own = (radius_m / found.distance_m[:, None, None]).log(), owner == found.number[:, None, None]
    through = torch.where(found.distance_m < BESIDE_M, THROUGH_WINDOWS, THROUGH_GLASS)[:, None, None]
    same = (farther > -SAME_CAR) & (farther < torch.where(own, through, SAME_CAR)) & (own | (owner < 0))
    ray = torch.stack([angle.cos(), angle.sin()])[:, :, None]
    is_car = (car > HALF) & same
    hides_m = torch.where(is_car | (ground > HALF), math.inf, radius_m + IN_FRONT_M)
    parts = (is_car, radius_m, hides_m, ground > BARE, inside)
    return Sample(ray, slope[:, None], measured.above_m, *(part[:, None] for part in parts))


def _row(slope: Tensor, view: View) -> Tensor:
    """Rows int64 of a view in which directions of these tangents are."""
    height = torch.rad2deg(torch.atan(slope)) if view.kind == "sphere" else slope
    return ((view.up - height) / (view.up - view.down) * view.rows).long().clamp(0, view.rows - 1)


def _scores(boxes: Boxes, sample: Sample) -> tuple[Tensor, Tensor]:
    """How well each of the boxes (n, K) fits, and the share of overlap in union."""
    distance_m = distances(boxes, sample.ray, sample.slope, sample.above_m)
    hit = distance_m.isfinite()
    hidden = (distance_m > sample.hides_m) & hit
    counts = sample.counts & ~hidden
    inside = hit & sample.car & sample.counts
    both = inside.sum((-1, -2))
    union = ((hit | sample.car) & counts).sum((-1, -2)).clamp(min=1)
    wrong = (hit & sample.bare & counts).sum((-1, -2))
    farther = (distance_m / sample.radius_m - 1).abs().clamp(max=SAME_CAR)
    off = (farther * inside).nan_to_num(0).sum((-1, -2)) / both.clamp(min=1)
    return both / (union + wrong) - OFF * off, both / union


def _best(boxes: Boxes, sample: Sample) -> tuple[Boxes, Tensor, Tensor]:
    """Of the boxes (n, K) of each car the best, its score, and the share of overlap in union; (n,)."""
    return _picked(boxes, *_scores(boxes, sample))


def _picked(boxes: Boxes, scores: Tensor, covered: Tensor) -> tuple[Boxes, Tensor, Tensor]:
    """As `_best`, where scores and shares (n, K) are known."""
    best = scores.argmax(-1, keepdim=True)
    chosen = Boxes(*(part.gather(-1, best.expand(*part.shape[:-1], 1))[..., 0] for part in boxes))
    return chosen, scores.gather(-1, best)[:, 0], covered.gather(-1, best)[:, 0]


def _cut(point: Tensor, number: Tensor) -> Tensor:
    """Numbers (W,) of the cars when what is longer than a car is cut: parked cars touch in the picture."""
    middle, axis, length_m, _ = _rectangles(point, number)
    along_m = ((point - middle) * axis).sum(0)
    parts = (length_m / PARKED_M).round().clamp(1, MOST_PARTS)
    part = (parts * (along_m / length_m + 0.5)).floor().clamp(0, MOST_PARTS - 1)
    return torch.unique(number * MOST_PARTS + part.long(), return_inverse=True)[1]


def _numbers(first: Tensor) -> Tensor:
    """The number (W,) of each column's car, where `first` says that a car begins; circular."""
    begin = int(first.to(torch.uint8).argmax())
    return first.roll(-begin).long().cumsum(0).roll(begin) - int(first.any())


def _over(number: Tensor, values: Tensor, how: str) -> Tensor:
    """The least, greatest, sum or mean (`how`) of values (..., W) of a car, in each of its columns."""
    index = number.expand_as(values)
    found = torch.zeros_like(values).scatter_reduce(-1, index, values, how, include_self=False)
    return found.gather(-1, index)


def _rectangles(point: Tensor, number: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The rectangles around the points (2, W) of each number: middle and long axis (2, W), length and width (W,)."""
    angle = torch.arange(ANGLES, device=point.device) * (math.pi / 2 / ANGLES)
    turned = torch.stack([angle.cos(), angle.sin(), -angle.sin(), angle.cos()]).view(2, 2, ANGLES).to(point)
    places = turned[:, 0, :, None] * point[0] + turned[:, 1, :, None] * point[1]
    low, high = _over(number, places, "amin"), _over(number, places, "amax")
    best = (high - low + THICK_M).prod(0).argmin(0)
    low, high = (part.gather(1, best.expand(2, 1, -1))[:, 0] for part in (low, high))
    axes = turned[:, :, best]
    middle = (axes * ((low + high) / 2)[:, None]).sum(0)
    size = high - low + THICK_M
    return middle, torch.where(size[0] > size[1], axes[0], axes[1]), size.amax(0), size.amin(0)


class WholeCars(NamedTuple):
    """What a panorama looks like with whole cars.

    segments  (B, C, H, W): probabilities;  depth_m: (B, H, W) metres.
    tones     (B, 3, H, W): how much brighter than the mean of its class in red, green, blue; NaN where not known.
    boxes     of the cars (n) that were drawn, in the world, float64; None: none, or not of a single scene.
    """

    segments: Tensor
    depth_m: Tensor
    tones: Tensor
    boxes: Boxes | None = None


class Classes(NamedTuple):
    """Ids of classes: cars, other vehicles, and what they stand on."""

    car: int
    others: Sequence[int]
    ground: Sequence[int]


CARS = Classes(
    COMMON15.id_of("car"),
    others=tuple(map(COMMON15.id_of, ("truck", "other-vehicle", "bicycle", "motorcycle"))),
    ground=tuple(map(COMMON15.id_of, ("road", "sidewalk", "terrain"))),
)


class Drawn(NamedTuple):
    """Bodies on a raster: nearest_m (H, W), their distance from the view's axis, inf elsewhere; tones (3, H, W)."""

    nearest_m: Tensor
    tones: Tensor


def with_cars(scene: Scene, previous: Boxes | None = None) -> WholeCars:
    """Draw whole cars into a copy of a scene's probabilities and depths; see `whole_cars`.

    previous  boxes of the previous scan, in the world.
    """
    radius_m, _ = cylinder_points(scene.depth_m, scene.view)
    segments, depth_m = scene.probabilities.float(), scene.depth_m.float()
    pose = scene.T_world_sensor
    return whole_cars(segments, depth_m, radius_m, scene.viewpoint_m, scene.view, pose, CARS, previous)


def whole_cars(  # noqa: PLR0913, PLR0917 one scene, and which class is what
    segments: Tensor,
    depth_m: Tensor,
    radius_m: Tensor,
    above_m: Tensor,
    view: View,
    T_world_sensor: np.ndarray | None,
    classes: Classes,
    earlier: Boxes | None = None,
) -> WholeCars:
    """Lay whole cars over what the sensor measured of them.

    segments  (B, C, H, W): probabilities;  depth_m, radius_m: (B, H, W), from the viewpoint and from its axis.
    above_m   (B,): how high the viewpoint is above the road.
    T_world_sensor  (4, 4): where the cars' colours hang; None: on the sensor frame.
    earlier   what `boxes` was for the scan before: a car keeps its box while that fits about as well as a new one.
    """
    made = []
    for one, depth, radius, above in zip(segments, depth_m, radius_m, above_m, strict=True):
        before = WholeCars(one, depth, one.new_full((3, *depth.shape), math.nan))
        made.append(_whole(before, radius, above, view, T_world_sensor, classes, earlier))
    if len(made) == 1:  # without another copy
        (single,) = made
        return WholeCars(single.segments[None], single.depth_m[None], single.tones[None], single.boxes)
    segments, depth_m, tones = (torch.stack(parts) for parts in list(zip(*made, strict=True))[:3])
    return WholeCars(segments, depth_m, tones)


def _whole(  # noqa: PLR0913, PLR0917 as above
    before: WholeCars,
    radius_m: Tensor,
    above_m: Tensor,
    view: View,
    pose: np.ndarray | None,
    classes: Classes,
    earlier: Boxes | None,
) -> WholeCars:
    device, ground = radius_m.device, before.segments[list(classes.ground)].sum(0)
    cars = before.segments[classes.car]
    found, measured = found_cars(cars.cpu(), ground.cpu(), radius_m.cpu(), above_m.cpu(), view)  # many small steps
    if len(found.number) == 0:
        return before
    boxes, covered = fitted(found, measured, None if earlier is None else _in_view(earlier, view, pose))
    good = _apart(boxes, covered)
    if not bool(good.any()):
        return before
    others = before.segments[list(classes.others)].sum(0)
    boxes = boxes.of(good)
    world, boxes = _in_world(boxes, view, pose), Boxes(*(part.to(device) for part in boxes))
    measured = Measured(cars, ground, radius_m, above_m, measured.number.to(device), view)
    drawn = _drawn(boxes, measured, others, world.middle.to(radius_m))
    inside = drawn.nearest_m.isfinite()
    gone = _outside(measured, others, drawn.nearest_m, found.number[good].to(device))
    segments, radius_m = _without(before.segments, measured, gone, inside, classes)
    segments.mul_(as_float(~inside))
    segments[classes.car].masked_fill_(inside, 1)
    radius_m = torch.where(inside, drawn.nearest_m, radius_m)
    along_ray = torch.sqrt(1 + slopes(view, device=radius_m.device)[:, None].square())
    depth_m = torch.where(radius_m == measured.radius_m, before.depth_m, radius_m * along_ray)
    return WholeCars(segments, depth_m, drawn.tones, world)


def _apart(boxes: Boxes, covered: Tensor) -> Tensor:
    """Which cars (n,) bool are drawn: those that fit, and whose middle is in no car that fits better."""
    good = covered > COVERED
    for car in covered.argsort(descending=True).tolist():
        if good[car]:
            aside = boxes.middle - boxes.middle[:, car, None]
            ahead = boxes.ahead[:, car, None]
            along, across = (ahead * aside).sum(0).abs(), (ahead[0] * aside[1] - ahead[1] * aside[0]).abs()
            inside = (along < boxes.length_m[car] / 2) & (across < boxes.width_m[car] / 2)
            good &= ~inside | (torch.arange(len(good), device=good.device) == car)
    return good


def _drawn(boxes: Boxes, measured: Measured, others: Tensor, place: Tensor) -> Drawn:
    """Cars' bodies where nothing hides them and no other vehicle (H, W) is likelier, and the shadows beside them.

    place  (2, n) in the world, metres, from which each car has its paint.
    """
    view = measured.view
    car, column = _columns(boxes, view)
    each, slope = boxes.of(car), slopes(view, device=car.device)
    ray = world_columns(view, None, car.device)[0].to(slope)[:, column, None]
    first = int((slope > _highest(boxes, measured.above_m)).sum())
    hits = first_hits(each, ray, slope[first:].expand(len(car), -1), measured.above_m)
    distance_m = hits.distance_m[:, 0]  # (pairs of car and column, rows from `first` on)
    is_car, ground, radius_m, others = (part[first:].T[column] for part in (*measured[:3], others))
    near = (radius_m / distance_m).log().abs() < SAME_CAR
    visible = ((is_car > HALF) & near) | (radius_m > distance_m - IN_FRONT_M) | (ground > HALF)
    visible &= (ground < BARE) & ~((others > is_car) & near)
    distance_m = torch.where(visible, distance_m, math.inf)
    nearest = distance_m.new_full((view.columns, distance_m.shape[1]), math.inf)
    nearest.scatter_reduce_(0, column[:, None].expand_as(distance_m), distance_m, "amin")
    pair, row = (distance_m.isfinite() & (distance_m == nearest[column])).nonzero(as_tuple=True)
    chosen = Hits(*(part.expand(hits.distance_m.shape)[pair, 0, row] for part in hits))
    tones = _shaded(each, column, measured, ray[..., 0])
    tones[:, row + first, column[pair]] = tones_of(each.of(pair), chosen, _paint(place)[:, car[pair]])
    above = nearest.new_full((first, view.columns), math.inf)
    return Drawn(torch.cat([above, nearest.T]), tones)


def _highest(boxes: Boxes, above_m: Tensor) -> Tensor:
    """The tangent of the elevation above which no car is in view."""
    nearest_m = (boxes.middle.norm(dim=0) - LENGTH_M[1] / 2).clamp(min=1)
    return ((boxes.top_m + boxes.base_m - above_m) / nearest_m).amax().clamp(min=0)


def _columns(boxes: Boxes, view: View) -> tuple[Tensor, Tensor]:
    """Pairs of a car's number and a column that its box, or its shadow, reaches: (P,) each."""
    half = [(size + 2 * SHADE_M) / 2 for size in (boxes.length_m, boxes.width_m)]
    corners = torch.stack(
        [boxes.middle + a * half[0] * boxes.ahead + b * half[1] * boxes.left for a in (1, -1) for b in (1, -1)]
    )
    middle = torch.atan2(boxes.middle[1], boxes.middle[0])
    apart = torch.remainder(torch.atan2(corners[:, 1], corners[:, 0]) - middle + math.pi, 2 * math.pi) - math.pi
    column = (math.radians(view.left) - middle) * view.focal_px
    first = (column - apart.amax(0) * view.focal_px).floor().long()
    count = (column - apart.amin(0) * view.focal_px).ceil().long() - first
    car = torch.repeat_interleave(torch.arange(len(first), device=first.device), count)
    step = torch.arange(len(car), device=first.device) - (count.cumsum(0) - count)[car]
    turn = round(2 * math.pi * view.focal_px)
    column = (first[car] + step) % turn
    kept = column < view.columns
    return car[kept], column[kept]


def _shaded(each: Boxes, column: Tensor, measured: Measured, ray: Tensor) -> Tensor:
    """Tones (3, H, W) of the ground in the shadow beside cars, NaN elsewhere; ray: (2, P), of the columns (P,)."""
    radius_m = measured.radius_m[:, column]
    out = [
        (radius_m * (ray * axis).sum(0) - (each.middle * axis).sum(0)).abs() - size / 2
        for axis, size in ((each.ahead, each.length_m), (each.left, each.width_m))
    ]
    beside = torch.hypot(*(part.clamp(min=0) for part in out))
    tone = -SHADE * torch.exp(-(beside / SHADE_M).square()) * (measured.ground[:, column] > HALF)
    darkest = torch.zeros_like(measured.radius_m).scatter_reduce(1, column.expand_as(tone), tone, "amin")
    return torch.where(darkest < -PALE, darkest, math.nan).expand(3, -1, -1).clone()


def _outside(measured: Measured, others: Tensor, nearest_m: Tensor, numbers: Tensor) -> Tensor:
    """Pixels (H, W) bool that may be car, and are likelier so than another vehicle, but are outside of drawn bodies."""
    inside = nearest_m.isfinite()
    mean_m = torch.where(inside, nearest_m, 0).sum(0) / inside.sum(0)  # NaN where no body was drawn
    near = (measured.radius_m / mean_m).log().abs() < SAME_CAR
    own = (measured.number < 0) | torch.isin(measured.number, numbers)
    some = (measured.cars > FAINT) & ((measured.cars < SURE) | (mean_m < BESIDE_M))
    return near & own & ~inside & some & (others < measured.cars)


def _without(
    segments: Tensor, measured: Measured, gone: Tensor, inside: Tensor, classes: Classes
) -> tuple[Tensor, Tensor]:
    """Segments and distances that show what is behind, where a car is `gone`: a copy.

    That is as far away as what is next above it; the ground is where it was.
    """
    segments, radius_m = segments.clone(), measured.radius_m.clone()
    rest = segments[:, gone]
    rest[[classes.car, *classes.others]] = 0
    segments[:, gone] = rest / rest.sum(0).clamp(min=1e-9)
    column = gone.any(0).nonzero()[:, 0]
    upright = (segments[list(classes.ground)][..., column].sum(0) < HALF) & (gone | inside)[:, column]
    rows = torch.arange(len(gone), device=gone.device)[:, None].expand_as(upright)
    above = torch.where(upright, -1, rows).cummax(0).values
    old = radius_m[:, column]
    behind = torch.maximum(old.gather(0, above.clamp(min=0)), old)
    radius_m[:, column] = torch.where(gone[:, column] & upright & (above >= 0), behind, old)
    return segments, radius_m


def _in_world(boxes: Boxes, view: View, pose: np.ndarray | None) -> Boxes:
    """Boxes in the world, float64, of boxes around the viewpoint; without a pose they stay where they are."""
    turn, start = _world(boxes, view, pose)
    middle, ahead = (turn @ part.double() for part in (boxes.middle, boxes.ahead))
    return boxes._replace(middle=middle + start, ahead=ahead)


def _in_view(boxes: Boxes, view: View, pose: np.ndarray | None) -> Boxes:
    """The inverse of `_in_world`, float32."""
    turn, start = _world(boxes, view, pose)
    middle, ahead = turn.T @ (boxes.middle - start), turn.T @ boxes.ahead
    return boxes._replace(middle=middle.float(), ahead=ahead.float())


def _world(boxes: Boxes, view: View, pose: np.ndarray | None) -> tuple[Tensor, Tensor]:
    """The rotation (2, 2) and the place (2, 1) of the viewpoint in the world, from above; float64."""
    device = boxes.middle.device
    if pose is None:
        return torch.eye(2, dtype=torch.float64, device=device), torch.zeros(2, 1, dtype=torch.float64, device=device)
    angle = math.atan2(pose[1, 0], pose[0, 0])
    turn = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    return torch.tensor(turn, dtype=torch.float64, device=device), world_columns(view, pose, device)[1][:, None]


def _paint(place: Tensor) -> Tensor:
    """A tone (3, n) for cars that stand at `place` (2, n) in the world, metres: most are grey, few red or blue."""
    waves = [
        torch.sin(2 * math.pi / length * (place[0] * math.cos(1.1 * k) + place[1] * math.sin(1.1 * k)) + k)
        for k, length in enumerate(PAINT_WAVES_M)
    ]
    bright, hue = (waves[0] + waves[1]) / 1.5, waves[2]
    grey = torch.where(bright > 0, bright * BRIGHTEST, -bright * DARKEST).clamp(DARKEST, BRIGHTEST)
    dull, coloured = (((hue.abs() - low) / (high - low)).clamp(0, 1) for low, high in (DULL, COLOURED))
    paint = torch.where(hue > 0, place.new_tensor(RED)[:, None], place.new_tensor(BLUE)[:, None])
    return torch.lerp(grey * (1 - dull), paint, coloured)
