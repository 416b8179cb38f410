"""Depths from measurement: a translator's that keep to the points, those of a scan alone, points between beams, echoes.

A translator that learns depths from some pixels of each frame blurs them: neighbouring rows of one wall differ by a
fifth. Each pixel of a scene therefore takes the distance of a measured surface of its column; the translator selects
the surface. Without a translator, the gaps between the LiDAR's rings are filled from the points alone.
On a cylinder the inverse of the horizontal distance is linear in the row, on every plane, and nearly so in azimuth over
a degree or two: it is interpolated. A sensor with fewer beams than a raster has rows gets points between them, since
networks that were trained on rasters that an HDL-64E fills see 16 beams as lines in the void.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from lidar2pano.geometry.projection import RangeImage, directions, project, project_points
from lidar2pano.geometry.rasters import adjacent_rows, as_float, select
from lidar2pano.labels import COMMON15
from lidar2pano.scan import Scan
from lidar2pano.scene.surfaces import CLEAR_OF_VEHICLE_M, cylinder_points, ground_plane, same_surface, slopes
from lidar2pano.views import View

# What each number of `measured_depth` is worth is in RESULTS.md (runs/depth_ablation.py).
NEAREST_M, FARTHEST_M = 0.5, 1000.0  # horizontal distances; nearer points lie on the vehicle itself
ON_GROUND = 1.2  # ratio of a point's distance to the ground's in its row, below which it is taken to lie on the ground
TOPMOST_PX = 2  # columns on either side whose points say how far a surface above a column's own points is
EVEN_PX = (1, 2, 4)  # distances of opposite pixels that are averaged on a surface: noise, and rings out of line
ON_PLANE = 0.03  # share of the inverse distance by which the mean of two opposite pixels may differ on a plane
CROWN_PX = 12  # columns on either side over which crowns are averaged: their own points lie near and far at random
CROWN_GUESSED = 0.1  # power of the translator's distances in those of crowns, which are nearer than their lowest twigs
BEYOND = 0.12  # tangent above and below the view up to which points count: rings may lie 4 degrees apart there
RING_GAP_RAD = 1 / 183  # to either side of a point: LiDARs take 1000 to 2000 points a turn
RIM = 0.012  # tangent up to which a surface goes on above its last point where the sky follows: two rings
OPEN_SKY = 0.08  # tangent over which a ring would have met something between two surfaces: rings are 4 degrees apart
EGO_VEHICLE = (3.0, 1.1)  # metres ahead of and behind the sensor, and to its sides: points there lie on its own vehicle
GROUND_REACH_M = 80.0  # horizontal distance up to which the ground's plane is believed
ROAD, VEGETATION = map(COMMON15.id_of, ("road", "vegetation"))
FAR_M = 120.0  # networks read and predict depths as log(1 + m) / log(1 + FAR_M)
LOG_FAR = float(torch.log1p(torch.tensor(FAR_M, device="cpu")))

FAR_PX = 12  # between two measured pixels of a line: farther apart there was no echo in between
SPARSE = 1.5  # mean distance of measured pixels, in pixels, from which on points are put between them
REACH = 1.5  # mean distances up to which two are neighbours: elevations are uneven
# Factors of coarser rasters, which fill holes one after the other: beams up to 4 FAR_PX = 48 pixels apart meet,
# on the panorama's raster 3.7 degrees; those of 16 beams lie 2 degrees apart.
COARSER = (1, 2, 4)


def depth_code(depth_m: Tensor) -> Tensor:
    """Encode depths in metres as networks predict them and losses compare them: log(1 + m) / log(1 + FAR_M)."""
    return torch.log1p(depth_m) / LOG_FAR


def measured_depth(depth_m: Tensor, channels: Tensor, ids: Tensor, viewpoint_m: Tensor, view: View) -> Tensor:
    """Return depths (B, H, W) float32, metres along the ray, that keep to the measurement.

    depth_m      (B, H, W): those of a translator;  channels: (B, 5, H, W) of a RangeImage on the same raster.
    ids          (B, H, W): the likeliest classes, ids of COMMON15.
    viewpoint_m  (B,): height of the view's origin above the road;  view: the raster. Depths on a raster that is no
                 cylinder stay as they are.

    A pixel with a point has its distance, but for its noise. Between two points of a column lies their surface, if they
    are of one; else the upper one's, straight down, or the lower one's, straight up or along the road: the one nearer
    to the translator's depth. Below a column's lowest point its surface goes on down to the road. Above its topmost,
    its surface goes on up, as far as the pixels are of its class: trees and houses stand above their trunks and doors;
    the distance of a crown is mixed with the translator's. Elsewhere, and in columns without points, the translator's
    depth remains.
    """
    if view.kind != "cylinder":
        return depth_m.float()
    guessed_m, _ = cylinder_points(depth_m, view)
    measured_m = torch.hypot(channels[:, 1].float(), channels[:, 2].float())
    inverse = as_float(measured_m > NEAREST_M) / measured_m.clamp(min=NEAREST_M)
    slope = slopes(view, device=depth_m.device)
    road = (-slope / viewpoint_m.clamp(min=NEAREST_M)[:, None]).clamp(min=1 / FARTHEST_M)  # (B, H), inverse distances
    guess = 1 / guessed_m.clamp(min=NEAREST_M)
    surface = _between(inverse, guess, road)
    surface = select(surface > 0, surface, _above(inverse, guess, ids))
    return torch.sqrt(1 + slope * slope)[:, None] / _average_on_planes(surface)


def _between(inverse: Tensor, guess: Tensor, road: Tensor) -> Tensor:
    """Return inverse distances (B, H, W) between and below a column's points, zero above them."""
    rows = inverse.shape[1]
    row = torch.arange(rows, device=inverse.device)[:, None]
    upper_row, lower_row = adjacent_rows(inverse > 0)
    first, last = upper_row.clamp(min=0), lower_row.clamp(max=rows - 1)
    upper, lower = inverse.gather(1, first), inverse.gather(1, last)
    share = (row - upper_row) / (lower_row - upper_row).clamp(min=1)
    extended = _extended(lower, last, road)
    nearer_upper = (guess.square() > upper * extended) == (upper > extended)  # by the logarithm
    edge = select(nearer_upper, upper, extended)
    inner = select(same_surface(upper, lower), upper + (lower - upper) * share, edge)
    lowest = torch.maximum(_extended(upper, first, road), road[:, :, None])
    return select(lower_row < rows, inner, lowest).mul_(as_float(upper_row >= 0))


