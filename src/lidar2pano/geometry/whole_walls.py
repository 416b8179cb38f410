"""Walls that are of one class from their foot to the roof."""

from __future__ import annotations

import torch
from torch import Tensor

from lidar2pano.geometry.columns import greatest_above, row_numbers
from lidar2pano.geometry.surface import cylinder_points, viewpoint_height
from lidar2pano.views import View

TALL_M = 2.5  # above the road: a fence is lower
FAINT = -20.0  # logit, beside that of the building, of a fence that is none
ONE_WALL = 0.1  # logarithm of the ratio of distances, up to which the next lower pixel shows the same wall


def whole_walls(  # noqa: PLR0913, PLR0917 one scene, and which class is what
    logits: Tensor, ids: Tensor, depth_m: Tensor, view: View, road: int, building: int, fence: int
) -> None:
    """Change logits (B, C, H, W) so that no fence carries a building: what is below it, in one wall, is building, too.

    ids      (B, H, W): the best classes, of which those of road, building and fence are given.
    depth_m  (B, H, W): as of `measured_depth`, for a guess that wavers does not show which pixels are of one wall.
    A wall is what is building or fence, each pixel about as far away as the next one up.
    """
    radius_m, z_m = cylinder_points(depth_m, view)
    height_m = z_m + viewpoint_height(radius_m, z_m, ids == road, view)[:, None, None]
    is_wall = (ids == building) | (ids == fence)
    same = (radius_m[:, 1:] / radius_m[:, :-1]).log().abs() < ONE_WALL
    goes_on = torch.cat([torch.zeros_like(is_wall[:, :1]), is_wall[:, 1:] & is_wall[:, :-1] & same], 1)
    row = row_numbers(view.rows, logits.device)
    begin = greatest_above(~goes_on * row)
    tall = greatest_above(((ids == building) & (height_m > TALL_M)) * row)
    carries = (ids == fence) & (tall >= begin)
    walls, fences = logits[:, building], logits[:, fence]
    both = torch.logaddexp(walls[carries], fences[carries])
    walls[carries], fences[carries] = both, both + FAINT
