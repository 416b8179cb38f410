"""Walls that are of one class from their foot to the roof, and surfaces without patches of another class."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from lidar2pano.geometry.columns import greatest_above, row_numbers
from lidar2pano.geometry.odds import give_away

TALL_M = 2.0  # above the road: a fence is lower
LORRY_M = 4.2  # likewise, no vehicle is taller
ONE_WALL = 0.1  # logarithm of the ratio of distances, up to which the next lower pixel shows the same wall


def whole_walls(  # noqa: PLR0913, PLR0917 one scene, and which class is what
    logits: Tensor,
    ids: Tensor,
    radius_m: Tensor,
    height_m: Tensor,
    building: int,
    fence: int,
    vehicles: Sequence[int],
) -> None:
    """Change logits (B, C, H, W) so that no fence carries a building and no vehicle stands on one, or carries one.

    Such fences and vehicles are building; a vehicle carries one where its surface goes on above LORRY_M.
    ids  (B, H, W): the best classes, of which those of building, fence and vehicles are given.
    radius_m, height_m  (B, H, W): horizontal distances and heights above the road, of `measured_depth`, for a guess
         that wavers does not show which pixels are of one wall.
    A wall is what is building, fence or vehicle, each pixel about as far away as the next one up.
    """
    same = _one_surface(radius_m)
    house, is_fence, of_vehicles = ids == building, ids == fence, [ids == each for each in vehicles]
    vehicle = torch.stack(of_vehicles).any(0)
    solid = house | is_fence | vehicle
    on_wall = vehicle & (_begun_below(house, solid, same) | _begun(solid & (height_m > LORRY_M), solid, same))
    for each, own in zip(vehicles, of_vehicles, strict=True):
        give_away(logits, each, [building], (own & on_wall).nonzero(as_tuple=True))
    house |= on_wall
    carries = _begun(house & (height_m > TALL_M), house | is_fence, same)
    give_away(logits, fence, [building], (is_fence & carries).nonzero(as_tuple=True))


def no_patches(logits: Tensor, ids: Tensor, radius_m: Tensor, within: Sequence[tuple[int, int]]) -> None:
    """Change logits (B, C, H, W) so that a patch that has another class above and below it in one surface is of that.

    ids, radius_m  as of `whole_walls`;  within: pairs of classes, that of such patches and the one around them.
    """
    same = _one_surface(radius_m)
    for patch, around in within:
        inside, outside = ids == patch, ids == around
        both = inside | outside
        between = _begun(outside, both, same) & _begun_below(outside, both, same)
        give_away(logits, patch, [around], (inside & between).nonzero(as_tuple=True))


def _one_surface(radius_m: Tensor) -> Tensor:
    """Whether each pixel but the highest is about as far away as the one above it: (B, H - 1, W) bool."""
    ratio = radius_m[:, 1:] / radius_m[:, :-1]
    return (ratio - math.cosh(ONE_WALL)).abs() < math.sinh(ONE_WALL)  # as |log| < ONE_WALL, in half of the time


def _begun(marked: Tensor, one: Tensor, same: Tensor) -> Tensor:
    """Whether a pixel, or one above that it is joined to, is marked: (B, H, W) bool.

    Pixels are joined where both are of `one` (B, H, W) and, in `same` (B, H - 1, W), of one surface.
    """
    joined = torch.cat([torch.zeros_like(one[:, :1]), one[:, 1:] & one[:, :-1] & same], 1)
    row = row_numbers(marked.shape[1], marked.device)
    return greatest_above(marked * row) >= greatest_above(~joined * row)


def _begun_below(marked: Tensor, one: Tensor, same: Tensor) -> Tensor:
    """Likewise, whether a pixel, or one below that it is joined to, is marked."""
    return _begun(marked.flip(1), one.flip(1), same.flip(1)).flip(1)