def _extended(inverse: Tensor, row: Tensor, road: Tensor) -> Tensor:
    """Extend surfaces measured in rows (B, H, W): level where a point lies on the road, else upright."""
    lift = inverse / road.gather(1, row.flatten(1)).view_as(inverse)
    return select((lift > 1 / ON_GROUND) & (lift < ON_GROUND), road[:, :, None] * lift, inverse)


def _above(inverse: Tensor, guess: Tensor, ids: Tensor) -> Tensor:
    """Return inverse distances (B, H, W) above a column's topmost point: its own, in pixels of its class."""
    near = inverse
    for shift in range(1, TOPMOST_PX + 1):
        sides = torch.maximum(inverse.roll(shift, 2), inverse.roll(-shift, 2))
        near = select(near > 0, near, sides)
    top = (near > 0).int().argmax(1, keepdim=True)  # the first
    topmost, topmost_ids = near.gather(1, top), ids.gather(1, top)
    has_points = topmost > 0
    crown = has_points & (topmost_ids == VEGETATION)
    windows = pad(torch.cat([topmost * crown, crown.float()], 1), (CROWN_PX, CROWN_PX), mode="circular")
    total, count = windows.unfold(2, 2 * CROWN_PX + 1, 1).sum(3).split(1, 1)
    mixed = (total / count.clamp(min=1)).pow(1 - CROWN_GUESSED) * guess.pow(CROWN_GUESSED)
    return select((ids == topmost_ids) & has_points, torch.where(topmost_ids == VEGETATION, mixed, topmost), guess)


