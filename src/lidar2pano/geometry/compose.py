"""The panorama that several cameras saw together: pictures from all around -> the raster of a view.

The cameras stand beside the point that looks, so a pixel's place in them depends on how far away the thing is: the
look-up needs a depth per pixel (`geometry.filling` makes one of a scan). A depth that is wrong by a share of its
inverse moves the look-up by baseline x focal_px x |1/depth - 1/true| pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from lidar2pano.calibration import Calibration
from lidar2pano.geometry.camera import Lookup
from lidar2pano.geometry.projection import directions
from lidar2pano.views import View

BLEND = 6  # columns over which one camera's picture goes over into the next one's
COARSE = 0.4  # the buffers that say what hides what: pixels of a camera per pixel of the view
HIDES = 0.02  # 1/m by which something must be nearer to hide; at a baseline of 1 m that moves 15 pixels of the panorama
NEARER = 0.15  # and the share of the nearer inverse depth


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Photo:
    """One camera's picture.

    picture      (h, w, 3) uint8 RGB.
    calibration  of that size.
    clear        (h, w) bool: False where the picture shows the car that carries it; None where it never does.
    """

    picture: np.ndarray
    calibration: Calibration
    clear: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Refuse parts whose sizes differ (ValueError)."""
        shape = self.calibration.size[::-1]
        if self.picture.shape != (*shape, 3) or (self.clear is not None and self.clear.shape != shape):
            raise ValueError(f"Photo: picture (h, w, 3) and clear (h, w) must be {shape}, got {self.picture.shape}")


def compose(photos: Sequence[Photo], view: View, depth_m: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """What the cameras saw together, on the raster of a view: colour (H, W, 3) uint8 and valid (H, W) bool.

    depth_m  (H, W) float32 metres from the view's origin along the ray; infinite for the sky, whose place in a camera
             depends on its direction only; pixels whose depth is not above 0 are not valid.

    A pixel is looked up bilinearly in the camera whose axis is nearest in angle to the place, among those that see it;
    where the next one is hardly farther off, the two are mixed, over BLEND columns. A camera does not see a place that
    is out of its picture, on its own car, or behind something that the same depths put in front of it. Pixels that no
    camera sees are not valid, and black. Raises ValueError where the depths do not fit the view.
    """
    if depth_m.shape != (view.rows, view.columns):
        raise ValueError(f"depths must be ({view.rows}, {view.columns}), got {tuple(depth_m.shape)}")
    places, size = _places(view, depth_m), view.rows * view.columns
    sights = [_sight(photo, places, view.focal_px) for photo in photos]
    nearest = torch.full((size,), torch.inf)
    for sight in sights:
        nearest[sight.pixel] = torch.minimum(nearest[sight.pixel], sight.angle)
    colours, weights = torch.zeros(3, size), torch.zeros(size)
    for photo, sight in zip(photos, sights, strict=True):
        weight = (1 - (sight.angle - nearest[sight.pixel]) * (2 * view.focal_px / BLEND)).clamp(min=0)
        picture = torch.from_numpy(photo.picture).movedim(2, 0).float()
        colours.index_add_(1, sight.pixel, sight.lookup.linear(picture) * weight)
        weights.index_add_(0, sight.pixel, weight)
    mixed = (colours / weights.clamp(min=1e-9)).round().clamp(0, 255).to(torch.uint8)
    valid = (weights > 0).view(view.rows, view.columns)
    return mixed.T.reshape(view.rows, view.columns, 3).contiguous().numpy(), valid.numpy()


class _Sight(NamedTuple):
    """What a camera sees of a view's pixels: which (n,), where in its picture, and how far from its axis, radians."""

    pixel: Tensor
    lookup: Lookup
    angle: Tensor


def _places(view: View, depth_m: Tensor) -> Tensor:
    """Homogeneous coordinates (4, H W) float32 of what the pixels show, sensor frame: of the sky, a direction."""
    ray = directions(view).reshape(-1, 3).T
    distance = depth_m.reshape(-1)
    ends = distance.isfinite() & (distance > 0)
    origin = torch.tensor(view.origin)[:, None]
    places = torch.where(ends, ray * distance.where(ends, 0.0) + origin, ray)
    there = torch.where(ends, 1.0, torch.where(distance > 0, 0.0, torch.nan))
    return torch.cat([places, there[None]])


def _sight(photo: Photo, places: Tensor, focal_px: float) -> _Sight:
    """Look the places (4, n) up in a camera; focal_px: of the view."""
    calibration = photo.calibration
    width, height = calibration.size
    K, T = torch.from_numpy(calibration.K).float(), torch.from_numpy(calibration.T_camera_lidar[:3]).float()
    camera = T @ places
    pixel = (camera[2] > 0).nonzero()[:, 0]  # false where NaN
    x, y, ahead = camera = camera[:, pixel]
    column, row = (K[:2] @ camera) / ahead + 0.5
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    distance = camera.norm(dim=0)
    inverse = torch.where(places[3, pixel] > 0, 1 / distance, 0.0)
    scale = min(1.0, COARSE * focal_px / float(calibration.K[0, 0]))
    seen = inside.clone()
    seen[inside] = ~_hidden(row[inside] * scale, column[inside] * scale, inverse[inside])
    if photo.clear is not None:
        seen[inside] &= torch.from_numpy(photo.clear)[row[inside].long(), column[inside].long()]
    angle = torch.atan2(torch.hypot(x, y), ahead)[seen]
    lookup = Lookup(row=row[seen], column=column[seen], valid=torch.ones_like(angle).bool(), circular=False)
    return _Sight(pixel=pixel[seen], lookup=lookup, angle=angle)


def _hidden(row: Tensor, column: Tensor, inverse: Tensor) -> Tensor:
    """(n,) bool: something else lies before the place, in a coarse picture in which the nearest stays.

    row, column  (n,) raster coordinates in that picture;  inverse  (n,) 1/m, 0 for the sky.
    What is near loses its border of one pixel: there a pixel holds the near and the far, which stand side by side.
    """
    if not len(row):
        return torch.zeros(0, dtype=torch.bool)
    height, width = int(row.max()) + 1, int(column.max()) + 1
    cell = row.long() * width + column.long()
    nearest = torch.zeros(height * width).scatter_reduce_(0, cell, inverse, "amax")
    nearest = -max_pool2d(-nearest.view(1, height, width), 3, 1, 1)
    before = nearest.view(-1)[cell]
    return before - inverse > (before * NEARER).clamp(min=HIDES)
