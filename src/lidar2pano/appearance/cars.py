"""Whole cars for a painter: boxes fitted to what a LiDAR shows of them, and the bodies drawn in these boxes.

The nearest surface of every column is cut into cars, and a rectangle is laid around each (the smallest in area, Zhang
et al. 2017). Of bodies of a car's size in places around it, moved step by step, the one is taken that covers best the
pixels of the car (analysis by synthesis). A LiDAR shows one side of a car, with holes where windows and dark paint are.
A body is two convex parts, each an intersection of half spaces: the lower body with bonnet and boot, and the cabin.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from itertools import product
from operator import add
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool1d, pad

from lidar2pano.geometry.rasters import as_float
from lidar2pano.labels import COMMON15
from lidar2pano.scene.record import Scene
from lidar2pano.scene.surfaces import cylinder_points, median_around, slopes, surface_profile, world_columns
from lidar2pano.views import View

# Of each body: height of the nose, bonnet's end, height of the belt, front and rear end of the roof, foot of the rear
# screen, height of the tail. Heights are shares of the roof's, places shares of the length behind the nose.
BODIES = {
    "hatchback": (0.55, 0.27, 0.67, 0.46, 0.86, 0.975, 0.63),
    "saloon": (0.54, 0.27, 0.67, 0.46, 0.73, 0.87, 0.68),
    "van": (0.53, 0.16, 0.63, 0.34, 0.955, 0.99, 0.58),
}
TALL_M = (1.62, 1.8)  # roofs: hatchbacks and saloons are lower than the second, vans higher than the first
CORNER_M, FLOOR_M = 0.38, 0.1  # cut off the corners, seen from above; height of the lowest point
LEAN, SHOULDER = 0.28, 0.95  # of the cabin's sides, metres inwards per metre up; their distance at the belt
DROP = 0.04  # share of its height by which a roof falls towards its ends
AXLES, TYRE_M, RIM_M, WHEEL_M = (0.19, 0.80), 0.38, 0.19, 0.31  # places; radii; height of the wheels' middle
FRAME_M, PILLAR, PANES_TOP = 0.09, 0.012, 0.94  # around screens; half a pillar between doors; of the panes
LAMP_M, PLATE_M, UNDER_M = 0.55, 0.26, 0.2  # width of lamps, half a number plate's, height below which it is dark
SIDES, BELT, FLOOR, CABIN, SCREENS, ROOF = (2, 8), 8, 9, 12, (13, 15), 17  # numbers of faces: see `_planes`
NEAREST_M, NOWHERE_M = 0.1, 1e9
# How much brighter than the mean car parts are, in colours from -1 to 1.
SKYWARD, SHADED, TYRE, RIM, UNDER, GRILLE, PLATE = 0.18, 0.2, -0.5, -0.12, -0.55, -0.45, 0.4
GLASS, SCREEN_LIGHT, HEAD_LAMP, TAIL_LAMP = (-0.32, -0.3, -0.27), 0.3, (0.35, 0.35, 0.38), (0.2, -0.35, -0.35)


Plane = tuple[tuple[Tensor | None, Tensor | None, Tensor | None], Tensor]  # normal (along, left, up) and end
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


class Boxes(NamedTuple):
    """Cars by the boxes around them, metres, from above in the axes of the panorama's viewpoint.

    middle, ahead  (2, ...): centre, and the unit vector from tail to nose;  length_m, width_m, top_m: (...).
    base_m  (...): height of the wheels' lowest point above the road;  body: (...) int64, number in BODIES.
    """

    middle: Tensor
    ahead: Tensor
    length_m: Tensor
    width_m: Tensor
    top_m: Tensor
    base_m: Tensor
    body: Tensor

    @property
    def left(self) -> Tensor:
        """The unit vectors (2, ...) to the left of `ahead`."""
        return torch.stack([-self.ahead[1], self.ahead[0]])

    def of(self, index: Tensor) -> Boxes:
        """The cars of an index into the last dimension."""
        return Boxes(*(part[..., index] for part in self))


class Hits(NamedTuple):
    """Where rays first meet a body, each (..., Q, R): horizontal distance, inf where they miss it; number of the face.

    behind   share of the length behind the nose;  aside_m: to the left of the middle;  height_m: above its base.
    """

    distance_m: Tensor
    face: Tensor
    behind: Tensor
    aside_m: Tensor
    height_m: Tensor


def distances(boxes: Boxes, ray: Tensor, slope: Tensor, above_m: Tensor) -> Tensor:
    """Only the distances (..., Q, R) of `first_hits`, in less time."""
    steps, start = _from_viewpoint(boxes, ray, slope, above_m)
    body, cabin = (_entered(part, start, steps, faces=False)[0] for part in _planes(boxes))
    return torch.minimum(body, cabin)


def first_hits(boxes: Boxes, ray: Tensor, slope: Tensor, above_m: Tensor) -> Hits:
    """Cast Q x R rays at each body.

    ray      (2, ..., Q): unit vectors of the columns from above;  slope: (..., R), tangents of the rows' elevations.
    above_m  how high the viewpoint is above the road.
    """
    steps, start = _from_viewpoint(boxes, ray, slope, above_m)
    (near, face), (at_cabin, of_cabin) = (_entered(part, start, steps, faces=True) for part in _planes(boxes))
    face = torch.where(at_cabin < near, of_cabin + CABIN, face)
    near = torch.minimum(near, at_cabin)
    along, aside, height = (begin + near * step for begin, step in zip(start, steps, strict=True))
    return Hits(near, face, 0.5 - along / boxes.length_m[..., None, None], aside, height)


def _from_viewpoint(
    boxes: Boxes, ray: Tensor, slope: Tensor, above_m: Tensor
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Rays' steps along, to the left and up in the axes of each box, and where they start from its middle."""
    along, aside = ((ray * axis[..., None]).sum(0)[..., None] for axis in (boxes.ahead, boxes.left))
    start = (-(boxes.middle * boxes.ahead).sum(0), -(boxes.middle * boxes.left).sum(0), above_m - boxes.base_m)
    return (along, aside, slope[..., None, :]), tuple(part[..., None, None] for part in start)


