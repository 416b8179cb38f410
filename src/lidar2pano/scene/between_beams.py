"""Points between the beams of a sensor that has fewer of them than a raster has rows, or fewer columns than it has.

Networks that were trained on rasters that an HDL-64E fills see 16 beams as lines in the void. On a plane the inverse of
the horizontal distance is linear in the tangent of the elevation, and nearly so in azimuth over a degree or two: it is
interpolated.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidar2pano.geometry.projection import RangeImage, directions, project
from lidar2pano.geometry.rasters import adjacent_rows
from lidar2pano.scan import Scan
from lidar2pano.scene.surfaces import same_surface

FAR_PX = 12  # between two measured pixels of a line: farther apart there was no echo in between
SPARSE = 1.5  # mean distance of measured pixels, in pixels, from which on points are put between them
REACH = 1.5  # mean distances up to which two are neighbours: elevations are uneven


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
