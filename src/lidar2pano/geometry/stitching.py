"""Stitching: the images of several cameras -> a panorama on the raster of a view.

The cameras stand beside the view's origin, so a pixel's place in their images depends on how far away the surface is:
the look-up needs a depth per pixel (`scene.depth` makes one of a scan). A wrong depth moves the look-up
by baseline x focal_px x |1/depth - 1/true| pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from lidar2pano.calibration import Calibration, LensCalibration
from lidar2pano.geometry.camera import Lookup
from lidar2pano.geometry.projection import directions
from lidar2pano.views import View

BLEND = 6  # columns over which the image of one camera is blended into the next one's
COARSE = 0.4  # the depth buffers that find what is hidden: pixels of a camera per pixel of the view
HIDES = 0.02  # 1/m by which an occluder must be nearer; at a baseline of 1 m that is 15 pixels of the panorama
NEARER = 0.15  # and the share of its inverse depth
BLACK, WHITE = 16, 235  # codes of ITU-R BT.601: what is beyond them may be clipped


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """One camera's image of the moment of a scan.

    image        (h, w, 3) uint8 RGB.
    calibration  of that size; what is beyond a lens's image circle is not used.
    ego_mask     (h, w) bool: True where the image shows the vehicle that carries the camera; None where it never does.
    name         for messages.
    time_s       when the image was taken, seconds after the scan; None: not known.
    gain         factors of red, green and blue.
    """

    image: np.ndarray
    calibration: Calibration | LensCalibration
    ego_mask: np.ndarray | None = None
    name: str = "camera"
    time_s: float | None = None
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        """Refuse parts whose sizes differ (ValueError)."""
        shape = self.calibration.size[::-1]
        if self.image.shape != (*shape, 3) or (self.ego_mask is not None and self.ego_mask.shape != shape):
            raise ValueError(f"Camera: image (h, w, 3) and ego_mask (h, w) must be {shape}, got {self.image.shape}")

    def colours(self, sight: Sight) -> Tensor:
        """Return what a sight shows, (3, n) float32 in 0 .. 255, multiplied by the gain; bilinear."""
        image = torch.tensor(self.image).movedim(2, 0).float()
        return sight.lookup.linear(image) * torch.tensor(self.gain)[:, None]


class Sight(NamedTuple):
    """Surfaces visible to a camera: their numbers (n,), places in its image, and angles from its axis, radians."""

    surface: Tensor
    lookup: Lookup
    angle: Tensor


# (inverse distance of the nearest surface, of a surface) -> whether the one hides the other
Occlusion = Callable[[Tensor, Tensor], Tensor]


def stands_before(nearest: Tensor, inverse: Tensor) -> Tensor:
    """Return whether a surface is nearer than another by more than HIDES and NEARER, by inverse distances in 1/m."""
    return nearest - inverse > (nearest * NEARER).clamp(min=HIDES)


def hides_nothing(nearest: Tensor, inverse: Tensor) -> Tensor:  # noqa: ARG001 an Occlusion
    """Return that no surface hides another: the Occlusion of what is transparent."""
    return torch.zeros_like(nearest, dtype=torch.bool)


def stitch(cameras: Sequence[Camera], view: View, depth_m: Tensor) -> tuple[np.ndarray, np.ndarray]:
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
    points, size = homogeneous(directions(view), depth_m, view.origin).flatten(1), view.rows * view.columns
    sights = [look(camera, points, view.focal_px) for camera in cameras]
    colours, weights = torch.zeros(3, size), torch.zeros(size)
    for camera, sight, weight in zip(cameras, sights, seam_weights(sights, size, view), strict=True):
        colours.index_add_(1, sight.surface, camera.colours(sight) * weight)
        weights.index_add_(0, sight.surface, weight)
    mixed = (colours / weights.clamp(min=1e-9)).round().clamp(0, 255).to(torch.uint8)
    valid = (weights > 0).view(view.rows, view.columns)
    return mixed.T.reshape(view.rows, view.columns, 3).contiguous().numpy(), valid.numpy()


def seam_weights(sights: Sequence[Sight], size: int, view: View) -> list[Tensor]:
    """Return the weights (n,) of each camera's surfaces, of `size`: 1 or, within BLEND columns of a seam, less."""
    nearest = torch.full((size,), torch.inf)
    for sight in sights:
        nearest[sight.surface] = torch.minimum(nearest[sight.surface], sight.angle)
    per_radian = 2 * view.focal_px / BLEND
    return [(1 - (sight.angle - nearest[sight.surface]) * per_radian).clamp(min=0) for sight in sights]


