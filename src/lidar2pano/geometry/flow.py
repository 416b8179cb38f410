"""Dense backward flow of static scenery between two frames, in a camera and on the cylinder.

It follows from the distances in both frames and the sensor's motion between them. Distances are measured along the ray
from the view's origin or the camera's optical centre, in metres: infinite for the sky, which only turns; 0 where
unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d, normalize, pad

from lidar2pano.calibration import Calibration
from lidar2pano.geometry.camera import camera_rays, points_in_camera
from lidar2pano.geometry.projection import directions, nearest_points, pixels
from lidar2pano.geometry.rasters import warp
from lidar2pano.views import View

SAME = 0.03  # share by which two distances of one surface may differ
FAINT = 5e-4  # 1/m, likewise near the horizon: depth images end at 256 m, and beyond is the sky
NONE = -1.0  # in place of an inverse distance
GAP_HALVINGS = 4  # halvings of the raster over which gaps between a scan's points are closed: 16 pixels


class Flow(NamedTuple):
    """Flow from each pixel to the place in the previous frame that shows the same surface.

    shift  (..., 2, H, W) float32 pixels: columns to the right, rows down; zero where not known.
    known  (..., H, W) bool, or float32 in [0, 1] where it is a confidence: the surface was visible.
    """

    shift: Tensor
    known: Tensor


def reaches(shift: Tensor, *, circular: bool = False) -> Tensor:
    """(B, H, W) bool: the place that a shift (B, 2, H, W) points to lies in the image; rims are half a pixel out."""
    rows, columns = shift.shape[-2:]
    column = torch.arange(columns, device=shift.device) + shift[:, 0]
    row = torch.arange(rows, device=shift.device)[:, None] + shift[:, 1]
    inside = (row >= -0.5) & (row <= rows - 0.5)
    return inside if circular else inside & (column >= -0.5) & (column <= columns - 0.5)


def chained(later: Flow, earlier: Flow, *, circular: bool = False) -> Flow:
    """Flow over two steps: `later` (B, ...) leads to the frame from which `earlier` leads on; confidences too."""
    shift = later.shift + warp(earlier.shift, later.shift, circular=circular)
    on = warp(earlier.known.float()[:, None], later.shift, circular=circular)[:, 0]
    known = later.known.float() * on * reaches(shift, circular=circular)
    known = known.where(known > FAINT, 0.0)  # not what rounding leaves of zero
    return Flow(shift=shift * (known > 0)[:, None], known=known)


def relative_pose(T_world_before: np.ndarray | Tensor, T_world_now: np.ndarray | Tensor) -> Tensor:
    """T_before_now (4, 4) float64 of two poses: the sensor's coordinates now -> its coordinates before, metres."""
    before, now = (torch.asarray(T, dtype=torch.float64, copy=True) for T in (T_world_before, T_world_now))
    return torch.linalg.inv(before) @ now


def ego_flow(
    now_m: Tensor, before_m: Tensor, T_before_now: Tensor, raster: View | Calibration, *, same: float = SAME
) -> Flow:
    """Flow of static scenery, (2, H, W) and (H, W) bool.

    now_m, before_m  (H, W) distances (see the module) in this frame and in the previous one.
    T_before_now     (4, 4) float64: the sensor's coordinates now -> its coordinates before, metres.
    raster           of both frames: a View (the panorama), or a camera.
    same             share by which two distances of one surface may differ.
    Known where both distances are, and agree: what was occluded, or what moved, is not known.
    Raises ValueError where the shapes do not fit the raster.
    """
    return ego_flows(now_m, before_m, T_before_now, raster, (same,))[0]


def ego_flows(
    now_m: Tensor, before_m: Tensor, T_before_now: Tensor, raster: View | Calibration, shares: Sequence[float]
) -> list[Flow]:
    """`ego_flow` for each of several shares by which two distances may differ; the motion is computed once."""
    size = (raster.rows, raster.columns) if isinstance(raster, View) else raster.size[::-1]
    if now_m.shape != size or before_m.shape != size:
        raise ValueError(f"distances must be {size}, got {tuple(now_m.shape)} and {tuple(before_m.shape)}")
    device, far = now_m.device, now_m.isinf()
    ends, origin = _ends(now_m, T_before_now, raster)
    row, column = _places(ends, origin, raster)
    circular = isinstance(raster, View) and raster.circular
    rows, columns = size
    x, y = torch.arange(columns, device=device), torch.arange(rows, device=device)[:, None]
    shift = torch.stack([column - x - 0.5, row - y - 0.5])
    if circular:
        shift[0] = (shift[0] + columns / 2).remainder(columns) - columns / 2
    shift = shift.nan_to_num(nan=float(rows + columns)).float()  # behind the camera: outside
    inside = reaches(shift[None], circular=circular)[0] & (now_m > 0)
    expected = torch.where(far, 0.0, 1 / ends.norm(dim=-1)).float()
    all_known = [inside & _unoccluded(before_m, shift, expected, circular, same) for same in shares]
    return [Flow(shift=shift * known, known=known) for known in all_known]


