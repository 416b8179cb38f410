"""What lies flat on the ground is ground, and what slopes is a bank: no fence does."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lidar2pano.geometry.odds import give_away

REACH = 3  # rows upwards, and rows downwards, over which the surface's slope is taken
FLAT, STEEP = 0.5, 1.5  # greatest slope along a column of level ground, and of a bank: 27 and 56 degrees
LOW_M, HIGH_M, NEAR_M = 0.5, 3.0, 25.0  # heights from the road's of these, and horizontal distances, that are believed


def no_flat_fences(  # noqa: PLR0913, PLR0917 one scene, and which class is what
    logits: Tensor,
    ids: Tensor,
    radius_m: Tensor,
    height_m: Tensor,
    ground: Sequence[int],
    bank: Sequence[int],
    fence: int,
) -> None:
    """Change logits (B, C, H, W) so that what is level and about as high as the road, or a slope, is no fence.

    ids       (B, H, W): the best classes, of which that of fences is given; what is no fence any more stays as it is.
    radius_m, height_m  (B, H, W): horizontal distances and heights above the road, of `measured_depth`.
    ground, bank  ids of classes of level ground and of a bank, which share what the fence had as they share their own.
    """
    scene, row, column = ((ids == fence) & (radius_m < NEAR_M) & (height_m.abs() < HIGH_M)).nonzero(as_tuple=True)
    still = logits[scene, :, row, column].argmax(1) == fence
    scene, row, column = scene[still], row[still], column[still]
    highest, lowest = (row - REACH).clamp(min=0), (row + REACH).clamp(max=ids.shape[1] - 1)
    level = height_m[scene, row, column].abs() < LOW_M
    sloping = torch.ones_like(level)
    for upper, lower in ((highest, row), (row, lowest)):  # at its foot, a wall is level on one side
        away, up = ((part[scene, upper, column] - part[scene, lower, column]).abs() for part in (radius_m, height_m))
        level &= up <= FLAT * away
        sloping &= up <= STEEP * away
    sloping &= ~level
    for others, there in ((ground, level), (bank, sloping)):
        give_away(logits, fence, others, (scene[there], row[there], column[there]))
