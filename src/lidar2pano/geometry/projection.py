"""RangeImage, a scan on a raster, and the projection that makes it: spheres (sensors' rows) and cylinders (panoramas).

TITAN-Net equation 1 without its clamps: what is out of view is dropped. Angles are computed in float64, so that CPU
and CUDA, whose float32 arc tangents differ in the last bit, put every point into the same pixel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import embedding

from lidar2pano.geometry.rasters import as_float
from lidar2pano.scan import Scan
from lidar2pano.views import View, view_of

FULL_TURN = 2 * math.pi  # radians
FAR_OUT = 1_000_000.0  # rows: a bound for points straight above or below, so that they fit an integer
ROWS_ADDED = 16  # to a view at a time: networks halve their rows four times
BORDER_DEG, BEYOND = 3.0, 0.005  # what goes beyond a view by less, or is a smaller share of the points, is left out
UNOWNED = torch.iinfo(torch.int64).max  # a pixel's key where no point fell into it; its low 32 bits say -1


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
    inside    (N,) bool: usable and in view.
    """

    view: View
    channels: Tensor
    valid: Tensor
    index: Tensor
    row: Tensor
    column: Tensor
    range_m: Tensor
    usable: Tensor
    inside: Tensor

    @property
    def dropped(self) -> int:
        """Number of points without a place on any raster: NaN, Inf, or at an origin."""
        return int((~self.usable).sum())

    def spread(self, values: Tensor, empty: int = 0) -> Tensor:
        """Carry one value per point (N,) to the pixels (H, W) that the points own; `empty` elsewhere."""
        return torch.cat([values, values.new_full((1,), empty)])[self.index]  # where no point is, -1: the last


NEIGHBOURS_PX = (1, 2, 3)  # how far to either side of a point lie the two whose mean it is compared with
LEAST_DEVIATION_M, MOST_DEVIATION_M = 0.001, 1.0  # what is added to a deviation, and the largest that counts
LEAST_DEVIATION, MOST_DEVIATIONS = 0.02, 1000  # a kilometre becomes 50,000 and 1,000 less: half precision has 65,504
ROUGHNESS = (math.log(0.03), 1.3)  # mean and deviation of the logarithm of the roughness, metres


@dataclass(frozen=True, slots=True, kw_only=True)
class Normalisation:
    """Means and deviations of the five channels range, x, y, z (metres) and remission; a sixth: log of the roughness.

    The defaults are those of the published weights (SqueezeSeg's numbers, as SalsaNext and TITAN-Net use them).
    Roughness (`deviations`, metres) is millimetres to decimetres: the half precision that networks compute in
    cannot tell it from ranges, of which a step is 4 cm at 10 m.
    """

    mean: tuple[float, ...] = (12.12, 10.88, 0.23, -1.04, 0.21)
    deviation: tuple[float, ...] = (12.32, 11.47, 6.91, 0.86, 0.16)

    def __post_init__(self) -> None:
        """Refuse other than five or six numbers each, and deviations that are not positive (ValueError)."""
        if len(self.mean) not in (5, 6) or len(self.deviation) != len(self.mean):
            raise ValueError("normalisation needs a mean and a positive deviation for each of 5 channels, or of 6")
        check_normalisation(self.mean, self.deviation)

    def as_dict(self) -> dict[str, list[float]]:
        """What a weight file's card holds of it."""
        return {"mean": list(self.mean), "deviation": list(self.deviation)}

    @classmethod
    def of(cls, channels: int) -> Normalisation:
        """The defaults for a network of so many channels: with roughness where they are six."""
        plain = cls()
        if channels == len(plain.mean):
            return plain
        return cls(mean=(*plain.mean, ROUGHNESS[0]), deviation=(*plain.deviation, ROUGHNESS[1]))

    def __call__(self, image: RangeImage) -> Tensor:
        """(5 or 6, H, W) float32: normalised, then zero where empty, and where no roughness was measured."""
        mean = image.channels.new_tensor(self.mean)[:, None, None]
        deviation = image.channels.new_tensor(self.deviation)[:, None, None]
        normalised = (image.channels - mean[:5]) / deviation[:5] * image.valid
        if len(mean) == 5:
            return normalised
        total, count = deviations(image.channels[None])
        rough = (total / count.clamp(min=1) - mean[5]) / deviation[5] * (count > 0)
        return torch.cat([normalised, rough])


