"""Between a perspective camera and the panorama around its optical centre: both ways, by look-up.

A direction has one pixel in each picture, so a picture is carried over by looking up, for every pixel of the new one,
where its direction lies in the old one. Parallax is none where the panorama's origin is the camera's optical centre
(`at_camera`); for another origin the scene is taken to be far away.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lidar2pano.calibration import Calibration
from lidar2pano.geometry.projection import directions, pixels
from lidar2pano.views import View


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lookup:
    """For every pixel of the new picture (h, w) its place in the old one, in raster coordinates (centres at .5).

    row, column  (h, w) float32.
    valid        (h, w) bool: the direction lies in the old picture.
    circular     the old picture's last column meets its first.
    """

    row: Tensor
    column: Tensor
    valid: Tensor
    circular: bool

    def nearest(self, picture: Tensor, empty: float = 0) -> Tensor:
        """Carry ids over: picture (..., H, W) -> (..., h, w), `empty` where not valid."""
        row = self.row.floor().long().clamp(0, picture.shape[-2] - 1)
        column = self.column.floor().long()
        column = column.remainder(picture.shape[-1]) if self.circular else column.clamp(0, picture.shape[-1] - 1)
        return picture[..., row, column].where(self.valid, picture.new_full((), empty))

    def linear(self, picture: Tensor) -> Tensor:
        """Carry colours or other quantities over: picture (..., H, W) float -> (..., h, w), zero where not valid."""
        rows, columns = picture.shape[-2:]
        row, column = self.row - 0.5, self.column - 0.5
        top, left = row.floor(), column.floor()
        down, across = row - top, column - left

        def at(i: Tensor, j: Tensor) -> Tensor:
            j = j.long().remainder(columns) if self.circular else j.long().clamp(0, columns - 1)
            return picture[..., i.long().clamp(0, rows - 1), j]

        upper = at(top, left) * (1 - across) + at(top, left + 1) * across
        lower = at(top + 1, left) * (1 - across) + at(top + 1, left + 1) * across
        mixed = upper * (1 - down) + lower * down
        return mixed.where(self.valid, mixed.new_zeros(()))

    def to(self, device: str | torch.device) -> Lookup:
        """The same look-up for pictures on another device."""
        places = (self.row, self.column, self.valid)
        row, column, valid = (place.to(device) for place in places)
        return replace(self, row=row, column=column, valid=valid)


def at_camera(view: View, calibration: Calibration) -> View:
    """The view with its origin moved to the camera's optical centre."""
    return replace(view, origin=calibration.centre)


def camera_in_panorama(view: View, calibration: Calibration) -> Lookup:
    """Look-up that resamples a camera image (height, width) onto the panorama: (H, W), valid in the camera's sector."""
    R = torch.from_numpy(calibration.T_camera_lidar[:3, :3])
    K = torch.from_numpy(calibration.K)
    u, v, depth = (directions(view).double() @ (K @ R).T).unbind(-1)
    width, height = calibration.size
    row, column = v / depth + 0.5, u / depth + 0.5
    valid = (depth > 0) & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    row, column = (torch.where(valid, place, 0.0).float() for place in (row, column))
    return Lookup(row=row, column=column, valid=valid, circular=False)


def panorama_in_camera(view: View, calibration: Calibration) -> Lookup:
    """Look-up that resamples a panorama (H, W) into the camera's image: (height, width), valid where it reaches."""
    width, height = calibration.size
    v, u = torch.meshgrid(
        torch.arange(height, dtype=torch.float64), torch.arange(width, dtype=torch.float64), indexing="ij"
    )
    to_ray = torch.from_numpy(calibration.K @ calibration.T_camera_lidar[:3, :3]).inverse()
    ray = torch.stack([u, v, torch.ones_like(u)], dim=-1) @ to_ray.T
    x, y, z = ray.unbind(-1)
    row, column = pixels(x, y, z, view)
    valid = (row >= 0) & (row < view.rows) & (view.circular | ((column >= 0) & (column < view.columns)))
    row, column = (torch.where(valid, place, 0.0).float() for place in (row, column))
    return Lookup(row=row, column=column, valid=valid, circular=view.circular)


def points_in_camera(xyz: Tensor, calibration: Calibration) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (u, v) and depth (N,) float64 of points (N, 3), sensor frame, metres; depth <= 0 lies behind."""
    T = torch.from_numpy(calibration.T_camera_lidar).to(xyz.device)
    camera = xyz.double() @ T[:3, :3].T + T[:3, 3]
    u, v, depth = (camera @ torch.from_numpy(calibration.K).to(xyz.device).T).unbind(-1)
    front = torch.where(depth > 0, depth, torch.nan)
    return u / front, v / front, depth
