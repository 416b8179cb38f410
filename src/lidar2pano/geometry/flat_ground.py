"""What lies flat on the ground is ground, and what slopes is a bank: no fence does."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from lidar2pano.geometry.odds import give_away

REACH = 3  # rows upwards, and rows downwards, over which the surface's slope is taken
AROUND = 12  # columns on either side that count together
FLAT, STEEP = 0.5, 1.5  # greatest slope along a column of level ground, and of a bank: 27 and 56 degrees
LOW_M, HIGH_M = 0.5, 3.0  # heights from the road's of these that are believed
NEAR_M, BANK_M = 25.0, 12.0  # likewise, horizontal distances: farther away guard rails are too few rows


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

    Pixel by pixel, surfaces between beams are stairs, and guard rails would be torn. So it is said of all that adjoins
    in a column, if in the mean over the columns around more than half of it is so.
    ids       (B, H, W): the best classes, of which that of fences is given; what is no fence any more stays as it is.
    radius_m, height_m  (B, H, W): horizontal distances and heights above the road, of `measured_depth`.
    ground, bank  ids of classes of level ground and of a bank, which share what the fence had as they share their own.
    """
    scene, column, row = (ids == fence).transpose(1, 2).nonzero(as_tuple=True)
    still = logits[scene, :, row, column].argmax(1) == fence
    scene, row, column = scene[still], row[still], column[still]
    highest, lowest = (row - REACH).clamp(min=0), (row + REACH).clamp(max=ids.shape[1] - 1)
    away_m, high_m = radius_m[scene, row, column], height_m[scene, row, column].abs()
    level = (high_m < LOW_M) & (away_m < NEAR_M)
    sloping = (high_m < HIGH_M) & (away_m < BANK_M)
    for upper, lower in ((highest, row), (row, lowest)):  # at its foot, a wall is level on one side
        away, up = ((part[scene, upper, column] - part[scene, lower, column]).abs() for part in (radius_m, height_m))
        level &= up <= FLAT * away
        sloping &= up <= STEEP * away
    is_bank = _mostly(level | sloping, (scene, row, column), ids)
    for others, there in ((ground, level & is_bank), (bank, ~level & is_bank)):
        give_away(logits, fence, others, (scene[there], row[there], column[there]))


def _mostly(marked: Tensor, where: tuple[Tensor, Tensor, Tensor], image: Tensor) -> Tensor:
    """Whether more than half of what is around each of N pixels is marked, (N,) bool: see `no_flat_fences`.

    where  scenes, rows and columns (N,) of the pixels of `image` (B, H, W), sorted by scene, column and row.
    """
    _, row, column = where
    begins = torch.ones_like(marked)
    begins[1:] = (row[1:] != row[:-1] + 1) | (column[1:] != column[:-1])
    number = begins.cumsum(0) - 1
    share = number.bincount(marked.float()) / number.bincount().clamp(min=1)
    there = torch.zeros(2, *image.shape, device=image.device)
    there[0][where], there[1][where] = share[number].float(), 1
    closed = pad(there.flatten(0, 1), (AROUND, AROUND), mode="circular")
    shares, counts = avg_pool2d(closed, (1, 2 * AROUND + 1), 1).unflatten(0, there.shape[:2])
    return shares[where] > counts[where] / 2