def _entered(
    planes: Sequence[Plane], start: tuple[Tensor, ...], steps: tuple[Tensor, ...], faces: bool
) -> tuple[Tensor, Tensor]:
    """Where rays enter the convex part n . x <= e of all planes (n, e): distance, inf where they do not; the plane."""
    near, far, nowhere = start[0].new_tensor([NEAREST_M, NOWHERE_M, NOWHERE_M]).unbind()
    face = torch.zeros((), dtype=torch.int64, device=near.device)
    for number, (normal, end) in enumerate(planes):  # upright planes first: their terms are the same in all rows
        parts = [(n, begin, step) for n, begin, step in zip(normal, start, steps, strict=True) if n is not None]
        speed = reduce(add, (n * step for n, _, step in parts))
        distance = ((end - reduce(add, (n * begin for n, begin, _ in parts))) / speed).clamp_(-NOWHERE_M, NOWHERE_M)
        out = speed.sign_().clamp_(min=0)  # 1 where the ray leaves, else 0: weights, for torch.where takes longer
        far = torch.minimum(far, torch.lerp(nowhere, distance, out))
        distance = torch.lerp(distance, -nowhere, out)
        if faces:
            face = torch.where(distance > near, number, face)
        near = torch.maximum(near, distance)
    return torch.where((near < far) & (near > NEAREST_M), near, math.inf), face


