"""Depths that keep to what the sensor measured, where a translator's are right on average only.

A translator that learns depths from some pixels of each frame blurs them: neighbouring rows of one wall differ by a
fifth. What hangs on depths (normals, texture in the world, windows, cars) then wavers from row to row and from scan to
scan. Here every pixel takes the distance of a measured surface of its column; the translator says which one.
On a cylinder the inverse of the horizontal distance is linear in the row, on every plane: it is what is interpolated.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lidar2pano.geometry.columns import rows_beside
from lidar2pano.geometry.masks import as_float, either
from lidar2pano.geometry.surface import cylinder_points, slopes, viewpoint_height
from lidar2pano.views import View

LEAST_M = 0.5  # horizontal distance: points nearer to the axis are on the vehicle itself
ONE_SURFACE = 1.25  # ratio of distances below which two points above each other are taken to be of one surface
ON_ROAD = 1.2  # likewise, below which a point is taken to lie on the road's plane
TOPMOST_PX = 2  # columns on either side whose points say how far what stands above a column's own points is
EVEN_PX = (1, 2, 4)  # how far on either side lies what is averaged on a surface: noise, and rings out of line
ON_PLANE = 0.03  # share of the inverse distance by which the mean of two opposite pixels may differ on one surface
CROWN_PX = 12  # likewise, for crowns: a mean, for their own points lie near and far at random
CROWN_GUESSED = 0.1  # power of the translator's distances in those of crowns, which are nearer than their lowest twigs
FARTHEST_M = 1000.0


def measured_depth(depth_m: Tensor, channels: Tensor, ids: Tensor, view: View, road: int, soft: int) -> Tensor:
    """Depths (B, H, W) float32, metres along the ray, in which what was measured stays.

    depth_m   (B, H, W): those of a translator;  channels: (B, 5, H, W) of a RangeImage on the same raster.
    ids       (B, H, W): classes, of which `road` is the road's;  view: the raster, a cylinder; others stay as they are.

    A pixel with a point has its distance. Between two points of a column lies their surface, if they are of one; else
    the upper one's, straight down, or the lower one's, straight up or along the road: that which the translator's depth
    is nearer to. Below a column's lowest point its surface goes on down to the road. Above its topmost, its surface
    goes on up, as far as the pixels are of its class: trees and houses stand above their trunks and doors. A crown has
    the translator's say as well. Where that is not so, and in columns without points, the translator's depth remains.
    """
    if view.kind != "cylinder":
        return depth_m.float()
    guessed_m, z_m = cylinder_points(depth_m, view)
    measured_m = torch.hypot(channels[:, 1].float(), channels[:, 2].float())
    inverse = as_float(measured_m > LEAST_M) / measured_m.clamp(min=LEAST_M)
    height_m = viewpoint_height(guessed_m, z_m, ids == road, view)
    slope = slopes(view, device=depth_m.device)
    plane = (-slope / height_m.clamp(min=LEAST_M)[:, None]).clamp(min=1 / FARTHEST_M)  # (B, H), inverse distances
    guessed = 1 / guessed_m.clamp(min=LEAST_M)
    found = _between(inverse, guessed, plane)
    found = either(found > 0, found, _above(inverse, guessed, ids, soft))
    return torch.sqrt(1 + slope * slope)[:, None] / _evened(found)


def _between(inverse: Tensor, guessed: Tensor, plane: Tensor) -> Tensor:
    """Inverse distances (B, H, W) between and below a column's points, zero above them."""
    rows = inverse.shape[1]
    row = torch.arange(rows, device=inverse.device)[:, None]
    above, below = rows_beside(inverse > 0)
    first, last = above.clamp(min=0), below.clamp(max=rows - 1)
    upper, lower = inverse.gather(1, first), inverse.gather(1, last)
    share = (row - above) / (below - above).clamp(min=1)
    one_surface = torch.maximum(upper, lower) < ONE_SURFACE * torch.minimum(upper, lower)
    along = _along(lower, last, plane)
    nearer_upper = (guessed.square() > upper * along) == (upper > along)  # by the logarithm
    between = either(one_surface, upper + (lower - upper) * share, either(nearer_upper, upper, along))
    under = torch.maximum(_along(upper, first, plane), plane[:, :, None])
    return either(below < rows, between, under).mul_(as_float(above >= 0))


def _along(inverse: Tensor, row: Tensor, plane: Tensor) -> Tensor:
    """Inverse distances (B, H, W) of surfaces met in other rows: level where it was the road, else upright."""
    there = plane.gather(1, row.flatten(1)).view_as(inverse)
    lift = inverse / there
    return either((lift > 1 / ON_ROAD) & (lift < ON_ROAD), plane[:, :, None] * lift, inverse)


def _above(inverse: Tensor, guessed: Tensor, ids: Tensor, soft: int) -> Tensor:
    """Inverse distances (B, H, W) of what stands above a column's topmost point: its own, in pixels of its class."""
    near = inverse
    for away in range(1, TOPMOST_PX + 1):
        beside = torch.maximum(inverse.roll(away, 2), inverse.roll(-away, 2))
        near = either(near > 0, near, beside)
    there = near > 0
    top = there.int().argmax(1, keepdim=True)  # the first
    known, topmost, own = there.any(1, keepdim=True), near.gather(1, top), ids.gather(1, top)
    total, count = torch.zeros_like(topmost), torch.zeros_like(topmost)
    for away in range(-CROWN_PX, CROWN_PX + 1):
        alike = known.roll(away, 2) & (own.roll(away, 2) == soft)
        total += topmost.roll(away, 2) * alike
        count += alike
    crown = (total / count.clamp(min=1)).pow(1 - CROWN_GUESSED) * guessed.pow(CROWN_GUESSED)
    topmost = torch.where(own == soft, crown, topmost)
    return either((ids == own) & known, topmost, guessed)


def _evened(inverse: Tensor) -> Tensor:
    """Means (B, H, W) over opposite pixels, along columns, then rows: on a plane, the value between them is their mean.

    Where it is not, by more than ON_PLANE, a border lies between them, and they do not count.
    """
    total, count = inverse.clone(), torch.ones_like(inverse)
    for away in EVEN_PX:
        inner = slice(away, -away)
        _add_even(total[:, inner], count[:, inner], inverse[:, inner], inverse[:, : -2 * away], inverse[:, 2 * away :])
    inverse = total.div_(count)
    total, count = inverse.clone(), torch.ones_like(inverse)
    for away in EVEN_PX:
        _add_even(total, count, inverse, inverse.roll(away, 2), inverse.roll(-away, 2))
    return total.div_(count)


def _add_even(total: Tensor, count: Tensor, middle: Tensor, one: Tensor, other: Tensor) -> None:
    """Add the mean of two opposite pixels to `total`, and 1 to `count`, where it is near the value in their middle."""
    mean = torch.add(one, other).mul_(0.5)
    even = as_float((mean - middle).abs_() < ON_PLANE * middle)
    total.add_(mean.mul_(even))
    count.add_(even)
