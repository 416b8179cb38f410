"""The ground: the height of a viewpoint above the road, and the plane of a scan whose classes are unknown."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lidar2pano.scene.surfaces import cylinder_points
from lidar2pano.views import View

ROAD_Z_M = -1.73  # height of the road in the sensor frame where no road is visible: KITTI's LiDAR stands so high
ROAD_NEAR_M, ROAD_FAR_M = 3.0, 20.0  # horizontal distances between which the road's height is read
ROAD_LOWEST_M, ROAD_HIGHEST_M = -4.0, -0.5  # bounds of the height of a road below a vehicle's roof
ROAD_PIXELS = 50  # least number of pixels of road, of every fourth column
CLEAR_OF_VEHICLE_M = 3.0  # horizontal distance of points that do not lie on the sensor's own vehicle
FITTED_WITHIN_M = 25.0  # horizontal distance up to which a plane is fitted
CELL_M = 2.0  # side of the squares whose lowest points may be ground
OFF_PLANE_M = (0.6, 0.3, 0.15)  # distances off the plane beyond which a cell is left out, fit after fit
LEAST_CELLS = 6  # that a plane is fitted to


def viewpoint_height(depth_m: Tensor, road: Tensor, view: View) -> Tensor:
    """Return the height (B,) float32 of a view's origin above the road, metres: from the median of the road's pixels.

    depth_m  (B, H, W): distances from the view's origin along the rays;  road: (B, H, W) bool, pixels of road.
    Pixels between ROAD_NEAR_M and ROAD_FAR_M count; the road lies at ROAD_Z_M where too few do or the median is out of
    bounds.
    """
    radius_m, above_m = cylinder_points(depth_m, view)
    z_m = above_m + view.origin[2]
    heights = z_m.new_full((len(z_m),), ROAD_Z_M)
    near = road & (radius_m > ROAD_NEAR_M) & (radius_m < ROAD_FAR_M)
    for number, (z, mask) in enumerate(zip(z_m[..., ::4], near[..., ::4], strict=True)):
        road_z = z[mask]
        if len(road_z) >= ROAD_PIXELS:
            median = road_z.median()
            heights[number] = torch.where((median > ROAD_LOWEST_M) & (median < ROAD_HIGHEST_M), median, ROAD_Z_M)
    return view.origin[2] - heights


def ground_plane(xyz: Tensor) -> tuple[float, float, float] | None:
    """Fit the ground's plane z = a x + b y + c around the sensor, metres; None where too little of it is visible.

    xyz  (N, 3) float32 points, sensor frame. Least squares over the lowest points of squares; squares that lie off the
    plane are left out and the fit is repeated.
    """
    distance = torch.hypot(xyz[:, 0], xyz[:, 1])
    near = xyz[(distance < FITTED_WITHIN_M) & (distance > CLEAR_OF_VEHICLE_M) & xyz[:, 2].isfinite()].double()
    near = near[near[:, 2].argsort()]
    square = (near[:, :2] / CELL_M).floor().long()
    _, lowest = np.unique((square[:, 0] * 1000 + square[:, 1]).numpy(), return_index=True)  # the first, so the lowest
    if len(lowest) < LEAST_CELLS:
        return None
    low = near[torch.from_numpy(lowest)]
    system, z = torch.cat([low[:, :2], low.new_ones(len(low), 1)], 1), low[:, 2]
    off, plane = z - z.quantile(0.3), None
    for most in OFF_PLANE_M:
        inlier = off.abs() < most
        if inlier.sum() < LEAST_CELLS:
            break
        plane = torch.linalg.lstsq(system[inlier], z[inlier]).solution
        off = z - system @ plane
    return None if plane is None else (float(plane[0]), float(plane[1]), float(plane[2]))
