"""What a car looks like: bodies of flat faces in boxes on the road, where rays meet them, and what is on their faces.

A body is two convex parts, each an intersection of half spaces: the lower body with bonnet and boot, and the cabin.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from operator import add
from typing import NamedTuple

import torch
from torch import Tensor

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
        """The cars that `index` picks of the last dimension."""
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
        at = ((end - reduce(add, (n * begin for n, begin, _ in parts))) / speed).clamp_(-NOWHERE_M, NOWHERE_M)
        out = speed.sign_().clamp_(min=0)  # 1 where the ray leaves, else 0: weights, for torch.where takes longer
        far = torch.minimum(far, torch.lerp(nowhere, at, out))
        at = torch.lerp(at, -nowhere, out)
        if faces:
            face = torch.where(at > near, number, face)
        near = torch.maximum(near, at)
    return torch.where((near < far) & (near > NEAREST_M), near, math.inf), face


def _planes(boxes: Boxes) -> tuple[list[Plane], list[Plane]]:
    """Half spaces n . x <= end from the middle on the road, of the lower body and of the cabin; None is 0."""
    boxes = Boxes(*(part[..., None, None] for part in boxes))
    nose, bonnet, belt, front, rear, screen, tail = _of_body(boxes)
    length, top, half = boxes.length_m, boxes.top_m, boxes.width_m / 2
    one = torch.ones_like(top)

    def face(place: Tensor, height: Tensor, next_place: Tensor, next_height: Tensor) -> Plane:
        """Upward from one height to the next, places behind the nose."""
        along, up = (place - next_place) * length, (next_height - height) * top
        size = torch.hypot(along, up)
        normal_along, normal_up = up / size, along.abs() / size
        return (normal_along, None, normal_up), normal_along * (0.5 - place) * length + normal_up * height * top

    corner, lean = math.sqrt(0.5) * one, math.hypot(1, LEAN)
    corner_end = (length / 2 + half - CORNER_M) * corner
    side_end, middle = (half * SHOULDER + LEAN * belt * top) / lean, (front + rear) / 2
    body: list[Plane] = [
        ((one, None, None), length / 2),
        ((-one, None, None), length / 2),
        ((None, one, None), half),
        ((None, -one, None), half),
        *(((a * corner, b * corner, None), corner_end) for a in (1, -1) for b in (1, -1)),
        ((None, None, one), belt * top * 1.03),
        ((None, None, -one), -FLOOR_M * one),
        face(0 * one, nose, bonnet, belt),
        face(screen, belt * 1.02, one, tail),
    ]
    cabin: list[Plane] = [
        ((None, None, -one), -belt * top * 0.97),
        face(bonnet, belt, front, one),
        face(rear, one * 0.97, screen, belt),
        ((None, one / lean, one * LEAN / lean), side_end),
        ((None, -one / lean, one * LEAN / lean), side_end),
        face(front, one * (1 - DROP), middle, one),
        face(middle, one, rear, one * (1 - DROP)),
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