def moved_distances(before_m: Tensor, T_now_before: Tensor, view: View) -> Tensor:
    """Distances (H, W) float32 of the previous frame as they are now, metres; infinite for the sky, 0 where none is.

    before_m      (H, W) distances (see the module) in the previous frame.
    T_now_before  (4, 4) float64: the sensor's coordinates before -> its coordinates now, metres.
    Each pixel moves to where it is now; of several, the nearest stays. Gaps of up to two pixels, as where surfaces come
    nearer, take the nearest distance beside them.
    """
    ends, origin = _ends(before_m, T_now_before, view)
    row, column = (place.floor() for place in _places(ends, origin, view))
    reached = (before_m > 0) & (row >= 0) & (row < view.rows)
    if not view.circular:
        reached &= (column >= 0) & (column < view.columns)
    cell = (row * view.columns + column.remainder(view.columns))[reached].long()
    inverse = torch.where(before_m.isfinite(), 1 / ends.norm(dim=-1).float(), 0.0)[reached]
    distance = inverse.new_full((view.rows * view.columns,), NONE).scatter_reduce(0, cell, inverse, "amax")
    distance = distance.view(view.rows, view.columns)
    sides = pad(distance[None, None], (1, 1, 0, 0), "circular") if view.circular else distance[None, None]
    neighbour = max_pool2d(sides, 3, 1, padding=(1, 0 if view.circular else 1))[0, 0]
    distance = torch.where(distance == NONE, neighbour, distance)
    return torch.where(distance == NONE, 0.0, 1 / distance)


def _ends(now_m: Tensor, T_before_now: Tensor, raster: View | Calibration) -> tuple[Tensor, Tensor]:
    """Return the places of pixels' surfaces in the previous frame, (H, W, 3) float64 from a point; and the point."""
    device = now_m.device
    if isinstance(raster, View):
        rays = directions(raster, device=device).double()
    else:
        rays = normalize(camera_rays(raster).to(device), dim=-1)
    origin = torch.tensor(
        raster.origin if isinstance(raster, View) else raster.centre, dtype=torch.float64, device=device
    )
    return moved_ends(rays, now_m, T_before_now, origin), origin


def moved_ends(rays: Tensor, distance_m: Tensor, T: Tensor, origin: Tensor) -> Tensor:
    """Return where the ends of rays from a point are seen from it in another frame, (..., 3) float64 metres.

    rays    (..., 3) float64 unit vectors, sensor axes;  distance_m: (...) metres, of a ray that ends nowhere infinite:
            of that only the direction moves.
    T       (4, 4): the rays' coordinates -> the other frame's, metres;  origin: (3,) float64, the point in both frames.
    """
    T = T.to(rays)
    turn, step = T[:3, :3], T[:3, :3] @ origin + T[:3, 3] - origin
    far = distance_m.isinf()[..., None]
    measured = (distance_m.double()[..., None].where(~far, 0.0) * rays) @ turn.T + step
    return torch.where(far, rays @ turn.T, measured)


def scan_distances(xyz: Tensor, calibration: Calibration) -> Tensor:
    """Distances (h, w) float32 from the camera's optical centre of points (N, 3), sensor frame, metres; gaps closed.

    The nearest point owns its pixel. A gap of up to 16 pixels takes the mean of the points about it; what is farther
    from any point is 0.
    """
    width, height = calibration.size
    u, v, depth = points_in_camera(xyz, calibration)
    row, column = (v + 0.5).floor(), (u + 0.5).floor()
    inside = (depth > 0) & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    cell = (row * width + column)[inside].long()
    distance = (xyz[inside].double() - torch.tensor(calibration.centre)).norm(dim=1).float()
    index = nearest_points(cell, distance, height * width)
    nearest = torch.cat([distance, distance.new_full((1,), torch.inf)])[index]  # index -1 is the last
    completed = _completed((1 / nearest).view(height, width))
    return torch.where(completed > 0, 1 / completed, 0.0)


def _places(ends: Tensor, origin: Tensor, raster: View | Calibration) -> tuple[Tensor, Tensor]:
    """Raster coordinates (centres at .5) of places relative to the raster's point of view; NaN behind a camera."""
    if isinstance(raster, View):
        x, y, z = ends.unbind(-1)
        return pixels(x, y, z, raster)
    u, v, _ = points_in_camera((ends + origin).view(-1, 3), raster)
    return (v + 0.5).view(ends.shape[:-1]), (u + 0.5).view(ends.shape[:-1])


def _unoccluded(before_m: Tensor, shift: Tensor, expected: Tensor, circular: bool, same: float) -> Tensor:
    """(H, W) bool: the previous frame shows, at the shifted place, a surface at the distance 1 / `expected`.

    Compared are inverse distances, linear on planes: between pixels they can be looked up linearly.
    """
    inverse_and_valid = torch.stack([(1 / before_m).where(before_m > 0, 0.0), (before_m > 0).float()])
    inverse, known = warp(inverse_and_valid[None], shift[None], circular=circular)[0]
    return (known > 0.999) & ((inverse - expected).abs() <= same * torch.maximum(inverse, expected) + FAINT)


def _completed(values: Tensor) -> Tensor:
    """Fill the zeros of (h, w) with the mean of what is about them, from the coarsest level of a pyramid up."""
    height, width = values.shape
    padded = values.new_zeros(1, 2, *(-(-length // 2**GAP_HALVINGS) * 2**GAP_HALVINGS for length in (height, width)))
    padded[0, 0, :height, :width] = values
    padded[0, 1, :height, :width] = values > 0
    levels = [padded]  # sums, and how many: their ratio is the mean
    for _ in range(GAP_HALVINGS):
        levels.append(avg_pool2d(levels[-1], 2))
    completed = levels[-1]
    for level in reversed(levels[:-1]):
        completed = interpolate(completed, scale_factor=2.0, mode="bilinear")
        completed = torch.where(level[:, 1:] > 0, level, completed)
    return torch.where(completed[:, 1] > 0, completed[:, 0] / completed[:, 1], 0.0)[0, :height, :width]