def _planes(boxes: Boxes) -> tuple[list[Plane], list[Plane]]:
    """Half spaces n . x <= end from the middle on the road, of the lower body and of the cabin; None is 0."""
    boxes = Boxes(*(part[..., None, None] for part in boxes))
    nose, bonnet, belt, front, rear, screen, tail = _of_body(boxes)
    length, top, half = boxes.length_m, boxes.top_m, boxes.width_m / 2
    plane = torch.ones_like(top)

    def face(place: Tensor, height: Tensor, next_place: Tensor, next_height: Tensor) -> Plane:
        """Upward from one height to the next, places behind the nose."""
        along, up = (place - next_place) * length, (next_height - height) * top
        size = torch.hypot(along, up)
        normal_along, normal_up = up / size, along.abs() / size
        return (normal_along, None, normal_up), normal_along * (0.5 - place) * length + normal_up * height * top

    corner, lean = math.sqrt(0.5) * plane, math.hypot(1, LEAN)
    corner_end = (length / 2 + half - CORNER_M) * corner
    side_end, middle = (half * SHOULDER + LEAN * belt * top) / lean, (front + rear) / 2
    body: list[Plane] = [
        ((plane, None, None), length / 2),
        ((-plane, None, None), length / 2),
        ((None, plane, None), half),
        ((None, -plane, None), half),
        *(((a * corner, b * corner, None), corner_end) for a in (1, -1) for b in (1, -1)),
        ((None, None, plane), belt * top * 1.03),
        ((None, None, -plane), -FLOOR_M * plane),
        face(0 * plane, nose, bonnet, belt),
        face(screen, belt * 1.02, plane, tail),
    ]
    cabin: list[Plane] = [
        ((None, None, -plane), -belt * top * 0.97),
        face(bonnet, belt, front, plane),
        face(rear, plane * 0.97, screen, belt),
        ((None, plane / lean, plane * LEAN / lean), side_end),
        ((None, -plane / lean, plane * LEAN / lean), side_end),
        face(front, plane * (1 - DROP), middle, plane),
        face(middle, plane, rear, plane * (1 - DROP)),
    ]
    return body, cabin


def off_axle(boxes: Boxes, hits: Hits) -> Tensor:
    """Distance from the nearer axle in a car's side view, metres: boxes and hits of one shape."""
    aside = torch.minimum(*((hits.behind - axle).abs() for axle in AXLES)) * boxes.length_m
    return torch.hypot(aside, hits.height_m - WHEEL_M)


def _of_body(boxes: Boxes) -> tuple[Tensor, ...]:
    """The columns of BODIES for each car."""
    return boxes.top_m.new_tensor(list(BODIES.values()))[boxes.body].unbind(-1)


def tones_of(boxes: Boxes, hits: Hits, paint: Tensor) -> Tensor:
    """How much brighter than the mean car what rays hit is in red, green and blue, (3, N).

    boxes, hits  N of them: the car of each hit;  paint: (3, N), of the car.
    """
    height, face = hits.height_m / boxes.top_m, hits.face
    cabin = face >= CABIN
    upward = torch.where(cabin, face >= ROOF, (face == BELT) | (face > FLOOR))
    low = ((0.55 - hits.height_m) / 0.5).clamp(0, 1) * ~(cabin | upward)
    tone = paint + (SKYWARD * upward - SHADED * low)
    tone = _glazed(tone, boxes, hits, height)
    flank = (face >= SIDES[0]) & (face < SIDES[1])
    axle_m = off_axle(boxes, hits)
    tone = torch.where((hits.height_m < UNDER_M) & ~cabin, UNDER, tone)
    tone = torch.where(flank & (axle_m < TYRE_M), TYRE, tone)
    tone = torch.where(flank & (axle_m < RIM_M), RIM, tone)
    lamps = boxes.width_m / 2 - hits.aside_m.abs() < LAMP_M
    nose, tail = face == 0, face == 1
    tone = torch.where(nose & ~lamps & (height > 0.26) & (height < 0.46), GRILLE, tone)
    tone = _coloured(tone, nose & lamps & (height > 0.40) & (height < 0.52), HEAD_LAMP)
    tone = _coloured(tone, tail & lamps & (height > 0.48) & (height < 0.60), TAIL_LAMP)
    plate = (hits.aside_m.abs() < PLATE_M) & (hits.height_m > 0.42) & (hits.height_m < 0.53)
    return torch.where((nose | tail) & plate, PLATE, tone)


