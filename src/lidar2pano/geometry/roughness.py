"""Walls and asphalt are even, foliage and grass are rough: what the points of one ring say about where they lie."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, conv2d, interpolate

from lidar2pano.geometry.columns import rows_beside
from lidar2pano.geometry.masks import as_float
from lidar2pano.geometry.odds import multiply_odds

BESIDE_PX = (1, 2, 3)  # how far beside a point lie the two whose mean it is compared with
LEAST_M, MOST_M = 0.001, 1.0  # what is added to a deviation, and the largest that counts
BLOCK, AROUND = (2, 4), 5  # pixels of a block (rows, columns); blocks to a side of the square that is averaged over
ENOUGH = 3  # comparisons there
MOST_ODDS = 3.0  # logarithm: cobbles and gravel exist
NEAR_M, FAR_M = 2.0, 60.0  # distances beyond which a threshold grows no more


class Evidence(NamedTuple):
    """How roughness parts a class from others; fitted to frames of KITTI's `val` and of simulated towns.

    rough, even  ids: of the class that is rough, and of those that are not.
    limit_m      roughness at 10 m that speaks for neither; it grows with distance ** growth.
    power        that roughness / limit is raised to, to multiply the odds of `rough`.
    """

    rough: int
    even: Sequence[int]
    limit_m: float
    growth: float
    power: float


def weigh_by_roughness(logits: Tensor, channels: Tensor, depth_m: Tensor, evidence: Sequence[Evidence]) -> None:
    """Change logits (B, C, H, W) by how rough the measured surface is; what the classes of an Evidence sum to stays.

    channels  (B, 5, H, W) of a RangeImage on the same raster;  depth_m: (B, H, W), of a translator.
    Where there is nothing to compare nothing changes.
    """
    found = roughness(channels).log_()
    distance = depth_m.float().clamp(NEAR_M, FAR_M).div(10).log_()
    for rough, even, limit_m, growth, power in evidence:
        odds = (found - math.log(limit_m) - growth * distance).mul_(power).nan_to_num_(0).clamp_(-MOST_ODDS, MOST_ODDS)
        multiply_odds(logits, rough, even, odds)


def roughness(channels: Tensor) -> Tensor:
    """Geometric mean (B, H, W) of how far points are from the line between two beside them in their row, metres.

    channels  (B, 5, H, W) of a RangeImage on a cylinder, on which lines are linear in the inverse distance.
    Over blocks of BLOCK pixels and those around them; where too few points are, that of the next block below it, else
    above it, in which there are enough; NaN in columns without any.
    """
    total, count = deviations(channels)
    size = total.shape[1:]
    sums = adaptive_avg_pool2d(torch.stack([total, count], 1), (size[0] // BLOCK[0], size[1] // BLOCK[1]))
    total, count = _around(sums * (BLOCK[0] * BLOCK[1])).unbind(1)
    mean = torch.where(count > ENOUGH, total / count.clamp(min=1), torch.nan)
    return interpolate(_completed(mean)[:, None], size)[:, 0].exp()


def deviations(channels: Tensor) -> tuple[Tensor, Tensor]:
    """Sums and numbers, both (B, H, W), of the logarithms of how far a point is from lines between those beside it.

    channels  (B, 5, H, W) of a RangeImage; rows are a beam's, or nearly.
    """
    flat = torch.hypot(channels[:, 1].float(), channels[:, 2].float())
    there = as_float(flat > 0)
    inverse = there / flat.clamp(min=LEAST_M)
    total, count = torch.zeros_like(flat), torch.zeros_like(flat)
    for away in BESIDE_PX:
        left, right = inverse.roll(away, 2), inverse.roll(-away, 2)
        known = there.roll(away, 2).mul_(there.roll(-away, 2)).mul_(there)
        off_m = ((left + right).mul_(0.5).sub_(inverse)).abs_().mul_(flat).mul_(flat)  # to first order
        total += off_m.add_(LEAST_M).clamp_(max=MOST_M).log_().mul_(known)
        count += known
    return total, count


def _around(x: Tensor) -> Tensor:
    """Sums (B, C, H, W) over squares of AROUND x AROUND; columns are circular, nothing is above and below."""
    reach = AROUND // 2
    closed = torch.cat([x[..., -reach:], x, x[..., :reach]], 3)
    return conv2d(closed.flatten(0, 1)[:, None], x.new_ones(1, 1, AROUND, AROUND), padding=(reach, 0)).view_as(x)


def _completed(x: Tensor) -> Tensor:
    """(B, H, W) in which NaN is replaced by the next value below in its column, else by the next one above."""
    above, below = rows_beside(~x.isnan())
    return x.gather(1, torch.where(below < x.shape[1], below, above.clamp(min=0)))
