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
from torch.nn.functional import grid_sample

from lidar2pano.calibration import Calibration, LensCalibration
from lidar2pano.geometry.projection import headings_and_rises
from lidar2pano.geometry.rasters import indices_of, largest_around
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
        grid = sight.place * (2 / torch.tensor(self.calibration.size))[:, None] - 1
        shown = grid_sample(image[None], grid.T[None, None], padding_mode="border", align_corners=False)[0, :, 0]
        return shown.mul_(torch.tensor(self.gain)[:, None])


class Sight(NamedTuple):
    """Surfaces visible to a camera: their numbers (n,), and angles (n,) from its axis, radians.

    place  (2, n) columns and rows in its image, in raster coordinates (centres at .5).
    """

    surface: Tensor
    place: Tensor
    angle: Tensor


# (inverse distance of the nearest surface, of a surface) -> whether the one hides the other
Occlusion = Callable[[Tensor, Tensor], Tensor]


def stands_before(nearest: Tensor, inverse: Tensor) -> Tensor:
    """Return whether a surface is nearer than another by more than HIDES and NEARER, by inverse distances in 1/m."""
    return nearest - inverse > (nearest * NEARER).clamp(min=HIDES)


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
    size, depths = view.rows * view.columns, homogeneous(depth_m)
    sights = [look(camera, surfaces_in(camera, view, depths).flatten(1), view.focal_px) for camera in cameras]
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
        nearest.scatter_reduce_(0, sight.surface, sight.angle, "amin")
    per_radian = 2 * view.focal_px / BLEND
    farther = (sight.angle - nearest.index_select(0, sight.surface) for sight in sights)
    return [(1 - angle.mul_(per_radian)).clamp_(min=0) for angle in farther]


def homogeneous(depth_m: Tensor) -> Tensor:
    """Return depths (h, w) as distances and denominators (2, h, w), 1 and 0 where infinite; NaN unless above 0."""
    ends = depth_m.isfinite()
    return torch.stack([torch.where(ends, depth_m, 1.0), torch.where(depth_m > 0, ends, torch.nan)])


def surfaces_in(
    camera: Camera,
    view: View,
    depths: Tensor,
    rows: slice | Tensor = slice(None),
    columns: slice | Tensor = slice(None),
) -> Tensor:
    """Return homogeneous coordinates (4, h, w) float32 of pixels' surfaces in a camera's axes; of the sky, a direction.

    depths         (2, h, w), `homogeneous`, metres from the view's origin.
    rows, columns  of the view that these are.
    """
    T = torch.from_numpy(camera.calibration.T_camera_lidar)
    heading, (level, upward) = (
        part[:, chosen] for part, chosen in zip(headings_and_rises(view), (columns, rows), strict=True)
    )
    offset = T[:3, :3] @ T.new_tensor(view.origin) + T[:3, 3]
    turn, rise = (T[:3, :2] @ heading).float(), (T[:3, 2:3] * (upward / level)).float()
    distance, denominator = depths
    horizontal = distance * level.float()[:, None]
    points = torch.empty(4, *distance.shape)
    for axis in range(3):
        torch.add(turn[axis], rise[axis][:, None], out=points[axis])
        points[axis].mul_(horizontal).add_(denominator, alpha=float(offset[axis]))
    points[3] = denominator
    return points


def points_in(camera: Camera, points: Tensor) -> Tensor:
    """Return points (3, n), sensor frame, as homogeneous coordinates (4, n) float32 in a camera's axes."""
    T = torch.from_numpy(camera.calibration.T_camera_lidar[:3]).float()
    return torch.cat([T[:, :3] @ points + T[:, 3:], torch.ones(1, points.shape[1])])