def _average_on_planes(inverse: Tensor) -> Tensor:
    """Average opposite pixels of (B, H, W), along columns, then rows: on a plane their mean is the value in the middle.

    Pixels whose mean differs from it by more than ON_PLANE have a border between them and do not count.
    """
    total, count = inverse.clone(), torch.ones_like(inverse)
    for reach in EVEN_PX:
        inner = slice(reach, -reach)
        opposite = inverse[:, : -2 * reach], inverse[:, 2 * reach :]
        _add_mean(total[:, inner], count[:, inner], inverse[:, inner], *opposite)
    inverse = total.div_(count)
    total, count = inverse.clone(), torch.ones_like(inverse)
    for reach in EVEN_PX:
        _add_mean(total, count, inverse, inverse.roll(reach, 2), inverse.roll(-reach, 2))
    return total.div_(count)


def _add_mean(total: Tensor, count: Tensor, middle: Tensor, first: Tensor, second: Tensor) -> None:
    """Add the mean of two opposite pixels to `total`, and 1 to `count`, where it is near the value in their middle."""
    mean = torch.lerp(first, second, 0.5)
    even = as_float((mean - middle).abs_() < ON_PLANE * middle)
    total.addcmul_(mean, even)
    count.add_(even)


def complete_depth(xyz: Tensor, view: View) -> Tensor:
    """Return the distance (H, W) float32 of every pixel from the view's origin, metres; infinite in the sky.

    xyz  (N, 3) float32 points, sensor frame, metres;  view: a cylinder (ValueError otherwise).

    Points on the vehicle that carries the sensor are left out. Measured distances stay: the nearest point owns its
    pixel. Gaps of a ring take the nearest point of their row, the nearer to the eye of two, up to RING_GAP_RAD away.
    Between two points of a column lies their surface, if they are of one; else, where the lower is on the ground, the
    ground up to the upper's distance; else the surface of the point in the nearer row. A gap wider than OPEN_SKY is
    sky, as far as the ground allows. Below a column's lowest point lies the ground or, where it is nearer, the point's
    surface. Above its topmost lies the point's surface for a little, or all the way up where the sensor looks no
    higher; and then the ground and the sky. A column without points is ground and sky. Points a little above and below
    the view count, too.
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
    inverse = _closed_rings(inverse, max(1, round(RING_GAP_RAD * view.focal_px)), circular=view.circular)
    ray = directions(view)
    ray = ray / torch.hypot(ray[..., :1], ray[..., 1:2])  # as far as one metre on the ground
    completed = _completed(inverse, ray, xyz, view)
    depth = torch.where(image.valid, image.channels[0], ray.norm(dim=2) / completed)  # 1/0: infinite
    return depth[inner].contiguous()


def _closed_rings(inverse: Tensor, reach: int, *, circular: bool) -> Tensor:
    """Fill empty pixels (zero) by their row's nearest value, up to `reach` columns away."""
    closed = inverse
    for shift in range(1, reach + 1):
        left, right = inverse.roll(shift, 1), inverse.roll(-shift, 1)
        if not circular:
            left[:, :shift] = right[:, -shift:] = 0
        closed = torch.where(closed > 0, closed, torch.maximum(left, right))
    return closed