def homogeneous(ray: Tensor, depth_m: Tensor, origin: tuple[float, float, float]) -> Tensor:
    """Homogeneous coordinates (4, ...) float32 of pixels' surfaces, sensor frame; of the sky, a direction.

    ray  (..., 3) unit vectors from the origin;  depth_m: (...) metres, infinite in the sky; NaN unless above 0.
    """
    ends = depth_m.isfinite()
    scale = torch.where(depth_m > 0, ends, torch.nan)
    distance = depth_m.where(ends, 1.0)
    return torch.stack([*(ray[..., axis] * distance + scale * place for axis, place in enumerate(origin)), scale])


def look(
    camera: Camera,
    points: Tensor,
    focal_px: float,
    occlusion: Occlusion = stands_before,
    occluders: Tensor | None = None,
) -> Sight:
    """Return the visible ones of points (4, n), homogeneous, in a camera.

    focal_px   of the occluders' raster;  occluders: (4, m), the points themselves if None.
    """
    calibration = camera.calibration
    width, height = calibration.size
    surface, xyz, row, column, inverse = _project(camera, points)
    camera_px = calibration.focal_px if isinstance(calibration, LensCalibration) else float(calibration.K[0, 0])
    scale = min(1.0, COARSE * focal_px / camera_px)
    inside = (row, column, inverse) if occluders is None else _project(camera, occluders)[2:]
    buffer = _inverse_depths(*inside, scale, (height, width))
    visible = ~occlusion(buffer[(row * scale).long(), (column * scale).long()], inverse)
    if camera.ego_mask is not None:
        visible &= ~torch.from_numpy(camera.ego_mask)[row.long(), column.long()]
    row, column, surface, (x, y, ahead) = row[visible], column[visible], surface[visible], xyz[:, visible]
    angle = torch.atan2(torch.hypot(x, y), ahead)
    lookup = Lookup(row=row, column=column, valid=torch.ones_like(angle).bool(), circular=False)
    return Sight(surface=surface, lookup=lookup, angle=angle)


def _project(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Project points (4, n); of those in the image number (m,), camera axes (3, m), row, column and 1/distance (m,)."""
    width, height = camera.calibration.size
    xyz = torch.from_numpy(camera.calibration.T_camera_lidar[:3]).float() @ points
    column, row = _places(camera.calibration, xyz) + 0.5
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)  # NaN is not
    surface = inside.nonzero()[:, 0]
    xyz = xyz[:, surface]
    inverse = points[3, surface] * (xyz[0] * xyz[0] + xyz[1] * xyz[1] + xyz[2] * xyz[2]).rsqrt()
    return surface, xyz, row[surface], column[surface], inverse


def _places(calibration: Calibration | LensCalibration, xyz: Tensor) -> Tensor:
    """Pixels (u, v), (2, n) float32, of points (3, n), camera axes; NaN where the camera projects nothing."""
    if isinstance(calibration, LensCalibration):
        return torch.from_numpy(calibration.project(xyz.T.numpy())).T.float()
    K = torch.from_numpy(calibration.K).float()
    return (K[:2] @ xyz) / torch.where(xyz[2] > 0, xyz[2], torch.nan)


def _inverse_depths(row: Tensor, column: Tensor, inverse: Tensor, scale: float, size: tuple[int, int]) -> Tensor:
    """Return a coarse buffer (h, w) of the inverse distances of the nearest surfaces; 0 where there are none.

    row, column  (n,) in an image of `size` (rows, columns);  inverse: (n,) distances.
    scale        pixels of the buffer per pixel of the image.
    Occluders lose their border of one pixel: there a pixel holds the near and the far, which stand side by side.
    """
    height, width = (math.ceil(side * scale) for side in size)
    cell = (row * scale).long() * width + (column * scale).long()
    nearest = torch.zeros(height * width).scatter_reduce_(0, cell, inverse, "amax").view(1, height, width)
    return -max_pool2d(-nearest, 3, 1, 1)[0]
