"""Surfaces and the ground of a panorama, from its depths: points, normals, neighbours on one surface, instances.

Everything is expressed in each column's own axes (radial, tangential to the left, up), so that turning the depths by
whole columns turns the answer. Profiles read columns from above, for things that are laid out on the ground.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from lidar2pano.labels import THINGS
from lidar2pano.views import View

# Largest ratio of the distances of two neighbours that are taken to be of one surface. On a plane that is seen under an
# angle of incidence i, neighbours an angle d apart differ by a factor of about exp(d tan(i)): beams 2 degrees apart, as
# of the sparsest sensors, reach it at 84 degrees, and hardly an echo returns beyond. Smaller ratios err more;
# larger ones less on hidden points, but in towns fewer depths are within 25 % (RESULTS.md, numbers of measured depths).
SAME_SURFACE = 1.4
ROAD_Z_M = -1.73  # height of the road in the sensor frame where no road is visible: KITTI's LiDAR stands so high
ROAD_NEAR_M, ROAD_FAR_M = 3.0, 20.0  # horizontal distances between which the road's height is read
ROAD_LOWEST_M, ROAD_HIGHEST_M = -4.0, -0.5  # bounds of the height of a road below a vehicle's roof
ROAD_PIXELS = 50  # least number of pixels of road, of every fourth column
CLEAR_OF_VEHICLE_M = 3.0  # horizontal distance of points that do not lie on the sensor's own vehicle
FITTED_WITHIN_M = 25.0  # horizontal distance up to which a plane is fitted
CELL_M = 2.0  # side of the squares whose lowest points may be ground
OFF_PLANE_M = (0.6, 0.3, 0.15)  # distances off the plane beyond which a cell is left out, fit after fit
LEAST_CELLS = 6  # that a plane is fitted to
# Least number of pixels of an instance: that of Cityscapes' benchmark of instances (cityscapesscripts,
# evalInstanceLevelSemanticLabeling.py, minRegionSizes). Smaller surfaces have a class only.
LEAST_PIXELS = 100


def same_surface(distance: Tensor, neighbour: Tensor) -> Tensor:
    """Return whether neighbours are of one surface, by their distances or their inverse distances (any one shape)."""
    return torch.maximum(distance, neighbour) < SAME_SURFACE * torch.minimum(distance, neighbour)


def hides(nearest: Tensor, inverse: Tensor) -> Tensor:
    """Return whether a surface hides another by their inverse distances: it is nearer, and not the same surface."""
    return (nearest > inverse) & ~same_surface(nearest, inverse)


def slopes(view: View, *, device: str | torch.device = "cpu") -> Tensor:
    """Return the tangents (H,) float32 of the elevation of a view's rows."""
    row = torch.arange(0.5, view.rows, dtype=torch.float64, device=device)
    height = view.up - row / view.rows * (view.up - view.down)
    return (torch.tan(torch.deg2rad(height)) if view.kind == "sphere" else height).float()


def azimuths(view: View, *, device: str | torch.device = "cpu") -> Tensor:
    """Return the azimuths (W,) float64 of a view's columns, radians, counter-clockwise from the sensor's x axis."""
    column = torch.arange(0.5, view.columns, dtype=torch.float64, device=device)
    return math.radians(view.left) - column / view.columns * math.radians(view.left - view.right)


def cylinder_points(depth_m: Tensor, view: View) -> tuple[Tensor, Tensor]:
    """Return the distance from the view's axis and the height above its origin, (B, H, W) float32 metres each.

    depth_m  (B, H, W): distances from the view's origin along the rays.
    """
    slope = slopes(view, device=depth_m.device)[:, None]
    radius_m = depth_m.float() / torch.sqrt(1 + slope * slope)
    return radius_m, radius_m * slope


def normals(radius_m: Tensor, z_m: Tensor, view: View) -> Tensor:
    """Return unit normals (B, 3, H, W) of the surface through the points of `cylinder_points`: radial, tangential, up.

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
    """Return differences between the rows below and above: (B, H, W) -> the same shape."""
    inner = x[:, 2:] - x[:, :-2]
    return torch.cat([inner[:, :1], inner, inner[:, -1:]], 1)


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


def thing_instances(segments: np.ndarray, depth_m: np.ndarray, measured: np.ndarray, *, circular: bool) -> np.ndarray:
    """Return the number (H, W) int32 of each pixel's instance, from 1 in the order of rows; 0 for none.

    An instance is a connected surface (`same_surface` of neighbours to the side, above and below) of one class of
    THINGS with LEAST_PIXELS and a point of the scan at least; others are guesses about one thing or several.

    segments  (H, W) ids of COMMON15;  depth_m: (H, W) metres;  measured: (H, W) bool, pixels with a point.
    circular  whether the first column is the last one's neighbour.
    """
    things = np.isin(segments, THINGS) & (depth_m > 0)
    node = np.full(segments.shape, -1)
    node[things] = np.arange(things.sum())
    pairs = [_joined(node, segments, depth_m, axis, circular=circular and axis == 1) for axis in (0, 1)]
    first, second = (np.concatenate(ends) for ends in zip(*pairs, strict=True))
    surface = np.full(segments.shape, -1)
    surface[things] = components(int(things.sum()), first, second)
    pixels = np.bincount(surface[things], minlength=1)
    points = np.bincount(surface[things], weights=measured[things], minlength=1)
    kept = (pixels >= LEAST_PIXELS) & (points > 0)
    number = np.where(kept, kept.cumsum(), 0).astype(np.int32)
    return np.where(things, number[surface], 0).astype(np.int32)


def _joined(
    node: np.ndarray, segments: np.ndarray, depth_m: np.ndarray, axis: int, *, circular: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs of nodes that are neighbours along an axis and of one class and surface."""
    next_node, next_class, next_m = (np.roll(layer, -1, axis) for layer in (node, segments, depth_m))
    joined = (node >= 0) & (next_node >= 0) & (segments == next_class)
    joined &= same_surface(torch.from_numpy(depth_m), torch.from_numpy(next_m)).numpy()
    if not circular:
        joined[(slice(None),) * axis + (-1,)] = False
    return node[joined], next_node[joined]


def components(nodes: int, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the number (N,) of each node's connected component, from 0 in the order of their first nodes.

    first, second  the ends of each edge. Roots are hooked onto smaller ones and paths halved, in a number of rounds
    that grows with the logarithm of N (Shiloach and Vishkin, 1982).
    """
    root = np.arange(nodes)
    while True:
        one, other = root[first], root[second]
        if (one == other).all():
            return np.unique(root, return_inverse=True)[1]
        np.minimum.at(root, np.maximum(one, other), np.minimum(one, other))
        while (root[root] != root).any():
            root = root[root]
