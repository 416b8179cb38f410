"""What a scene painter reads of remission: beams evened, spread over the gaps between them, and quiet on the road."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from lidar2pano.geometry.masks import as_float
from lidar2pano.models.blocks import closed

WINDOWS = ((5, 3), (11, 7))  # rows, columns: neighbouring beams are up to 4 rows of the raster apart, and holes more
BEAM_RAD = math.pi / 12  # to each side of a pixel, in which a row is of one beam
MIXED_PX, MOST_UNEVEN = 16.0, 3.0  # pixels that the mean counts for in each row's; largest factor between beams
DIM = 0.6  # share of the mean below which a beam's remission of the road says nothing
NOISE, MARK = 1.7, 3.0  # mean deviations from the road's mean up to which remission is noise, from which it is paint
NEARER = 4  # also where it is below that in so small a part of the columns only


def spread_out(values: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Means over WINDOWS of what is valid, around every pixel; the first window that holds anything counts.

    values, valid  (B, H, W), valid 0 or 1; columns are circular.
    Returns the means, 0 where no window holds anything, and (B, H, W) 1 where one does.
    """
    sums = torch.stack([values * valid, valid], 1)
    mean, found = torch.zeros_like(values), torch.zeros_like(values)
    for rows, columns in WINDOWS:
        total, count = _window_sums(sums, rows, columns).unbind(1)
        here = as_float(count > 0) * (1 - found)
        mean += here * total / count.clamp(min=1)
        found += here
    return mean, found


def evened_beams(remission: Tensor, valid: Tensor, road: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Remission (B, H, W), so that the road's is the same in all rows, and (B, H, W) 1 where it is used, else 0.

    Beams are not calibrated against each other: in KITTI's scans remission doubles from one row to the next, and a line
    was painted across the road there. A DIM beam sees hardly more than noise, which would become lane marks: none of
    its pixels on the road is used.
    valid  (B, H, W), 0 or 1: where there is any;  road: (B, H, W) probabilities.
    reach  columns to each side of a pixel, which are circular, in which a row is of one beam.
    (A sensor that does not stand upright has a beam in other rows on its other side.)
    """
    weight = valid * road.float()
    sums = torch.stack([remission * weight, weight])
    mean = sums[0].sum((1, 2), keepdim=True) / sums[1].sum((1, 2), keepdim=True).clamp(min=1e-6)
    of_rows = _row_means(sums, mean, reach, MIXED_PX)
    factor = torch.where(of_rows > 0, mean / of_rows.clamp(min=1e-6), 1.0).clamp(1 / MOST_UNEVEN, MOST_UNEVEN)
    nearby = _row_means(sums, mean, reach // NEARER, MIXED_PX // NEARER)
    dim = as_float(torch.minimum(of_rows, nearby) < DIM * mean) * as_float(road > 0.5)
    return remission * factor, valid * (1 - dim)


def quiet_road(remission: Tensor, valid: Tensor, road: Tensor) -> Tensor:
    """Remission (B, H, W) without its noise on the road, which became strokes of white paint there.

    A scan's mean deviation from the mean of its road is the measure: up to NOISE of them there is the mean, from MARK
    on what was measured, since lane marks are few and bright, and in between a share of the difference.
    valid  (B, H, W), 0 or 1: where there is any;  road: (B, H, W) probabilities.
    """
    weight = valid * road.float()
    count = weight.sum((1, 2), keepdim=True).clamp(min=1e-6)
    excess = remission - (remission * weight).sum((1, 2), keepdim=True) / count
    deviation = (excess.abs() * weight).sum((1, 2), keepdim=True) / count
    noise = ((MARK - excess.abs() / deviation.clamp(min=1e-6)) / (MARK - NOISE)).clamp(0, 1)
    return remission - weight * noise * excess


def _row_means(sums: Tensor, mean: Tensor, reach: int, mixed: float) -> Tensor:
    """Means (B, H, W) in rows, up to `reach` columns to each side, of sums (2, B, H, W): of values, of their weights.

    mean  (B, 1, 1), which counts as much as `mixed` weights;  columns are circular.
    """
    reach = min(reach, (sums.shape[3] - 1) // 2)
    ends = closed(sums.flatten(0, 1)[:, None], reach)[:, 0].cumsum(2)
    total, count = (ends[..., 2 * reach :] - pad(ends, (1, 0))[..., : -2 * reach - 1]).view_as(sums)
    return (total + mixed * mean) / (count + mixed)


def _window_sums(x: Tensor, rows: int, columns: int) -> Tensor:
    """Sums over windows around every pixel of (B, C, H, W); columns are circular, nothing is above and below.

    One way and then the other, by adding shifted images: a tenth of avg_pool2d's time on CPUs.
    """
    height, width = x.shape[2:]
    around = closed(x, columns // 2)
    across = sum((around[..., shift : shift + width] for shift in range(1, columns)), start=around[..., :width])
    padded = pad(across, (0, 0, rows // 2, rows // 2))
    return sum((padded[:, :, shift : shift + height] for shift in range(1, rows)), start=padded[:, :, :height])
