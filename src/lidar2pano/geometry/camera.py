"""Between a camera and the panorama around its optical centre: both ways, by look-up.

A direction has one pixel in each picture, so a picture is carried over by looking up, for every pixel of the new one,
where its direction lies in the old one. Parallax is none where the panorama's origin is the camera's optical centre
(`at_camera`); for another origin the scene is taken to be far away.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from lidar2pano.calibration import Calibration, LensCalibration
from lidar2pano.geometry.projection import directions, nearest_points, pixels
from lidar2pano.geometry.rasters import sample
from lidar2pano.scan import Scan
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

    def nearest(self, values: Tensor, empty: float = 0) -> Tensor:
        """Carry ids over: values (..., H, W) -> (..., h, w), `empty` where not valid."""
        row = self.row.floor().long().clamp(0, values.shape[-2] - 1)
        column = self.column.floor().long()
        column = column.remainder(values.shape[-1]) if self.circular else column.clamp(0, values.shape[-1] - 1)
        return values[..., row, column].where(self.valid, values.new_full((), empty))

    def linear(self, values: Tensor) -> Tensor:
        """Carry colours or other quantities over: values (..., H, W) float -> (..., h, w), zero where not valid."""
        flat = values.reshape(1, -1, *values.shape[-2:])
        x, y = ((place - 0.5).reshape(1, 1, -1).to(values.dtype) for place in (self.column, self.row))
        mixed = sample(flat, x, y, circular=self.circular).reshape(*values.shape[:-2], *self.row.shape)
        return mixed.where(self.valid, mixed.new_zeros(()))

    def to(self, device: str | torch.device) -> Lookup:
        """The same look-up for pictures on another device."""
        places = (self.row, self.column, self.valid)
        row, column, valid = (place.to(device) for place in places)
        return replace(self, row=row, column=column, valid=valid)


def at_camera(view: View, calibration: Calibration | LensCalibration) -> View:
    """The view with its origin moved to the camera's optical centre."""
    return replace(view, origin=calibration.centre)


def camera_in_panorama(view: View, calibration: Calibration) -> Lookup:
    """Look-up that resamples a camera image (height, width) onto the panorama: (H, W), valid in the camera's sector.

    The last ones are kept, for the frames of a sequence share their calibration; do not write into them.
    """
    return _camera_in_panorama(view, (calibration.K @ calibration.T_camera_lidar[:3, :3]).tobytes(), calibration.size)


@lru_cache(maxsize=8)
def _camera_in_panorama(view: View, KR: bytes, size: tuple[int, int]) -> Lookup:
    u, v, depth = (
        directions(view).double() @ torch.frombuffer(bytearray(KR), dtype=torch.float64).view(3, 3).T
    ).unbind(-1)
    width, height = size
    row, column = v / depth + 0.5, u / depth + 0.5
    valid = (depth > 0) & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    row, column = (torch.where(valid, place, 0.0).float() for place in (row, column))
    return Lookup(row=row, column=column, valid=valid, circular=False)


def panorama_in_camera(view: View, calibration: Calibration | LensCalibration) -> Lookup:
    """Look-up that resamples a panorama (H, W) into the camera's image: (height, width), valid where it reaches."""
    if isinstance(calibration, LensCalibration):
        ray = torch.from_numpy(calibration.rays() @ calibration.T_camera_lidar[:3, :3])
    else:
        width, height = calibration.size
        v, u = torch.meshgrid(
            torch.arange(height, dtype=torch.float64), torch.arange(width, dtype=torch.float64), indexing="ij"
        )
        to_ray = torch.from_numpy(calibration.K @ calibration.T_camera_lidar[:3, :3]).inverse()
        ray = torch.stack([u, v, torch.ones_like(u)], dim=-1) @ to_ray.T
    x, y, z = ray.unbind(-1)
    row, column = pixels(x, y, z, view)
    valid = (row >= 0) & (row < view.rows) & (view.circular | ((column >= 0) & (column < view.columns)))
    valid &= x.isfinite()
    row, column = (torch.where(valid, place, 0.0).float() for place in (row, column))
    return Lookup(row=row, column=column, valid=valid, circular=view.circular)


def points_in_camera(xyz: Tensor, calibration: Calibration) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (u, v) and depth (N,) float64 of points (N, 3), sensor frame, metres; depth <= 0 lies behind."""
    T = torch.from_numpy(calibration.T_camera_lidar).to(xyz.device)
    camera = xyz.double() @ T[:3, :3].T + T[:3, 3]
    u, v, depth = (camera @ torch.from_numpy(calibration.K).to(xyz.device).T).unbind(-1)
    front = torch.where(depth > 0, depth, torch.nan)
    return u / front, v / front, depth


def project_to_camera(scan: Scan, calibration: Calibration, size: tuple[int, int]) -> Tensor:
    """Project a scan into a camera whose image is stretched to `size` (rows, columns).

    Returns (2, rows, columns) float32: remission, and range from the optical centre in metres; zero where no point
    fell. The nearest point owns a pixel, at equal range the first in file order; what is out of view is dropped.
    """
    xyz, remission = torch.from_numpy(scan.xyz), torch.from_numpy(scan.remission)
    usable = torch.isfinite(xyz.sum(1) + remission) & xyz.any(1)  # the sensor's origin means: no echo
    xyz, remission = xyz[usable], remission[usable]
    u, v, _ = points_in_camera(xyz, calibration)  # NaN behind the camera, which is nowhere inside
    (rows, columns), (width, height) = size, calibration.size
    row, column = (((at + 0.5) * (to / of)).floor() for at, to, of in ((v, rows, height), (u, columns, width)))
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    cell = (row[inside] * columns + column[inside]).long()
    range_m = (xyz[inside] - xyz.new_tensor(calibration.centre)).norm(dim=1)
    index = nearest_points(cell, range_m, rows * columns)
    return torch.cat([torch.stack([remission[inside], range_m]), xyz.new_zeros(2, 1)], 1)[:, index].view(2, *size)
