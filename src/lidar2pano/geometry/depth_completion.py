"""A depth for every pixel of a panorama, from the scan alone: what lies between the LiDAR's rings is guessed.

On a cylinder the inverse of the horizontal distance is linear in the row, on every plane: it is what is interpolated.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from lidar2pano.geometry.columns import rows_beside
from lidar2pano.geometry.projection import directions, project_points
from lidar2pano.views import View

BEYOND = 0.12  # tangent above and below the view up to which points count: rings may lie 4 degrees apart there
BESIDE = 1 / 183  # radians over which a ring is closed to either side: LiDARs take 1000 to 2000 points a turn
ONE_SURFACE = 1.25  # ratio of distances below which two points above each other are taken to be of one surface
ON_GROUND = 1.2  # likewise, below which a point is taken to lie on the ground's plane
RIM = 0.012  # tangent up to which a surface goes on beyond its last point where the sky follows: two rings
WIDE = 0.08  # tangent over which, between two surfaces, some ring would have met something: rings are 4 degrees apart
EGO_VEHICLE = (3.0, 1.1)  # metres ahead of and behind the sensor, and to its sides: points there lie on its own car
CLEAR_OF_CAR = 3.0  # metres: slopes of nearer points say little
GROUND_WITHIN, GROUND_REACH = 25.0, 80.0  # metres: where the ground's plane is fitted, and up to where it is believed
CELL = 2.0  # metres: the lowest point of each such square may be ground
OFF_PLANE = (0.6, 0.3, 0.15)  # metres off the plane beyond which cells are left out, fit after fit


def complete_depth(xyz: Tensor, view: View) -> Tensor:
    """Distance (H, W) float32 of every pixel from the view's origin along its ray, metres; infinite where it is sky.

    xyz  (N, 3) float32 points, sensor frame, metres;  view: a cylinder (ValueError otherwise).

    Points on the car that carries the sensor are left out. What was measured stays: the nearest point owns its pixel.
    Gaps of a ring take the nearest point of their row, the nearer to the eye of two, up to BESIDE away. Between two
    points of a column lies their surface, if they are of one; else, where the lower is on the ground, the ground up to
    the upper's distance; else the surface of the point in the nearer row. But where nothing answered over WIDE it is
    sky, as far as the ground allows. Below a column's lowest point lies the ground or, where that is nearer, the
    point's surface. Above its topmost lies the point's surface for a little, or all the way up where the sensor looks
    no higher; and then the ground and the sky. A column without points is ground and sky. Points a little above and
    below the view count, too.
    """
    if view.kind != "cylinder":
        raise ValueError("depths are filled on a cylinder, on whose columns planes are straight")
    xyz = xyz[(xyz[:, 0].abs() > EGO_VEHICLE[0]) | (xyz[:, 1].abs() > EGO_VEHICLE[1])]
    step = (view.up - view.down) / view.rows
    more = math.ceil(BEYOND / step)  # rows
    inner = slice(more, more + view.rows)
    view = replace(view, rows=view.rows + 2 * more, up=view.up + more * step, down=view.down - more * step)
    image = project_points(xyz, xyz.new_zeros(len(xyz)), view)
    flat = torch.hypot(image.channels[1], image.channels[2])
    inverse = torch.where(image.valid & (flat > 0), 1 / flat, 0.0)
    inverse = _closed_rings(inverse, max(1, round(BESIDE * view.focal_px)), circular=view.circular)
    ray = directions(view)
    ray = ray / torch.hypot(ray[..., :1], ray[..., 1:2])  # as far as one metre on the ground
    completed = _completed(inverse, ray, xyz, view)
    depth = torch.where(image.valid, image.channels[0], ray.norm(dim=2) / completed)  # 1/0: infinite
    return depth[inner].contiguous()


def ground_plane(xyz: Tensor) -> tuple[float, float, float] | None:
    """The ground's plane z = a x + b y + c around the sensor, metres; None where too little of it is seen.

    xyz  (N, 3) float32 points, sensor frame. Fitted by least squares to the lowest points of squares, those that lie
    off the plane left out again and again.
    """
    distance = torch.hypot(xyz[:, 0], xyz[:, 1])
    near = xyz[(distance < GROUND_WITHIN) & (distance > CLEAR_OF_CAR) & xyz[:, 2].isfinite()].double()
    near = near[near[:, 2].argsort()]
    square = (near[:, :2] / CELL).floor().long()
    _, lowest = np.unique((square[:, 0] * 1000 + square[:, 1]).numpy(), return_index=True)  # the first, so the lowest
    if len(lowest) < 6:
        return None
    low = near[torch.from_numpy(lowest)]
    system, z = torch.cat([low[:, :2], low.new_ones(len(low), 1)], 1), low[:, 2]
    off, plane = z - z.quantile(0.3), None
    for most in OFF_PLANE:
        kept = off.abs() < most
        if kept.sum() < 6:
            break
        plane = torch.linalg.lstsq(system[kept], z[kept]).solution
        off = z - system @ plane
    return None if plane is None else (float(plane[0]), float(plane[1]), float(plane[2]))


def _closed_rings(inverse: Tensor, reach: int, *, circular: bool) -> Tensor:
    """Empty pixels (zero) get their row's nearest value, up to `reach` columns away."""
    closed = inverse
    for away in range(1, reach + 1):
        left, right = inverse.roll(away, 1), inverse.roll(-away, 1)
        if not circular:
            left[:, :away] = right[:, -away:] = 0
        closed = torch.where(closed > 0, closed, torch.maximum(left, right))
    return closed


