"""Stitching: the images of several cameras -> a panorama on the raster of a view.

The cameras stand beside the view's origin, so a pixel's place in their images depends on how far away the surface is:
the look-up needs a depth per pixel (`scene.depth` makes one of a scan). A wrong depth moves the look-up
by baseline x focal_px x |1/depth - 1/true| pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from lidar2pano.calibration import Calibration, LensCalibration
from lidar2pano.geometry.camera import Lookup
from lidar2pano.geometry.projection import directions, nearest_points
from lidar2pano.views import View

BLEND = 6  # columns over which the image of one camera is blended into the next one's
COARSE = 0.4  # the depth buffers that find what is hidden: pixels of a camera per pixel of the view
HIDES = 0.02  # 1/m by which an occluder must be nearer; at a baseline of 1 m that is 15 pixels of the panorama
NEARER = 0.15  # and the share of its inverse depth


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraImage:
    """One camera's image.

    image        (h, w, 3) uint8 RGB.
    calibration  of that size; what is beyond a lens's image circle is not used.
    ego_mask     (h, w) bool: True where the image shows the vehicle that carries the camera; None where it never does.
    """

    image: np.ndarray
    calibration: Calibration | LensCalibration
    ego_mask: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Refuse parts whose sizes differ (ValueError)."""
        shape = self.calibration.size[::-1]
        if self.image.shape != (*shape, 3) or (self.ego_mask is not None and self.ego_mask.shape != shape):
            raise ValueError(
                f"CameraImage: image (h, w, 3) and ego_mask (h, w) must be {shape}, got {self.image.shape}"
            )


def stitch(cameras: Sequence[CameraImage], view: View, depth_m: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Stitch images of several cameras on the raster of a view: image (H, W, 3) uint8 and valid (H, W) bool.

    depth_m  (H, W) float32 metres from the view's origin along the ray; infinite for the sky, whose place in a camera
             depends on its direction only; pixels whose depth is not above 0 are not valid.

    A pixel is looked up bilinearly in the camera whose axis is nearest in angle to the surface, among those that see
    it; where the next camera is hardly farther off, the two are blended over BLEND columns. A camera does not see what
    is outside its image, on the ego vehicle, or occluded by other pixels' surfaces. Pixels that no camera sees are not
    valid, and black. Raises ValueError where the depths do not fit the view.
    """
    if depth_m.shape != (view.rows, view.columns):
        raise ValueError(f"depths must be ({view.rows}, {view.columns}), got {tuple(depth_m.shape)}")
    points, size = _homogeneous(view, depth_m), view.rows * view.columns
    projected = [_project(camera, points, view.focal_px) for camera in cameras]
    nearest = torch.full((size,), torch.inf)
    for projection in projected:
        nearest[projection.pixel] = torch.minimum(nearest[projection.pixel], projection.angle)
    colours, weights = torch.zeros(3, size), torch.zeros(size)
    for camera, projection in zip(cameras, projected, strict=True):
        weight = (1 - (projection.angle - nearest[projection.pixel]) * (2 * view.focal_px / BLEND)).clamp(min=0)
        image = torch.from_numpy(camera.image).movedim(2, 0).float()
        colours.index_add_(1, projection.pixel, projection.lookup.linear(image) * weight)
        weights.index_add_(0, projection.pixel, weight)
    mixed = (colours / weights.clamp(min=1e-9)).round().clamp(0, 255).to(torch.uint8)
    valid = (weights > 0).view(view.rows, view.columns)
    return mixed.T.reshape(view.rows, view.columns, 3).contiguous().numpy(), valid.numpy()


class _Projected(NamedTuple):
    """The view's pixels that a camera sees: which (n,), where in its image, and the angle from its axis, radians."""

    pixel: Tensor
    lookup: Lookup
    angle: Tensor


def _homogeneous(view: View, depth_m: Tensor) -> Tensor:
    """Homogeneous coordinates (4, H W) float32 of the pixels' surfaces, sensor frame; of the sky, a direction."""
    ray = directions(view).reshape(-1, 3).T
    distance = depth_m.reshape(-1)
    ends = distance.isfinite() & (distance > 0)
    origin = torch.tensor(view.origin)[:, None]
    points = torch.where(ends, ray * distance.where(ends, 0.0) + origin, ray)
    scale = torch.where(ends, 1.0, torch.where(distance > 0, 0.0, torch.nan))
    return torch.cat([points, scale[None]])


def _project(camera: CameraImage, points: Tensor, focal_px: float) -> _Projected:
    """Project points (4, n) into a camera; focal_px: of the view."""
    calibration = camera.calibration
    width, height = calibration.size
    xyz = torch.from_numpy(calibration.T_camera_lidar[:3]).float() @ points
    places = _places(calibration, xyz)
    pixel = places[0].isfinite().nonzero()[:, 0]
    (column, row), (x, y, ahead) = places[:, pixel] + 0.5, xyz[:, pixel]
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    distance = xyz[:, pixel].norm(dim=0).where(points[3, pixel] > 0, torch.inf)
    camera_px = calibration.focal_px if isinstance(calibration, LensCalibration) else float(calibration.K[0, 0])
    scale = min(1.0, COARSE * focal_px / camera_px)
    visible = inside.clone()
    visible[inside] = ~_hidden(row[inside] * scale, column[inside] * scale, distance[inside])
    if camera.ego_mask is not None:
        visible[inside] &= ~torch.from_numpy(camera.ego_mask)[row[inside].long(), column[inside].long()]
    angle = torch.atan2(torch.hypot(x, y), ahead)[visible]
    lookup = Lookup(row=row[visible], column=column[visible], valid=torch.ones_like(angle).bool(), circular=False)
    return _Projected(pixel=pixel[visible], lookup=lookup, angle=angle)


def _places(calibration: Calibration | LensCalibration, xyz: Tensor) -> Tensor:
    """Pixels (u, v), (2, n) float32, of points (3, n), camera axes; NaN where the camera projects nothing."""
    if isinstance(calibration, LensCalibration):
        return torch.from_numpy(calibration.project(xyz.T.numpy())).T.float()
    K = torch.from_numpy(calibration.K).float()
    return (K[:2] @ xyz) / torch.where(xyz[2] > 0, xyz[2], torch.nan)


def _hidden(row: Tensor, column: Tensor, distance: Tensor) -> Tensor:
    """(n,) bool: another surface occludes the point, in a coarse depth buffer.

    row, column  (n,) raster coordinates in that buffer;  distance  (n,) metres, infinite for the sky.
    Occluders lose their border of one pixel: there a pixel holds the near and the far, which stand side by side.
    """
    if not len(row):
        return torch.zeros(0, dtype=torch.bool)
    height, width = int(row.max()) + 1, int(column.max()) + 1
    cell = row.long() * width + column.long()
    index = nearest_points(cell, distance, height * width)
    inverse = 1 / distance
    nearest = torch.where(index >= 0, inverse[index], 0.0)
    nearest = -max_pool2d(-nearest.view(1, height, width), 3, 1, 1)
    nearer = nearest.view(-1)[cell]
    return nearer - inverse > (nearer * NEARER).clamp(min=HIDES)