def check_normalisation(mean: Sequence[float], deviation: Sequence[float]) -> None:
    """Raise ValueError for numbers turning values of up to a kilometre into NaN or Inf in half precision."""
    if not all(LEAST_DEVIATION <= value < math.inf for value in deviation) or not all(map(math.isfinite, mean)):
        raise ValueError(
            f"normalisation needs finite means, and a positive deviation, {LEAST_DEVIATION:g} or more, each"
        )
    if any(abs(value) > MOST_DEVIATIONS * scale for value, scale in zip(mean, deviation, strict=True)):
        raise ValueError(f"normalisation needs means of {MOST_DEVIATIONS} deviations at most")


def deviations(channels: Tensor) -> tuple[Tensor, Tensor]:
    """Sums and numbers, both (B, H, W), of the logarithms of how far a point is from lines between those beside it.

    channels  (B, 5, H, W) of a RangeImage; rows are a beam's, or nearly.
    """
    flat = torch.hypot(channels[:, 1].float(), channels[:, 2].float())
    owned = as_float(flat > 0)
    inverse = owned / flat.clamp(min=LEAST_DEVIATION_M)
    total, count = torch.zeros_like(flat), torch.zeros_like(flat)
    for away in NEIGHBOURS_PX:
        left, right = inverse.roll(away, 2), inverse.roll(-away, 2)
        comparable = owned.roll(away, 2).mul_(owned.roll(-away, 2)).mul_(owned)
        off_m = ((left + right).mul_(0.5).sub_(inverse)).abs_().mul_(flat).mul_(flat)  # to first order
        total += off_m.add_(LEAST_DEVIATION_M).clamp_(max=MOST_DEVIATION_M).log_().mul_(comparable)
        count += comparable
    return total, count


def project(scan: Scan, view: View | str, *, device: str | torch.device = "cpu") -> RangeImage:
    """Project a scan onto a view's raster.

    The nearest point owns a pixel; at equal range the first in file order. Points that are NaN or Inf or at the
    sensor's or the view's origin are left out and counted (`RangeImage.dropped`); points out of view own no pixel.
    view  or its name in VIEWS; InputError for another name.
    """
    view = view_of(view) if isinstance(view, str) else view
    xyz = torch.from_numpy(scan.xyz).to(device)
    remission = torch.from_numpy(scan.remission).to(device)
    return project_points(xyz, remission, view)


class _Placed(NamedTuple):
    """Points (3, N) seen from a view's origin, and their places (N,) on its raster; cell H * W: none."""

    xyz: Tensor
    range_m: Tensor
    row: Tensor
    column: Tensor
    cell: Tensor
    usable: Tensor
    inside: Tensor


def project_points(xyz: Tensor, remission: Tensor, view: View) -> RangeImage:
    """Project like `project`, but tensors on any device: xyz (N, 3) float32 metres, remission (N,) float32."""
    placed, cells = _placed(xyz, remission, view), view.rows * view.columns
    index = nearest_points(placed.cell, placed.range_m, cells)
    owned = (index >= 0).nonzero()[:, 0]
    owner = index.index_select(0, owned)
    channels = xyz.new_zeros(5, cells)
    measured = torch.cat([placed.range_m[None], placed.xyz, remission[None]])
    channels.index_copy_(1, owned, measured.index_select(1, owner))
    index = index.view(view.rows, view.columns)
    return RangeImage(
        view=view,
        channels=channels.view(5, view.rows, view.columns),
        valid=index >= 0,
        index=index,
        row=placed.row,
        column=placed.column,
        range_m=placed.range_m,
        usable=placed.usable,
        inside=placed.inside,
    )


