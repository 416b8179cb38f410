"""A flat road, a wall all around and cars on the road, as a panorama shows them."""

from __future__ import annotations

import math

import torch

from lidar2pano.geometry.projection import headings_and_rises
from lidar2pano.scene.surfaces import slopes
from lidar2pano.views import View

ABOVE_M, FAR_M = 1.65, 40.0  # height of the viewpoint above the road; distance of the wall
ROAD, CAR, WALL = range(3)


LENGTH_M, WIDTH_M, HEIGHT_M = 4.2, 1.76, 1.46  # of a car


def box_distance(ray: torch.Tensor, slope: torch.Tensor, x: float, y: float, heading: float) -> torch.Tensor:
    """Distances from the axis (H, W) of a car on the road, infinite where it is not; by the slabs of its sides.

    ray  (2, W) horizontal directions;  slope: (H,) tangents of elevation.
    """
    turn = torch.tensor([[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]])
    direction = torch.cat(
        [(turn @ ray)[:, None].expand(-1, len(slope), -1), slope[None, :, None].expand(1, -1, ray.shape[1])]
    )
    start = torch.cat([-turn @ torch.tensor([x, y]), torch.tensor([ABOVE_M])])[:, None, None]
    low = torch.tensor([-LENGTH_M / 2, -WIDTH_M / 2, 0.0])[:, None, None]
    high = torch.tensor([LENGTH_M / 2, WIDTH_M / 2, HEIGHT_M])[:, None, None]
    first, second = (low - start) / direction, (high - start) / direction
    enter, leave = torch.minimum(first, second).amax(0), torch.maximum(first, second).amin(0)
    return torch.where((enter > 0) & (enter < leave), enter, math.inf)


def street(*places: tuple[float, float, float], view: View) -> tuple[torch.Tensor, torch.Tensor]:
    """Ids (H, W) and distances from the axis (H, W) of a flat road, a wall all around, and cars on the road."""
    slope = slopes(view)[:, None].expand(view.rows, view.columns)
    radius_m = torch.where(slope < 0, ABOVE_M / -slope, math.inf).clamp(max=FAR_M)
    ids = torch.where(radius_m < FAR_M, ROAD, WALL)
    ray = headings_and_rises(view)[0].float()
    for place in places:
        near = box_distance(ray, slopes(view), *place)
        ids = torch.where(near < radius_m, CAR, ids)
        radius_m = torch.minimum(near, radius_m)
    return ids, radius_m