def _completed(inverse: Tensor, ray: Tensor, xyz: Tensor, view: View) -> Tensor:
    """Fill a picture (H, W) of inverse horizontal distances down its columns; the sky stays zero."""
    rows = view.rows
    row = torch.arange(rows)[:, None].expand_as(inverse)
    owned = inverse > 0
    upper_row, lower_row = adjacent_rows(owned)
    upper = inverse.gather(0, upper_row.clamp(min=0)) * (upper_row >= 0)
    lower = inverse.gather(0, lower_row.clamp(max=rows - 1)) * (lower_row < rows)
    share = ((row - upper_row) / (lower_row - upper_row).clamp(min=1)).float()
    ground = _ground(ray, xyz, view)
    lift = lower / ground.gather(0, lower_row.clamp(max=rows - 1))  # 1 where the lower point is on the plane
    on_ground = (lift > 1 / ON_GROUND) & (lift < ON_GROUND)
    nearer_row = torch.where(share <= 0.5, upper, lower)
    inner = torch.where(on_ground, torch.maximum(upper, ground * lift), nearer_row)
    step = (view.up - view.down) / rows
    open_sky = ((lower_row - upper_row) * step > OPEN_SKY) & (
        torch.minimum(row - upper_row, lower_row - row) * step > RIM
    )
    inner = torch.where(open_sky & (ground == 0), 0.0, inner)
    inner = torch.where(same_surface(upper, lower), upper + (lower - upper) * share, inner)
    highest = torch.where(row >= _rims(inverse, lower_row, ray, xyz, view), lower, ground)
    lowest = torch.maximum(ground, upper)
    completed = torch.where(upper_row < 0, highest, inner).where(lower_row < rows, lowest)
    return torch.where(owned, inverse, completed)


def _rims(inverse: Tensor, lower_row: Tensor, ray: Tensor, xyz: Tensor, view: View) -> Tensor:
    """Return the row (W,) up to which the surface of a column's topmost point goes on: 0 where the scan cut it off."""
    top, column = lower_row[0].clamp(max=view.rows - 1), torch.arange(view.columns)
    rim = top - RIM * view.rows / (view.up - view.down)
    distance = torch.hypot(xyz[:, 0], xyz[:, 1])
    slope = xyz[:, 2] / distance
    elevations = slope[(distance > CLEAR_OF_VEHICLE_M) & slope.isfinite()]
    if not len(elevations):
        return rim
    point = ray[top, column] / inverse[top, column, None] + ray.new_tensor(view.origin)
    cut_off = point[:, 2] / torch.hypot(point[:, 0], point[:, 1]) > elevations.max() - RIM
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
    return torch.where(inverse > 1 / GROUND_REACH_M, inverse, 0.0)


class Between(NamedTuple):
    """Points (M, 3) float32 in the sensor frame, metres; remission (M,); the scan's nearest point, (M,) int64."""

    xyz: Tensor
    remission: Tensor
    source: Tensor


class _Raster(NamedTuple):
    """Inverse horizontal distances, remission and owning points, (H, W) each; 0, 0 and -1 where there are none."""

    inverse: Tensor
    remission: Tensor
    index: Tensor


def denser(scan: Scan, image: RangeImage) -> tuple[Scan, RangeImage, Tensor]:
    """Add the points of `between_beams` to a scan, after its own N points, and to its range image.

    Such a scan has no labels, beams and times. Also returns, for each point (N + M,) int64, the scan's point whose
    label it may take.
    """
    added, own = between_beams(image), torch.arange(len(scan), device=image.index.device)
    if added is None:
        return scan, image, own
    xyz = np.concatenate([scan.xyz, added.xyz.cpu().numpy()])
    remission = np.concatenate([scan.remission, added.remission.cpu().numpy()])
    scan = Scan(xyz=xyz, remission=remission, name=scan.name, gaps_deg=scan.gaps_deg)
    return scan, project(scan, image.view, device=own.device), torch.cat([own, added.source])


def between_beams(image: RangeImage) -> Between | None:
    """Interpolate between neighbours of a scan: first in the rows of its raster, then in the columns.

    Neighbours are up to REACH times as far apart as measured pixels are on average; where that is less than
    SPARSE, as for the sensor that the raster was made for, there is nothing to add: None. Between two of one surface
    lies that surface, with a remission that goes over from the one to the other; otherwise half belongs to either.
    """
    range_m, x, y, _, remission = image.channels
    flat = torch.hypot(x, y)
    measured = image.valid & (flat > 0) & (range_m > 0)
    spare = min(FAR_PX, image.view.columns) if image.view.circular else 0
    if max(_mean_gap(measured), _mean_gap(_turned(measured, spare))) < SPARSE:
        return None
    raster = _Raster(torch.where(measured, 1 / flat, 0.0), remission, torch.where(measured, image.index, -1))
    wide = _Raster(*(_turned(part, spare) for part in raster))
    raster = _Raster(*(part.T[:, spare : spare + image.view.columns] for part in _interpolated(wide)))
    raster = _interpolated(raster)
    new = (raster.inverse > 0) & ~measured
    ray = directions(image.view, device=flat.device)[new]
    distance_m = 1 / (torch.hypot(ray[:, 0], ray[:, 1]) * raster.inverse[new])
    xyz = ray * distance_m[:, None] + ray.new_tensor(image.view.origin)
    return Between(xyz, raster.remission[new], raster.index[new]) if len(xyz) else None