def nearest_ranges(scan: Scan, view: View, *, device: str | torch.device = "cpu") -> Tensor:
    """Return the distance (H, W) float32 of the nearest point in each pixel from the view's origin; 0 where none is."""
    xyz, remission = (torch.from_numpy(part).to(device) for part in (scan.xyz, scan.remission))
    placed, cells = _placed(xyz, remission, view), view.rows * view.columns
    nearest = placed.range_m.new_full((cells + 1,), torch.inf).scatter_reduce_(0, placed.cell, placed.range_m, "amin")
    return nearest[:cells].nan_to_num_(posinf=0).view(view.rows, view.columns)


def _placed(xyz: Tensor, remission: Tensor, view: View) -> _Placed:
    places = xyz.T.contiguous()
    squared = places.square().sum(0)
    usable = torch.isfinite(squared + remission) & (squared > 0)
    if any(view.origin):
        places = places - places.new_tensor(view.origin)[:, None]
        squared = places.square().sum(0)
        usable &= torch.isfinite(squared) & (squared > 0)
    places = places.nan_to_num(0, 0, 0)
    range_m = squared.nan_to_num_(0, 0, 0).sqrt_().mul_(usable)
    x, y, z = places.unbind(0)
    row, column = (place.floor().long() for place in pixels(x, y, z, view))
    if view.circular:
        column = column.remainder(view.columns)
    inside = usable & (row >= 0) & (row < view.rows) & (column >= 0) & (column < view.columns)
    cell = torch.where(inside, row * view.columns + column, view.rows * view.columns)
    return _Placed(places, range_m, row, column, cell, usable, inside)


def fitted_view(scan: Scan, view: View, tallest: View | None) -> View:
    """A sphere's view with as many more rows above and below as hold what the scan measured beyond it.

    They are as high as the view's own and come ROWS_ADDED at a time, as far as `tallest` goes; where that is None, the
    view as it is. What lies within BORDER_DEG of the view, or a share of at most BEYOND of the points, asks for none.
    """
    if tallest is None:
        return view
    slope = _slopes(scan)
    step_deg = (view.up - view.down) / view.rows * ROWS_ADDED
    steps_up = _steps_beyond(slope, view.up, tallest.up - view.up, step_deg)
    steps_down = _steps_beyond(-slope, -view.down, view.down - tallest.down, step_deg)
    rows = view.rows + (steps_up + steps_down) * ROWS_ADDED
    return replace(view, rows=rows, up=view.up + steps_up * step_deg, down=view.down - steps_down * step_deg)


def measured_elevation(scan: Scan) -> tuple[float, float] | None:
    """Return the lowest and the highest elevation of a scan's points, degrees; None without points to go by.

    A share of BEYOND at either end does not count.
    """
    slope = _slopes(scan)
    slope = slope[np.isfinite(slope)]
    if not len(slope):
        return None
    low, high = np.degrees(np.arctan(np.quantile(slope, (BEYOND, 1 - BEYOND))))
    return float(low), float(high)


def _slopes(scan: Scan) -> np.ndarray:
    """Return the tangents (N,) of the elevations of a scan's points; NaN at the sensor's own place."""
    with np.errstate(invalid="ignore"):
        return scan.xyz[:, 2] / np.hypot(scan.xyz[:, 0], scan.xyz[:, 1])


def _steps_beyond(slope: np.ndarray, border_deg: float, most_deg: float, step_deg: float) -> int:
    """How many times `step_deg` the elevations of slopes (N,) go beyond a border, `most_deg` at most."""
    beyond = slope[slope > math.tan(math.radians(border_deg + BORDER_DEG))]
    if len(beyond) <= BEYOND * len(slope):
        return 0
    highest = math.degrees(math.atan(np.partition(beyond, rank := int(0.95 * len(beyond)))[rank]))
    return min(math.ceil((highest - border_deg) / step_deg), round(most_deg / step_deg))