def _glazed(tone: Tensor, boxes: Boxes, hits: Hits, height: Tensor) -> Tensor:
    """Tones with windscreen, rear screen and side windows."""
    _, bonnet, belt, front, rear, foot, _ = _of_body(boxes)
    up = (height - belt) / (1 - belt)
    half = boxes.width_m / 2 * SHOULDER - LEAN * (height - belt) * boxes.top_m
    screens = (hits.face >= SCREENS[0]) & (hits.face < SCREENS[1])
    screen = screens & (hits.aside_m.abs() < half - FRAME_M)
    frame = FRAME_M / 3 / boxes.length_m + 0.02
    side = (hits.behind > bonnet + (front - bonnet) * up + frame) & (hits.behind < foot - (foot - rear) * up - frame)
    side &= (hits.behind - (front + rear) / 2 - 0.03).abs() > PILLAR
    side &= (hits.face >= SCREENS[1]) & (hits.face < ROOF)
    light = SCREEN_LIGHT * up.clamp(0, 1) * screen
    pane = (height > belt + 0.02) & (height < PANES_TOP)
    return torch.where(pane & (screen | side), tone.new_tensor(GLASS)[:, None] + light, tone)


def _coloured(tone: Tensor, where: Tensor, colour: tuple[float, ...]) -> Tensor:
    return torch.where(where, tone.new_tensor(colour)[:, None], tone)


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
    """The nearest cars of enough columns; arguments as of Measured."""
    rows = slice(EVERY // 2, None, EVERY)
    slope, radii_m = slopes(view, device=cars.device)[:, None], radius_m[rows]
    height_m, over_edge_m = radii_m * slope[rows] + above_m, radii_m * (slope[rows] - slope[-1])
    inside = (height_m > LOWEST_M) & (height_m < HIGHEST_M) & (radii_m < FARTHEST_M)
    low, close = height_m < BELT_M, radii_m < BESIDE_M
    profile, total = _profile(cars[rows] * (inside & low), radii_m)
    nearest, near = _profile(cars[rows] * (inside & close & (low | (over_edge_m < CUT_M))), radii_m, NEARNESS)
    nearest, has_car = _without_windows(nearest), _closed(torch.maximum(total, near) > LEAST)
    distance_m = torch.where(nearest < math.log(BESIDE_M), nearest, profile).exp()
    ray, _ = world_columns(view, None, cars.device)
    point = (distance_m * ray.to(distance_m)).nan_to_num(0)
    gap_m = torch.where(distance_m < BESIDE_M, GAP_BESIDE_M, GAP_M + GAP * distance_m)
    apart = torch.hypot(*(point - point.roll(1, 1)).unbind(0)) > gap_m
    number = _cut(point, _numbers(apart | ~has_car | ~has_car.roll(1)))
    tops = torch.where((cars[rows] > HALF) & inside, height_m, 0).amax(0)
    tops = median_around(torch.where(has_car, tops, torch.nan)[None], REACH)[0].nan_to_num(0)
    top_m, mean_m = _over(number, tops, "amax"), _over(number, distance_m.nan_to_num(torch.inf), "mean")
    enough = has_car & (_over(number, has_car.float(), "sum") >= COLUMNS) & (top_m > TOP_M[0] / 2)
    column = torch.arange(len(number), device=number.device)
    column = column[enough & (_over(number, column, "amin") == column)]  # one of each car
    column = column[mean_m[column].argsort()[:MOST]]
    parts = (*_rectangles(point, number), top_m.clamp(*TOP_M), mean_m, number)
    measured = Measured(cars, ground, radius_m, above_m, torch.where(has_car, number, -1), view)
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


def _closed(columns: Tensor) -> Tensor:
    """Columns (W,) bool with gaps of at most 2 x HOLE columns closed; circular."""
    shifts = range(-HOLE, HOLE + 1)
    grown = torch.stack([columns.roll(shift) for shift in shifts]).any(0)
    return torch.stack([grown.roll(shift) for shift in shifts]).all(0)


def fitted(cars: Found, measured: Measured, earlier: Boxes | None = None) -> tuple[Boxes, Tensor]:
    """The box (n,) of each car that fits best, and the overlap of its body with the car in the picture, in [0, 1].

    earlier  (m,): boxes of the scan before. A car keeps its own unless another one fits better by KEPT, so that what
             stands does not waver in a drive; then the overlap counts KEPT more.
    """
    sample = _sampled(cars, measured)
    boxes, score, covered = _best(_placed(cars, measured), sample)
    for step in ROUNDS:
        if step == TURN:
            boxes, score, covered = _best(_turned(boxes, cars.top_m), sample)
        boxes, score, covered = _nudged(boxes, score, covered, step, sample)
    if earlier is None:
        return boxes, covered
    apart_m, nearest = torch.cdist(boxes.middle.T, earlier.middle.T).min(1)
    pairs = _alternatives([boxes, earlier.of(nearest)])
    scores, shares = _scores(pairs, sample)
    scores[:, 1] += torch.where(apart_m < SAME_PLACE_M, KEPT, -math.inf)
    shares[:, 1] += KEPT
    boxes, _, covered = _picked(pairs, scores, shares)
    return boxes, covered


def _placed(cars: Found, measured: Measured) -> Boxes:
    """Candidate boxes (n, 12) of the visible parts of cars: two directions, three places along, two across."""
    made, in_view_m = [], measured.above_m + cars.distance_m * slopes(measured.view)[-1]
    sideways = (cars.length_m > WIDEST_M) & (in_view_m > CUT_FROM_M)
    for lengthwise, ends in product((True, False), product((1.0, 0.0, -1.0), (1.0, 0.0))):
        across = torch.stack([-cars.axis[1], cars.axis[0]])
        along = lengthwise | sideways
        axes = torch.where(along, cars.axis, across), torch.where(along, across, cars.axis)
        visible = torch.where(along, cars.length_m, cars.width_m), torch.where(along, cars.width_m, cars.length_m)
        middle, sizes = cars.middle, []
        for axis, extent, end, limits in zip(axes, visible, ends, (LENGTH_M, WIDTH_M), strict=True):
            size = extent.clamp(*limits)
            away = (cars.middle * axis).sum(0).sign()
            middle = middle + axis * (end * away * (size - extent) / 2)
            sizes.append(size)
        base_m, body = torch.zeros_like(cars.top_m), (cars.top_m > TALL_M[1]).long() * 2
        made.append(Boxes(middle, axes[0], sizes[0], sizes[1], cars.top_m, base_m, body))
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
    """The boxes, moved by a step of MOVES there or back where it helps: the best one alone, or all at once."""
    tried = [_moved(boxes, move, sign * step) for move, sign in product(range(len(MOVES)), (1, -1))]
    single_scores, covered_by_each = _scores(_alternatives(tried), sample)
    forth, back = single_scores[:, ::2], single_scores[:, 1::2]
    better = torch.maximum(forth, back) > score[:, None]
    shift = torch.where(better, torch.where(forth > back, step, -step), 0.0)
    joint = boxes
    for move in range(len(MOVES)):
        joint = _moved(joint, move, shift[:, move])
    of_joint, covered_by_joint = _scores(_alternatives([joint]), sample)
    scores = torch.cat([score[:, None], of_joint, single_scores], 1)
    shares = torch.cat([covered[:, None], covered_by_joint, covered_by_each], 1)
    return _picked(_alternatives([boxes, joint, *tried]), scores, shares)


def _moved(boxes: Boxes, move: int, step: Tensor | float) -> Boxes:
    """The boxes, moved by a step (n,) of MOVES."""
    shift = step * torch.full_like(boxes.top_m, MOVES[move])
    match move:
        case 0 | 1:
            return boxes._replace(middle=boxes.middle + shift * (boxes.ahead, boxes.left)[move])
        case 2:
            return boxes._replace(ahead=shift.cos() * boxes.ahead + shift.sin() * boxes.left)
        case 3:
            return boxes._replace(base_m=boxes.base_m + shift)
        case _:
            return boxes._replace(length_m=(boxes.length_m + shift).clamp(*LENGTH_M))


def _sampled(cars: Found, measured: Measured) -> Sample:
    view, device = measured.view, measured.cars.device
    azimuth = torch.atan2(cars.middle[1], cars.middle[0])[:, None]
    half = (AROUND_M + cars.length_m / 2) / cars.distance_m
    angle = azimuth + half.clamp(max=1.5)[:, None] * torch.linspace(1, -1, ACROSS, device=device)
    rows = slopes(view, device=device)
    highest = ((cars.top_m + OVER_M - measured.above_m) / cars.distance_m).clamp(max=rows[0])
    lowest = (-measured.above_m / (0.85 * cars.distance_m)).clamp(min=rows[-1])
    share = torch.linspace(0.02, 0.98, DOWN, device=device)
    slope = highest[:, None] + (lowest - highest)[:, None] * share
    column = torch.remainder(math.radians(view.left) - angle, 2 * math.pi) * view.focal_px
    inside = (column < view.columns)[:, :, None]
    column = column.long().clamp(max=view.columns - 1)[:, :, None]
    row = _row(slope, view)[:, None]
    car, ground, radius_m = (part[row, column] for part in (measured.cars, measured.ground, measured.radius_m))
    owner = measured.number[column]
    farther, own = (radius_m / cars.distance_m[:, None, None]).log(), owner == cars.number[:, None, None]
    through = torch.where(cars.distance_m < BESIDE_M, THROUGH_WINDOWS, THROUGH_GLASS)[:, None, None]
    on_car = (farther > -SAME_CAR) & (farther < torch.where(own, through, SAME_CAR)) & (own | (owner < 0))
    ray = torch.stack([angle.cos(), angle.sin()])[:, :, None]
    is_car = (car > HALF) & on_car
    hides_m = torch.where(is_car | (ground > HALF), math.inf, radius_m + IN_FRONT_M)
    parts = (is_car, radius_m, hides_m, ground > BARE, inside)
    return Sample(ray, slope[:, None], measured.above_m, *(part[:, None] for part in parts))


def _row(slope: Tensor, view: View) -> Tensor:
    """Rows int64 of a view, of directions with these tangents."""
    height = torch.rad2deg(torch.atan(slope)) if view.kind == "sphere" else slope
    return ((view.up - height) / (view.up - view.down) * view.rows).long().clamp(0, view.rows - 1)


def _scores(boxes: Boxes, sample: Sample) -> tuple[Tensor, Tensor]:
    """How well each of the boxes (n, K) fits, and the share of overlap in union."""
    distance_m = distances(boxes, sample.ray, sample.slope, sample.above_m)
    hit = distance_m.isfinite()
    hidden = (distance_m > sample.hides_m) & hit
    counts = sample.counts & ~hidden
    inside = hit & sample.car & sample.counts
    overlap = inside.sum((-1, -2))
    union = ((hit | sample.car) & counts).sum((-1, -2)).clamp(min=1)
    wrong = (hit & sample.bare & counts).sum((-1, -2))
    farther = (distance_m / sample.radius_m - 1).abs().clamp(max=SAME_CAR)
    off = (farther * inside).nan_to_num(0).sum((-1, -2)) / overlap.clamp(min=1)
    return overlap / (union + wrong) - OFF * off, overlap / union


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
    reduced = torch.zeros_like(values).scatter_reduce(-1, index, values, how, include_self=False)
    return reduced.gather(-1, index)


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
    for probabilities, depth, radius, height_m in zip(segments, depth_m, radius_m, above_m, strict=True):
        whole = WholeCars(probabilities, depth, probabilities.new_full((3, *depth.shape), math.nan))
        made.append(_whole(whole, radius, height_m, view, T_world_sensor, classes, earlier))
    if len(made) == 1:  # without another copy
        (single,) = made
        return WholeCars(single.segments[None], single.depth_m[None], single.tones[None], single.boxes)
    segments, depth_m, tones = (torch.stack(parts) for parts in list(zip(*made, strict=True))[:3])
    return WholeCars(segments, depth_m, tones)


def _whole(  # noqa: PLR0913, PLR0917 as above
    whole: WholeCars,
    radius_m: Tensor,
    above_m: Tensor,
    view: View,
    pose: np.ndarray | None,
    classes: Classes,
    earlier: Boxes | None,
) -> WholeCars:
    device, ground = radius_m.device, whole.segments[list(classes.ground)].sum(0)
    cars = whole.segments[classes.car]
    rectangles, measured = found_cars(cars.cpu(), ground.cpu(), radius_m.cpu(), above_m.cpu(), view)  # many small steps
    if len(rectangles.number) == 0:
        return whole
    boxes, covered = fitted(rectangles, measured, None if earlier is None else _in_view(earlier, view, pose))
    good = _apart(boxes, covered)
    if not bool(good.any()):
        return whole
    other_vehicles = whole.segments[list(classes.others)].sum(0)
    boxes = boxes.of(good)
    world, boxes = _in_world(boxes, view, pose), Boxes(*(part.to(device) for part in boxes))
    measured = Measured(cars, ground, radius_m, above_m, measured.number.to(device), view)
    drawn = _drawn(boxes, measured, other_vehicles, world.middle.to(radius_m))
    inside = drawn.nearest_m.isfinite()
    gone = _outside(measured, other_vehicles, drawn.nearest_m, rectangles.number[good].to(device))
    segments, radius_m = _without(whole.segments, measured, gone, inside, classes)
    segments.mul_(as_float(~inside))
    segments[classes.car].masked_fill_(inside, 1)
    radius_m = torch.where(inside, drawn.nearest_m, radius_m)
    along_ray = torch.sqrt(1 + slopes(view, device=radius_m.device)[:, None].square())
    depth_m = torch.where(radius_m == measured.radius_m, whole.depth_m, radius_m * along_ray)
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


def _drawn(boxes: Boxes, measured: Measured, other_vehicles: Tensor, place: Tensor) -> Drawn:
    """Cars' bodies where nothing hides them and no other vehicle (H, W) is likelier, and the shadows beside them.

    place  (2, n) in the world, metres, from which each car has its paint.
    """
    view = measured.view
    car, column = _columns(boxes, view)
    car_boxes, slope = boxes.of(car), slopes(view, device=car.device)
    ray = world_columns(view, None, car.device)[0].to(slope)[:, column, None]
    first = int((slope > _highest(boxes, measured.above_m)).sum())
    hits = first_hits(car_boxes, ray, slope[first:].expand(len(car), -1), measured.above_m)
    distance_m = hits.distance_m[:, 0]  # (pairs of car and column, rows from `first` on)
    is_car, ground, radius_m, other_vehicles = (part[first:].T[column] for part in (*measured[:3], other_vehicles))
    near = (radius_m / distance_m).log().abs() < SAME_CAR
    visible = ((is_car > HALF) & near) | (radius_m > distance_m - IN_FRONT_M) | (ground > HALF)
    visible &= (ground < BARE) & ~((other_vehicles > is_car) & near)
    distance_m = torch.where(visible, distance_m, math.inf)
    nearest = distance_m.new_full((view.columns, distance_m.shape[1]), math.inf)
    nearest.scatter_reduce_(0, column[:, None].expand_as(distance_m), distance_m, "amin")
    pair, row = (distance_m.isfinite() & (distance_m == nearest[column])).nonzero(as_tuple=True)
    chosen = Hits(*(part.expand(hits.distance_m.shape)[pair, 0, row] for part in hits))
    tones = _shaded(car_boxes, column, measured, ray[..., 0])
    tones[:, row + first, column[pair]] = tones_of(car_boxes.of(pair), chosen, _paint(place)[:, car[pair]])
    empty_rows = nearest.new_full((first, view.columns), math.inf)
    return Drawn(torch.cat([empty_rows, nearest.T]), tones)


def _highest(boxes: Boxes, above_m: Tensor) -> Tensor:
    """The tangent of the highest elevation with a car in view."""
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


def _shaded(car_boxes: Boxes, column: Tensor, measured: Measured, ray: Tensor) -> Tensor:
    """Tones (3, H, W) of the ground in the shadow beside cars, NaN elsewhere; ray: (2, P), of the columns (P,)."""
    radius_m = measured.radius_m[:, column]
    out = [
        (radius_m * (ray * axis).sum(0) - (car_boxes.middle * axis).sum(0)).abs() - size / 2
        for axis, size in ((car_boxes.ahead, car_boxes.length_m), (car_boxes.left, car_boxes.width_m))
    ]
    gap_m = torch.hypot(*(part.clamp(min=0) for part in out))
    tone = -SHADE * torch.exp(-(gap_m / SHADE_M).square()) * (measured.ground[:, column] > HALF)
    darkest = torch.zeros_like(measured.radius_m).scatter_reduce(1, column.expand_as(tone), tone, "amin")
    return torch.where(darkest < -PALE, darkest, math.nan).expand(3, -1, -1).clone()


def _outside(measured: Measured, other_vehicles: Tensor, nearest_m: Tensor, numbers: Tensor) -> Tensor:
    """Pixels (H, W) bool outside of drawn bodies, perhaps of a car, and likelier so than of another vehicle."""
    inside = nearest_m.isfinite()
    mean_m = torch.where(inside, nearest_m, 0).sum(0) / inside.sum(0)  # NaN where no body was drawn
    near = (measured.radius_m / mean_m).log().abs() < SAME_CAR
    own = (measured.number < 0) | torch.isin(measured.number, numbers)
    some = (measured.cars > FAINT) & ((measured.cars < SURE) | (mean_m < BESIDE_M))
    return near & own & ~inside & some & (other_vehicles < measured.cars)


def _without(
    segments: Tensor, measured: Measured, gone: Tensor, inside: Tensor, classes: Classes
) -> tuple[Tensor, Tensor]:
    """Copies of segments and distances, with the background where a car is `gone`.

    That is as far away as what is next above it; the ground is where it was.
    """
    segments, radius_m = segments.clone(), measured.radius_m.clone()
    rest = segments[:, gone]
    rest[[classes.car, *classes.others]] = 0
    segments[:, gone] = rest / rest.sum(0).clamp(min=1e-9)
    column = gone.any(0).nonzero()[:, 0]
    upright = (segments[list(classes.ground)][..., column].sum(0) < HALF) & (gone | inside)[:, column]
    rows = torch.arange(len(gone), device=gone.device)[:, None].expand_as(upright)
    upper_row = torch.where(upright, -1, rows).cummax(0).values
    old = radius_m[:, column]
    behind = torch.maximum(old.gather(0, upper_row.clamp(min=0)), old)
    radius_m[:, column] = torch.where(gone[:, column] & upright & (upper_row >= 0), behind, old)
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
    """A tone (3, n) for cars at `place` (2, n) in the world, metres: most are grey, few red or blue."""
    waves = [
        torch.sin(2 * math.pi / length * (place[0] * math.cos(1.1 * k) + place[1] * math.sin(1.1 * k)) + k)
        for k, length in enumerate(PAINT_WAVES_M)
    ]
    bright, hue = (waves[0] + waves[1]) / 1.5, waves[2]
    grey = torch.where(bright > 0, bright * BRIGHTEST, -bright * DARKEST).clamp(DARKEST, BRIGHTEST)
    dull, coloured = (((hue.abs() - low) / (high - low)).clamp(0, 1) for low, high in (DULL, COLOURED))
    paint = torch.where(hue > 0, place.new_tensor(RED)[:, None], place.new_tensor(BLUE)[:, None])
    return torch.lerp(grey * (1 - dull), paint, coloured)
