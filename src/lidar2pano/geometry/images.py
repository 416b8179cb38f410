"""RangeImage and SegmentMap: what a scan looks like on a raster."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import one_hot

from lidar2pano.labels import LabelSet
from lidar2pano.views import View


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RangeImage:
    """A scan of N points on the raster of a view; the nearest point owns its pixel.

    view      the raster (H rows, W columns).
    channels  (5, H, W) float32: range, x, y, z in metres from the view's origin, remission; zero where not valid.
    valid     (H, W) bool: some point fell into the pixel.
    index     (H, W) int64: the point that owns the pixel, -1 where none does.
    row       (N,) int64: the raster row each point falls on, outside 0 .. H-1 where it is out of view.
    column    (N,) int64: likewise the column.
    range_m   (N,) float32: distance of each point from the view's origin, metres; zero where not usable.
    usable    (N,) bool: finite, and neither at the sensor's origin (no echo) nor at the view's.
    """

    view: View
    channels: Tensor
    valid: Tensor
    index: Tensor
    row: Tensor
    column: Tensor
    range_m: Tensor
    usable: Tensor

    @property
    def inside(self) -> Tensor:
        """(N,) bool: usable and in view."""
        view = self.view
        kept = self.usable & (self.row >= 0) & (self.row < view.rows)
        return kept & (self.column >= 0) & (self.column < view.columns)

    @property
    def dropped(self) -> int:
        """Number of points that no raster could take: NaN, Inf, or at an origin."""
        return int((~self.usable).sum())

    def spread(self, values: Tensor, empty: int = 0) -> Tensor:
        """Carry one value per point (N,) to the pixels (H, W) that the points own; `empty` elsewhere."""
        return torch.cat([values, values.new_full((1,), empty)])[self.index]  # where no point is, -1: the last


@dataclass(frozen=True, slots=True, kw_only=True)
class Normalisation:
    """Means and deviations of the five channels range, x, y, z (metres) and remission.

    The defaults are those of the published weights (SqueezeSeg's numbers, as SalsaNext and TITAN-Net use them).
    """

    mean: tuple[float, ...] = (12.12, 10.88, 0.23, -1.04, 0.21)
    deviation: tuple[float, ...] = (12.32, 11.47, 6.91, 0.86, 0.16)

    def __call__(self, image: RangeImage) -> Tensor:
        """(5, H, W) float32: normalised, then zero where empty."""
        mean = image.channels.new_tensor(self.mean)[:, None, None]
        deviation = image.channels.new_tensor(self.deviation)[:, None, None]
        return (image.channels - mean) / deviation * image.valid


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SegmentMap:
    """Class ids on a raster.

    ids     (H, W) integer ids of `labels`.
    labels  the set they belong to.
    """

    ids: Tensor
    labels: LabelSet

    def __post_init__(self) -> None:
        """Refuse anything but a raster of integers (ValueError)."""
        if self.ids.ndim != 2 or self.ids.is_floating_point():
            raise ValueError(f"SegmentMap.ids must be (H, W) integers, got {tuple(self.ids.shape)} {self.ids.dtype}")

    def translated(self, labels: LabelSet, table: np.ndarray | Tensor) -> SegmentMap:
        """The same map in another label set, by a look-up table (K,) as `labels.TABLES` holds them."""
        table = torch.as_tensor(table, device=self.ids.device)
        return SegmentMap(ids=table[self.ids.long()].to(self.ids.dtype), labels=labels)


def one_hot_layers(ids: Tensor, number: int) -> Tensor:
    """(B, number, H, W) float32 of ids (B, H, W) in [0, number): one where a pixel is of the class, else zero."""
    return one_hot(ids.long(), number).movedim(-1, 1).float()
