"""Walls that are of one class from their foot to the roof."""

from __future__ import annotations

import torch
from torch import Tensor

from lidar2pano.geometry.columns import greatest_above, row_numbers
from lidar2pano.geometry.odds import give_away

TALL_M = 2.5  # above the road: a fence is lower
ONE_WALL = 0.1  # logarithm of the ratio of distances, up to which the next lower pixel shows the same wall


def whole_walls(  # noqa: PLR0913, PLR0917 one scene, and which class is what
    logits: Tensor, ids: Tensor, radius_m: Tensor, height_m: Tensor, building: int, fence: int
) -> None:
    """Change logits (B, C, H, W) so that no fence carries a building: what is below it, in one wall, is building, too.

    ids  (B, H, W): the best classes, of which those of building and fence are given.
    radius_m, height_m  (B, H, W): horizontal distances and heights above the road, of `measured_depth`, for a guess
         that wavers does not show which pixels are of one wall.
    A wall is what is building or fence, each pixel about as far away as the next one up.
    """
    is_wall = (ids == building) | (ids == fence)
    same = (radius_m[:, 1:] / radius_m[:, :-1]).log().abs() < ONE_WALL
    goes_on = torch.cat([torch.zeros_like(is_wall[:, :1]), is_wall[:, 1:] & is_wall[:, :-1] & same], 1)
    row = row_numbers(ids.shape[1], logits.device)
    begin = greatest_above(~goes_on * row)
    tall = greatest_above(((ids == building) & (height_m > TALL_M)) * row)
    give_away(logits, fence, [building], ((ids == fence) & (tall >= begin)).nonzero(as_tuple=True))