def pixels(x: Tensor, y: Tensor, z: Tensor, view: View) -> tuple[Tensor, Tensor]:
    """Raster coordinates (row, column) float64 of directions x, y, z (any one shape), seen from the view's origin.

    The pixel (i, j) covers [i, i+1) x [j, j+1): its centre is at (i + 0.5, j + 0.5). What lies out of view is given
    from the side that it is nearer to: negative columns to the left, columns >= W to the right. A view may cross the
    direction straight behind. In a circular view column W is column 0.
    """
    x, y, z = x.double(), y.double(), z.double()
    left, right = math.radians(view.left), math.radians(view.right)
    turn = left - torch.atan2(y, x)
    if left + right:  # otherwise every turn is within half a circle of the middle already
        unseen = FULL_TURN - (left - right)
        turn -= ((turn + unseen / 2) / FULL_TURN).floor() * FULL_TURN
    column = turn * (view.columns / (left - right))
    horizontal = torch.hypot(x, y)
    if view.kind == "sphere":
        up, down = math.radians(view.up), math.radians(view.down)
        height = torch.atan2(z, horizontal)
    else:
        up, down = view.up, view.down
        height = z / horizontal.clamp(min=1e-9)
    row = (up - height) * (view.rows / (up - down))
    return row.clamp(-FAR_OUT, FAR_OUT), column


def directions(view: View, *, device: str | torch.device = "cpu") -> Tensor:
    """Unit vectors (H, W, 3) float32 from the view's origin through its pixel centres, sensor axes."""
    (cosine, sine), (level, upward) = headings_and_rises(view, device=device)
    ray = torch.empty(view.rows, view.columns, 3, device=device)
    ray[..., 0], ray[..., 1] = level[:, None] * cosine, level[:, None] * sine
    ray[..., 2] = upward[:, None]
    return ray


@lru_cache(maxsize=8)
def headings_and_rises(view: View, *, device: str | torch.device = "cpu") -> tuple[Tensor, Tensor]:
    """Return `directions` by columns and by rows, float64; the last ones are kept, do not write into them.

    (2, W) x and y of the columns' horizontal unit vectors;  (2, H) horizontal and vertical parts of the rows' vectors.
    """
    column = torch.arange(view.columns, dtype=torch.float64, device=device) + 0.5
    row = torch.arange(view.rows, dtype=torch.float64, device=device) + 0.5
    azimuth = math.radians(view.left) - column / view.columns * math.radians(view.left - view.right)
    height = view.up - row / view.rows * (view.up - view.down)
    slope = torch.tan(torch.deg2rad(height)) if view.kind == "sphere" else height
    level = 1 / torch.sqrt(1 + slope * slope)
    return torch.stack([azimuth.cos(), azimuth.sin()]), torch.stack([level, level * slope])


def nearest_points(cell: Tensor, distance_m: Tensor, cells: int) -> Tensor:
    """Z-buffer: index (cells,) int64 of the nearest point in each cell; -1 where there is none.

    cell        (N,) int64 in [0, cells): the cell of each point; `cells` for a point out of view.
    distance_m  (N,) float32, not negative; of equal distances the first in file order owns the cell.

    A float's bits order like the float when it is positive; with the point's number below them, the least key is the
    nearest point and, at equal distance, the first.
    """
    key = (distance_m.view(torch.int32).long() << 32) | torch.arange(len(cell), device=cell.device)
    least = torch.full((cells + 1,), UNOWNED, device=cell.device).scatter_reduce_(0, cell, key, "amin")
    return least[:cells].bitwise_left_shift(32).bitwise_right_shift_(32)  # the low 32 bits with their sign


def one_hot_layers(ids: Tensor, number: int) -> Tensor:
    """(B, number, H, W) float32 of ids (B, H, W) in [0, number): one where a pixel is of the class, else zero."""
    return embedding(ids.long(), torch.eye(number, device=ids.device)).movedim(-1, 1)  # a sixth of one_hot's time
