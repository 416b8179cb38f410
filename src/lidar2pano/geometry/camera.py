"""Between the panorama, a camera at its optical centre and rasters of other programs: look-ups to fill them.

A direction has one pixel in each picture, so a picture is carried over by looking up, for every pixel of the new one,
where its direction lies in the old one. Parallax is none where the panorama's origin is the camera's optical centre
(`at_camera`); for another origin the scene is taken to be far away.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from lidar2pano.calibration import Calibration, LensCalibration
from lidar2pano.geometry.projection import directions, nearest_points, pixels
from lidar2pano.geometry.rasters import sample
from lidar2pano.scan import Scan
from lidar2pano.views import FULL_TURN, View

PROJECTIONS = ("cylinder", "equirectangular", "cubemap")
# Face of a cube -> directions of its image's right, of its image's bottom, and of its middle; x forward, y left, z up.
# Above and below, one looks up and down from the face ahead: its upper edge is the lower edge of the face above.
CUBE_AXES = {
    "front": ((0, -1, 0), (0, 0, -1), (1, 0, 0)),
    "right": ((-1, 0, 0), (0, 0, -1), (0, -1, 0)),
    "back": ((0, 1, 0), (0, 0, -1), (-1, 0, 0)),
    "left": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "up": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "down": ((0, -1, 0), (-1, 0, 0), (0, 0, -1)),
}


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
    return _in_panorama(view, camera_rays(calibration), torch.lt)


def camera_rays(calibration: Calibration | LensCalibration) -> Tensor:
    """Directions (h, w, 3) float64, of any length, from the optical centre through the pixel centres, sensor axes.

    NaN where a lens projects nothing.
    """
    R = calibration.T_camera_lidar[:3, :3]
    if isinstance(calibration, LensCalibration):
        return torch.from_numpy(calibration.rays() @ R)
    width, height = calibration.size
    v, u = torch.meshgrid(
        torch.arange(height, dtype=torch.float64), torch.arange(width, dtype=torch.float64), indexing="ij"
    )
    return torch.stack([u, v, torch.ones_like(u)], dim=-1) @ torch.from_numpy(calibration.K @ R).inverse().T


def _in_panorama(view: View, rays: Tensor, below: Callable[[Tensor, int], Tensor]) -> Lookup:
    """Return the look-up of directions (h, w, 3) in a panorama on `view`; `below` its far borders, or on them."""
    x, y, z = rays.unbind(-1)
    row, column = pixels(x, y, z, view)
    valid = (row >= 0) & below(row, view.rows) & (view.circular | ((column >= 0) & below(column, view.columns)))
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
    u, v, _ = points_in_camera(xyz, calibration)  # NaN behind the camera: nowhere inside
    (rows, columns), (width, height) = size, calibration.size
    row, column = (((at + 0.5) * (to / of)).floor() for at, to, of in ((v, rows, height), (u, columns, width)))
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    cell = (row[inside] * columns + column[inside]).long()
    range_m = (xyz[inside] - xyz.new_tensor(calibration.centre)).norm(dim=1)
    index = nearest_points(cell, range_m, rows * columns)
    return torch.cat([torch.stack([remission[inside], range_m]), xyz.new_zeros(2, 1)], 1)[:, index].view(2, *size)


def equirectangular(view: View) -> View:
    """Return the part of a sphere with the directions of a view, as fine as the view is at the horizon.

    It consists of whole pixels of a full sphere, twice as wide as high, straight ahead in its middle. A view across the
    direction straight behind becomes a full turn.
    """
    full_columns = 2 * round(view.columns * FULL_TURN / (view.left - view.right) / 2)
    step = FULL_TURN / full_columns
    up, down = view.up, view.down
    if view.kind == "cylinder":
        up, down = (math.degrees(math.atan(tangent)) for tangent in (up, down))
    top, bottom = math.ceil((90 - min(up, 90)) / step - 0.5), math.floor((90 - max(down, -90)) / step + 0.5)
    left, right = 0, full_columns
    if not view.circular and view.left <= FULL_TURN / 2 and view.right >= -FULL_TURN / 2:
        left = math.ceil((FULL_TURN / 2 - view.left) / step - 0.5)
        right = math.floor((FULL_TURN / 2 - view.right) / step + 0.5)
    return replace(
        view,
        kind="sphere",
        rows=max(bottom - top, 1),
        columns=max(right - left, 1),
        up=90 - top * step,
        down=90 - max(bottom, top + 1) * step,
        left=FULL_TURN / 2 - left * step,
        right=FULL_TURN / 2 - max(right, left + 1) * step,
    )


def cube_faces(view: View) -> dict[str, Calibration]:
    """Return a square camera with a field of 90 degrees for each face, as fine in its middle as a view is."""
    size = 2 * round(view.focal_px)
    K = np.array([[size / 2, 0, (size - 1) / 2], [0, size / 2, (size - 1) / 2], [0, 0, 1.0]])
    cameras: dict[str, Calibration] = {}
    for face, axes in CUBE_AXES.items():
        T = np.eye(4)
        T[:3, :3] = axes
        T[:3, 3] = -T[:3, :3] @ np.array(view.origin)
        cameras[face] = Calibration(K=K, T_camera_lidar=T, size=(size, size))
    return cameras


def panorama_in_view(view: View, target: View) -> Lookup:
    """Return the look-up from a panorama on `view` to `target`, another raster around the same point."""
    return _in_panorama(view, directions(target), torch.le)


def lookups(view: View, projection: str) -> dict[str, Lookup]:
    """Return the look-ups of a projection's images, by the ending of their names' stems."""
    if projection == "equirectangular":
        return {"": panorama_in_view(view, equirectangular(view))}
    return {f".{face}": panorama_in_camera(view, camera) for face, camera in cube_faces(view).items()}
