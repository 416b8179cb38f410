"""Columns of a panorama read from above, for things that are laid out on the ground: walls and cars."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad


def surface_profile(  # noqa: PLR0913, PLR0917 two images, and how they are read
    weight: Tensor, radius_m: Tensor, same: float, least: float, reach: int, nearness: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Logarithm of the distance (B, W) of a surface, and how many rows (B, W) of a column it was read from.

    A mean over the rows, twice: the second time of what is near the first. Then the median of the columns around, NaN
    where none of them has more than `least` rows.
    weight, radius_m  (B, H, W): of each pixel;  same: of the logarithm, what is near;  reach: as for median_around.
    nearness          power of the distance that weights of the first mean are divided by: of two surfaces the nearer.
    """
    distance = radius_m.clamp(min=0.5).log()
    first = weight * torch.exp(-nearness * distance) if nearness else weight
    mean = (first * distance).sum(1) / first.sum(1).clamp(min=1e-9)
    weight = weight * torch.exp(-((distance - mean[:, None]) / same).square())
    total = weight.sum(1)
    profile = (weight * distance).sum(1) / total.clamp(min=1e-6)
    return median_around(torch.where(total > least, profile, torch.nan), reach), total


def median_around(values: Tensor, reach: int) -> Tensor:
    """The median (B, W) of each column and `reach` columns on either side, NaN left out; circular."""
    return pad(values, (reach, reach), mode="circular").unfold(1, 2 * reach + 1, 1).nanmedian(2).values


def pixel_share(inside_m: Tensor, pixel_m: Tensor) -> Tensor:
    """The share of pixels of size pixel_m that is inside of an edge, from which their middles are inside_m away."""
    return (0.5 + inside_m / pixel_m).clamp(0, 1)
