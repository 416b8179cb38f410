"""The shape of what a panorama shows, from its depths: points in cylinder coordinates, normals, height of the road.

Everything is expressed in each column's own axes (radial, tangential to the left, up), so that turning the depths by
whole columns turns the answer.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lidar2pano.views import View

ROAD_Z_M = -1.73  # of the road in the sensor frame where no road is visible: KITTI's LiDAR stands so high
ROAD_NEAR_M, ROAD_FAR_M = 3.0, 20.0  # distances at which the road's height is read
ROAD_LOWEST_M, ROAD_HIGHEST_M = -4.0, -0.5  # heights beyond these are no road below a vehicle's roof
ROAD_PIXELS = 50  # fewer say nothing


def slopes(view: View, *, device: str | torch.device = "cpu") -> Tensor:
    """Tangents (H,) float32 of the elevation of a view's rows."""
    row = torch.arange(view.rows, dtype=torch.float64, device=device) + 0.5
    height = view.up - row / view.rows * (view.up - view.down)
    return (torch.tan(torch.deg2rad(height)) if view.kind == "sphere" else height).float()


def azimuths(view: View, *, device: str | torch.device = "cpu") -> Tensor:
    """Azimuths (W,) float64 of a view's columns, radians, counter-clockwise from the sensor's x axis."""
    column = torch.arange(view.columns, dtype=torch.float64, device=device) + 0.5
    return math.radians(view.left) - column / view.columns * math.radians(view.left - view.right)


def cylinder_points(depth_m: Tensor, view: View) -> tuple[Tensor, Tensor]:
    """Horizontal distance from the view's axis and height above its origin, (B, H, W) float32 metres each.

    depth_m  (B, H, W): distances from the view's origin along the rays.
    """
    slope = slopes(view, device=depth_m.device)[:, None]
    radius_m = depth_m.float() / torch.sqrt(1 + slope * slope)
    return radius_m, radius_m * slope


def normals(radius_m: Tensor, z_m: Tensor, view: View) -> Tensor:
    """Unit normals (B, 3, H, W) of the surface through the points of `cylinder_points`: radial, tangential, up.

    The cross product of central differences down the rows and along the columns; columns are circular, the first and
    the last row have the normals of their neighbours.
    """
    step = 1 / view.focal_px
    right, left = radius_m.roll(-1, 2), radius_m.roll(1, 2)
    across = ((right - left) * math.cos(step), (right + left) * -math.sin(step), z_m.roll(-1, 2) - z_m.roll(1, 2))
    down_radius, down_z = (_central(part) for part in (radius_m, z_m))
    normal = torch.stack(
        [
            -down_z * across[1],
            down_z * across[0] - down_radius * across[2],
            down_radius * across[1],
        ],
        1,
    )
    return normal * torch.rsqrt(normal.square().sum(1, keepdim=True) + 1e-12)


def _central(x: Tensor) -> Tensor:
    """Differences between the rows below and above: (B, H, W) -> the same shape."""
    inner = x[:, 2:] - x[:, :-2]
    return torch.cat([inner[:, :1], inner, inner[:, -1:]], 1)


def road_height(radius_m: Tensor, z_m: Tensor, road: Tensor) -> Tensor:
    """Height (B,) float32 of the road in metres below or above the sensor frame's origin: the median of its pixels.

    z_m   (B, H, W): heights in the sensor frame;  road (B, H, W) bool: pixels that are road.
    Only pixels at distances of ROAD_NEAR_M to ROAD_FAR_M count; ROAD_Z_M where too few do or the answer cannot be.
    """
    heights = z_m.new_full((len(z_m),), ROAD_Z_M)
    near = road & (radius_m > ROAD_NEAR_M) & (radius_m < ROAD_FAR_M)
    for number, (z, chosen) in enumerate(zip(z_m[..., ::4], near[..., ::4], strict=True)):
        found = z[chosen]
        if len(found) >= ROAD_PIXELS:
            median = found.median()
            heights[number] = torch.where((median > ROAD_LOWEST_M) & (median < ROAD_HIGHEST_M), median, ROAD_Z_M)
    return heights


def viewpoint_height(radius_m: Tensor, z_m: Tensor, road: Tensor, view: View) -> Tensor:
    """How high a view's origin is above the road, (B,) float32 metres; heights (B, H, W) as of `cylinder_points`."""
    return view.origin[2] - road_height(radius_m, z_m + view.origin[2], road)
