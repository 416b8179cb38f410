"""What the columns of a panorama show, for things that are laid out on the ground: walls and cars."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from lidar2pano.geometry.surface import azimuths
from lidar2pano.views import View


def world_columns(view: View, T_world_sensor: np.ndarray | None, device: torch.device) -> tuple[Tensor, Tensor]:
    """Where the columns look in the world, from above: unit vectors (2, W), and from which place (2,), metres; float64.

    T_world_sensor  (4, 4); None: the world is the sensor frame.
    """
    pose = np.eye(4) if T_world_sensor is None else np.asarray(T_world_sensor, dtype=np.float64)
    angle = azimuths(view, device=device) + math.atan2(pose[1, 0], pose[0, 0])
    place = torch.from_numpy((pose[:3, :3] @ np.array(view.origin) + pose[:3, 3])[:2])
    return torch.stack([angle.cos(), angle.sin()]), place.to(device)


def rows_beside(there: Tensor) -> tuple[Tensor, Tensor]:
    """The last row up to each pixel of (..., H, W) bool, and the first from it on, that is `there`; else -1 and H."""
    rows = there.shape[-2]
    from_top = row_numbers(rows, there.device)
    above = greatest_above(there * from_top)  # products: torch.where takes several times as long
    below = there * from_top.flip(0)
    step = 1
    while step < rows:
        below[..., :-step, :] = torch.maximum(below[..., :-step, :], below[..., step:, :])
        step *= 2
    return above.long().sub_(1), below.long().neg_().add_(rows)


def row_numbers(rows: int, device: torch.device) -> Tensor:
    """1 to `rows`, (rows, 1), as narrow as they fit, for `greatest_above`."""
    number = torch.int16 if rows <= torch.iinfo(torch.int16).max else torch.int32
    return torch.arange(1, rows + 1, dtype=number, device=device)[:, None]


def greatest_above(x: Tensor) -> Tensor:
    """Change (..., H, W) to the greatest of each value and those above it: a seventh of cummax's time."""
    step = 1
    while step < x.shape[-2]:  # of 2, 4, 8, ... rows
        x[..., step:, :] = torch.maximum(x[..., step:, :], x[..., :-step, :])
        step *= 2
    return x


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
