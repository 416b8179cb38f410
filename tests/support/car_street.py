"""A flat road, a wall all around and cars on the road, as a panorama shows them."""

from __future__ import annotations

import math

import torch

from lidar2pano.appearance.cars import Boxes, first_hits
from lidar2pano.scene.surfaces import slopes, world_columns
from lidar2pano.views import View

ABOVE_M, FAR_M = 1.65, 40.0  # height of the viewpoint above the road; distance of the wall
ROAD, CAR, WALL = range(3)


def box(x: float, y: float, heading: float) -> Boxes:
    measures = (torch.tensor([value]) for value in (4.2, 1.76, 1.46, 0.0))
    ahead = torch.tensor([[math.cos(heading)], [math.sin(heading)]])
    return Boxes(torch.tensor([[x], [y]]), ahead, *measures, torch.tensor([0]))


def street(*places: tuple[float, float, float], view: View) -> tuple[torch.Tensor, torch.Tensor]:
    """Ids (H, W) and distances from the axis (H, W) of a flat road, a wall all around, and hatchbacks on the road."""
    slope = slopes(view)[:, None].expand(view.rows, view.columns)
    radius_m = torch.where(slope < 0, ABOVE_M / -slope, math.inf).clamp(max=FAR_M)
    ids = torch.where(radius_m < FAR_M, ROAD, WALL)
    ray = world_columns(view, None, slope.device)[0].float()
    for place in places:
        near = first_hits(box(*place), ray[:, None], slopes(view)[None], torch.tensor(ABOVE_M)).distance_m[0].T
        ids = torch.where(near < radius_m, CAR, ids)
        radius_m = torch.minimum(near, radius_m)
    return ids, radius_m