def look(
    camera: Camera,
    points: Tensor,
    focal_px: float,
    occlusion: Occlusion | None = stands_before,
    occluders: Tensor | None = None,
) -> Sight:
    """Return the visible ones of points (4, n), homogeneous, in a camera's axes.

    focal_px   of the occluders' raster;  occluders: (4, m), the points themselves if None.
    occlusion  None: nothing hides another.
    """
    calibration = camera.calibration
    surface, place, inverse = _project(camera, points)
    visible = torch.ones_like(surface, dtype=torch.bool)
    if occlusion is not None:
        camera_px = calibration.focal_px if isinstance(calibration, LensCalibration) else float(calibration.K[0, 0])
        scale = min(1.0, COARSE * focal_px / camera_px)
        height, width = (math.ceil(side * scale) for side in calibration.size[::-1])
        cell = _cells(place * scale, width)
        inside = cell, inverse
        if occluders is not None:
            _, occluder_place, occluder_inverse = _project(camera, occluders)
            inside = _cells(occluder_place * scale, width), occluder_inverse
        nearest = _inverse_depths(*inside, (height, width)).flatten().index_select(0, cell)
        visible = ~occlusion(nearest, inverse)
    if camera.ego_mask is not None:
        own_vehicle = torch.from_numpy(camera.ego_mask).flatten()
        visible &= ~own_vehicle.index_select(0, _cells(place, calibration.size[0]))
    chosen = indices_of(visible)
    surface = surface.index_select(0, chosen)
    x, y, ahead = points[:3].index_select(1, surface)
    return Sight(surface, place.index_select(1, chosen), torch.atan2(torch.hypot(x, y), ahead))


def _project(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Project points (4, n) as of `look`: number (m,), column and row (2, m), 1/distance (m,) of those in the image."""
    width, height = camera.calibration.size
    place = _places(camera.calibration, points[:3]) + 0.5
    column, row = place
    surface = indices_of((row >= 0) & (row < height) & (column >= 0) & (column < width))  # NaN is not
    place = place.index_select(1, surface)
    x, y, z, scale = points.index_select(1, surface)
    return surface, place, (x * x + y * y + z * z).rsqrt_().mul_(scale)


def _cells(place: Tensor, width: int) -> Tensor:
    """Return the numbers (n,) of the pixels at places (2, n), columns and rows, in an image of a width."""
    column, row = place.long()
    return row.mul_(width).add_(column)


def _places(calibration: Calibration | LensCalibration, xyz: Tensor) -> Tensor:
    """Pixels (u, v), (2, n) float32, of points (3, n), camera axes; NaN where the camera projects nothing."""
    if isinstance(calibration, LensCalibration):
        return torch.from_numpy(calibration.project(xyz.T.numpy())).T.float()
    K = torch.from_numpy(calibration.K).float()
    return (K[:2] @ xyz) / torch.where(xyz[2] > 0, xyz[2], torch.nan)


def _inverse_depths(cell: Tensor, inverse: Tensor, size: tuple[int, int]) -> Tensor:
    """Return a coarse buffer (h, w), its `size`, of the inverse distances of the nearest surfaces; 0 if there are none.

    cell  (n,) numbers of its pixels;  inverse: (n,) distances.
    Occluders lose their border of one pixel: there a pixel holds the near and the far, which stand side by side.
    """
    height, width = size
    nearest = torch.zeros(height * width).scatter_reduce_(0, cell, inverse, "amax").view(height, width)
    return -largest_around(-nearest)


def metered_gain(level: float, cameras: Sequence[Camera], levels: Sequence[float]) -> float:
    """Return the factor from a panorama's codes to those of a camera without an image; 1 if the others do not tell.

    level   mean code of the panorama in its view.
    levels  mean codes of the images of `cameras`, whose gains are the panorama's.
    A panorama has one exposure; a camera meters its own view. Two guesses at the mean level (code of sRGB) of its
    image: that of the others' images, if each meters its own view, and that of the panorama there, if they share one
    exposure. Their variances are those of the others' levels, and of the gains between the others; both guesses are
    averaged by their inverse variances.
    """
    if len(cameras) < 2 or min(level, *levels) <= 0:
        return 1.0
    own, gain = np.log(levels), np.log([np.mean(camera.gain) for camera in cameras])
    metered_variance, shared_variance = own.var(ddof=1), gain.var(ddof=1)
    if shared_variance == 0:
        return 1.0
    share = shared_variance / (metered_variance + shared_variance)
    metered, shared = own.mean() - np.log(level), -gain.mean()
    return float(np.exp(share * metered + (1 - share) * shared))
