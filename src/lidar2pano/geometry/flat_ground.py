"""What lies flat on the ground is ground: no fence does."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lidar2pano.geometry.odds import give_away

REACH = 3  # rows upwards, and rows downwards, over which the surface's slope is taken
FLAT = 0.5  # greatest slope along a column: 27 degrees
LOW_M, NEAR_M = 1.0, 25.0  # heights from the road's, and horizontal distances, up to which it is believed


def no_flat_fences(  # noqa: PLR0913, PLR0917 one scene, and which class is what
    logits: Tensor, ids: Tensor, radius_m: Tensor, height_m: Tensor, ground: Sequence[int], fence: int
) -> None:
    """Change logits (B, C, H, W) so that what is level and about as high as the road is no fence, but ground.

    ids       (B, H, W): the best classes, of which that of fences is given.
    radius_m, height_m  (B, H, W): horizontal distances and heights above the road, of `measured_depth`.
    ground    ids of classes, which share what the fence had as they share what they have.
    """
    scene, row, column = ((ids == fence) & (radius_m < NEAR_M) & (height_m.abs() < LOW_M)).nonzero(as_tuple=True)
    highest, lowest = (row - REACH).clamp(min=0), (row + REACH).clamp(max=ids.shape[1] - 1)
    level = torch.ones_like(row, dtype=torch.bool)
    for upper, lower in ((highest, row), (row, lowest)):  # at its foot, a wall is level on one side
        away, up = (part[scene, upper, column] - part[scene, lower, column] for part in (radius_m, height_m))
        level &= up.abs() <= FLAT * away.abs()
    give_away(logits, fence, ground, (scene[level], row[level], column[level]))