def _turned(x: Tensor, spare: int) -> Tensor:
    """Transpose (H, W) to (W + 2 spare, H), going on beyond the seam."""
    return torch.cat([x[:, x.shape[1] - spare :], x, x[:, :spare]], 1).T


def _interpolated(raster: _Raster) -> _Raster:
    """Interpolate between neighbours above each other."""
    owned = raster.index >= 0
    if (mean := _mean_gap(owned)) < SPARSE:
        return raster
    rows = len(owned)
    upper_row, lower_row = adjacent_rows(owned)
    row = torch.arange(rows, device=owned.device)[:, None]
    new = ~owned & (upper_row >= 0) & (lower_row < rows) & (lower_row - upper_row <= round(REACH * mean))
    upper_row, lower_row = upper_row.clamp(min=0), lower_row.clamp(max=rows - 1)
    share = (row - upper_row) / (lower_row - upper_row).clamp(min=1)
    upper, lower = raster.inverse.gather(0, upper_row), raster.inverse.gather(0, lower_row)
    share = torch.where(same_surface(upper, lower), share, (share > 0.5).float())
    inverse = torch.lerp(upper, lower, share)
    remission = torch.lerp(raster.remission.gather(0, upper_row), raster.remission.gather(0, lower_row), share)
    index = torch.where(share <= 0.5, raster.index.gather(0, upper_row), raster.index.gather(0, lower_row))
    return _Raster(*(torch.where(new, *parts) for parts in zip((inverse, remission, index), raster, strict=True)))


def _mean_gap(mask: Tensor) -> float:
    """Return the mean distance of neighbours above each other in (H, W) bool, those beyond FAR_PX left out; else 1."""
    column, row = mask.T.nonzero().unbind(1)
    gap = row[1:] - row[:-1]
    kept = (column[1:] == column[:-1]) & (gap <= FAR_PX)
    total, count = torch.stack([(gap * kept).sum(), kept.sum()]).tolist()
    return total / count if count else 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EchoImage:
    """Echoes of a scan on a raster (h, w); zero where there are none.

    range_m        float32 metres from the view's origin.
    remission      float32 in [0, 1].
    near_infrared  float32 as stored; None if the scan has none.
    """

    range_m: Tensor
    remission: Tensor
    near_infrared: Tensor | None


def echo_image(scan: Scan, view: View) -> EchoImage:
    """Return the echoes of a scan on a raster: those in a pixel, else of the surface between its neighbours' beams.

    Points nearer to the sensor than OWN_VEHICLE_M do not count. Near-infrared light between beams is the nearer one's.
    """
    scan = scan.beyond()
    image = torch.zeros(3, view.rows, view.columns)
    light = None if scan.near_infrared is None else torch.from_numpy(scan.near_infrared)
    row, column = torch.arange(view.rows)[:, None], torch.arange(view.columns)
    for factor in COARSER:
        coarse = view.scaled(1 / factor)
        _, dense, source = denser(scan, project(scan, coarse))
        layers = torch.cat([dense.channels[[0, 4]], torch.zeros(1, coarse.rows, coarse.columns)])
        if light is not None:
            layers[2, dense.valid] = light[source[dense.index[dense.valid]]]
        enlarged = layers[:, row * coarse.rows // view.rows, column * coarse.columns // view.columns]
        image = torch.where(image[0] > 0, image, enlarged)
    range_m, remission, near_infrared = image
    return EchoImage(
        range_m=range_m, remission=remission, near_infrared=None if light is None else near_infrared.contiguous()
    )
