"""Whole cars for a panorama in which a LiDAR shows one side of each, with holes where windows and dark paint are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidar2pano.geometry.car_body import Boxes, Hits, first_hits, tones_of
from lidar2pano.geometry.car_fitting import (
    BARE,
    BESIDE_M,
    HALF,
    IN_FRONT_M,
    LENGTH_M,
    SAME_CAR,
    Measured,
    fitted,
    found_cars,
)
from lidar2pano.geometry.columns import world_columns
from lidar2pano.geometry.masks import as_float
from lidar2pano.geometry.surface import slopes
from lidar2pano.views import View

COVERED = 0.6  # least share of overlap in union of a car that is drawn
# Probabilities of what has to go where no body was drawn: less is no car, more is another, but for a car beside one.
FAINT, SURE = 0.02, 0.9
SHADE, SHADE_M, PALE = 0.35, 0.3, 0.01  # tone and breadth of the shadow beside a car; no shadow that is paler
PAINT_WAVES_M = (17.0, 27.0, 13.0)  # cars so far apart differ in paint
BRIGHTEST, DARKEST = 0.5, -0.2  # tones of white and of black paint
RED, BLUE = (0.0, -0.4, -0.3), (-0.25, -0.1, 0.15)  # tones of coloured paint, which is not bright
DULL, COLOURED = (0.35, 0.8), (0.8, 1.0)  # of the sine that says so: between white, grey and colours lies a metre


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


class Drawn(NamedTuple):
    """Bodies on a raster: nearest_m (H, W), their distance from the view's axis, inf elsewhere; tones (3, H, W)."""

    nearest_m: Tensor
    tones: Tensor


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