def _completed(inverse: Tensor, ray: Tensor, xyz: Tensor, view: View) -> Tensor:
    """Fill a picture (H, W) of inverse horizontal distances down its columns; zero stays where the sky is."""
    rows = view.rows
    row = torch.arange(rows)[:, None].expand_as(inverse)
    there = inverse > 0
    above, below = rows_beside(there)
    upper = inverse.gather(0, above.clamp(min=0)) * (above >= 0)
    lower = inverse.gather(0, below.clamp(max=rows - 1)) * (below < rows)
    share = ((row - above) / (below - above).clamp(min=1)).float()
    one_surface = torch.maximum(upper, lower) < ONE_SURFACE * torch.minimum(upper, lower)
    ground = _ground(ray, xyz, view)
    lift = lower / ground.gather(0, below.clamp(max=rows - 1))  # 1 where the lower point is on the plane
    on_ground = (lift > 1 / ON_GROUND) & (lift < ON_GROUND)
    nearer_row = torch.where(share <= 0.5, upper, lower)
    between = torch.where(on_ground, torch.maximum(upper, ground * lift), nearer_row)
    step = (view.up - view.down) / rows
    open_sky = ((below - above) * step > WIDE) & (torch.minimum(row - above, below - row) * step > RIM) & (ground == 0)
    between = torch.where(open_sky, 0.0, between)
    between = torch.where(one_surface, upper + (lower - upper) * share, between)
    over = torch.where(row >= _rims(inverse, below, ray, xyz, view), lower, ground)
    under = torch.maximum(ground, upper)
    completed = torch.where(above < 0, over, between).where(below < rows, under)
    return torch.where(there, inverse, completed)


def _rims(inverse: Tensor, below: Tensor, ray: Tensor, xyz: Tensor, view: View) -> Tensor:
    """(W,) the row up to which the surface of a column's topmost point goes on above it: 0 where it was cut off."""
    top, column = below[0].clamp(max=view.rows - 1), torch.arange(view.columns)
    rim = top - RIM * view.rows / (view.up - view.down)
    distance = torch.hypot(xyz[:, 0], xyz[:, 1])
    slope = xyz[:, 2] / distance
    slopes = slope[(distance > CLEAR_OF_CAR) & slope.isfinite()]
    if not len(slopes):
        return rim
    point = ray[top, column] / inverse[top, column, None] + ray.new_tensor(view.origin)
    cut_off = point[:, 2] / torch.hypot(point[:, 0], point[:, 1]) > slopes.max() - RIM
    return torch.where(cut_off, 0.0, rim)


def _ground(ray: Tensor, xyz: Tensor, view: View) -> Tensor:
    """(H, W) inverse horizontal distance of the ground's plane, zero beyond GROUND_REACH and where it is not known."""
    plane = ground_plane(xyz)
    if plane is None:
        return ray.new_zeros(ray.shape[:2])
    a, b, c = plane
    height = view.origin[2] - (a * view.origin[0] + b * view.origin[1] + c)
    if height <= 0:
        return ray.new_zeros(ray.shape[:2])
    inverse = (a * ray[..., 0] + b * ray[..., 1] - ray[..., 2]) / height
    return torch.where(inverse > 1 / GROUND_REACH, inverse, 0.0)
