"""What lies flat on the ground is ground: no fence does."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lidar2pano.geometry.surface import cylinder_points, viewpoint_height
from lidar2pano.views import View

REACH = 3  # rows upwards, and rows downwards, over which the surface's slope is taken
FLAT = 0.5  # greatest slope along a column: 27 degrees
LOW_M, NEAR_M = 1.0, 25.0  # heights from the road's, and horizontal distances, up to which it is believed
FAINT = -20.0  # logit, beside those of the ground, of what does not lie there


def no_flat_fences(  # noqa: PLR0913, PLR0917 one scene, and which class is what
    logits: Tensor, ids: Tensor, depth_m: Tensor, view: View, road: int, ground: Sequence[int], fence: int
) -> None:
    """Change logits (B, C, H, W) so that what is level and about as high as the road is no fence, but ground.

    ids      (B, H, W): the best classes, of which those of road and fence are given.
    depth_m  (B, H, W): as of `measured_depth`.  ground: ids of classes, which share what the fence had as they share
             what they have.
    """
    radius_m, z_m = cylinder_points(depth_m, view)
    origin_m = viewpoint_height(radius_m, z_m, ids == road, view)
    scene, row, column = ((ids == fence) & (radius_m < NEAR_M)).nonzero(as_tuple=True)
    highest, lowest = (row - REACH).clamp(min=0), (row + REACH).clamp(max=view.rows - 1)
    level = (z_m[scene, row, column] + origin_m[scene]).abs() < LOW_M
    for upper, lower in ((highest, row), (row, lowest)):  # at its foot, a wall is level on one side
        away, up = (part[scene, upper, column] - part[scene, lower, column] for part in (radius_m, z_m))
        level &= up.abs() <= FLAT * away.abs()
    scene, row, column = scene[level], row[level], column[level]
    shares = torch.stack([logits[scene, each, row, column] for each in ground])
    before = shares.logsumexp(0)
    both = torch.logaddexp(before, logits[scene, fence, row, column])
    for each, share in zip(ground, shares, strict=True):
        logits[scene, each, row, column] = share + (both - before)
    logits[scene, fence, row, column] = both + FAINT
