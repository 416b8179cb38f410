"""Points between the beams of a sensor that has fewer of them than a raster has rows, or fewer columns than it has.

Networks that were trained on rasters that an HDL-64E fills see 16 beams as lines in the void. On a plane the inverse of
the horizontal distance is linear in the tangent of the elevation, and nearly so in azimuth over a degree or two: it is
what is interpolated.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidar2pano.geometry.columns import rows_beside
from lidar2pano.geometry.projection import RangeImage, directions, project
from lidar2pano.scan import Scan

FAR_PX = 12  # between two measured pixels of a line: farther apart there was no echo in between
SPARSE = 1.5  # mean distance of measured pixels, in pixels, from which on something is put between them
REACH = 1.5  # mean distances up to which two are neighbours: elevations are uneven
ONE_SURFACE = 1.4  # ratio of distances below which two neighbours are taken to be of one surface


class Between(NamedTuple):
    """Points (M, 3) float32 in the sensor frame, metres; remission (M,); the scan's point next to each, (M,) int64."""

    xyz: Tensor
    remission: Tensor
    beside: Tensor


class _Raster(NamedTuple):
    """Inverse horizontal distances, remission and owning points, (H, W) each; 0, 0 and -1 where nothing is known."""

    inverse: Tensor
    remission: Tensor
    index: Tensor


def denser(scan: Scan, image: RangeImage) -> tuple[Scan, RangeImage, Tensor]:
    """A scan and its range image with what `between_beams` finds, after the scan's own N points.

    Such a scan has no labels, beams and times. Also returns, for each point (N + M,) int64, the scan's point whose
    label it may take.
    """
    between, own = between_beams(image), torch.arange(len(scan), device=image.index.device)
    if not len(between.xyz):
        return scan, image, own
    xyz = np.concatenate([scan.xyz, between.xyz.cpu().numpy()])
    remission = np.concatenate([scan.remission, between.remission.cpu().numpy()])
    scan = Scan(xyz=xyz, remission=remission, name=scan.name, gaps_deg=scan.gaps_deg)
    return scan, project(scan, image.view, device=own.device), torch.cat([own, between.beside])


def between_beams(image: RangeImage) -> Between:
    """What lies between neighbours of a scan: first in the rows of its raster, then in the columns.

    Neighbours are up to REACH times as far apart as measured pixels are on average; where that is less than SPARSE, as
    for the sensor that the raster was made for, there is nothing between them. Between two of one surface lies that
    surface, with a remission that goes over from the one to the other; otherwise half belongs to either.
    """
    range_m, x, y, _, remission = image.channels
    flat = torch.hypot(x, y)
    there = image.valid & (flat > 0) & (range_m > 0)
    raster = _Raster(torch.where(there, 1 / flat, 0.0), remission, torch.where(there, image.index, -1))
    spare = FAR_PX if image.view.circular else 0
    wide = _Raster(*(_turned(part, spare) for part in raster))
    raster = _Raster(*(part.T[:, spare : spare + image.view.columns] for part in _interpolated(wide)))
    raster = _interpolated(raster)
    new = (raster.inverse > 0) & ~there
    ray = directions(image.view, device=flat.device)[new]
    away = 1 / (torch.hypot(ray[:, 0], ray[:, 1]) * raster.inverse[new])
    xyz = ray * away[:, None] + ray.new_tensor(image.view.origin)
    return Between(xyz, raster.remission[new], raster.index[new])


def _turned(x: Tensor, spare: int) -> Tensor:
    """(H, W) -> (W + 2 spare, H), going on beyond the seam."""
    return torch.cat([x[:, x.shape[1] - spare :], x, x[:, :spare]], 1).T


def _interpolated(raster: _Raster) -> _Raster:
    """The raster, with what lies between neighbours above each other."""
    there = raster.index >= 0
    if (mean := _mean_gap(there)) < SPARSE:
        return raster
    rows = len(there)
    above, below = rows_beside(there)
    row = torch.arange(rows, device=there.device)[:, None]
    new = ~there & (above >= 0) & (below < rows) & (below - above <= round(REACH * mean))
    above, below = above.clamp(min=0), below.clamp(max=rows - 1)
    share = (row - above) / (below - above).clamp(min=1)
    upper, lower = raster.inverse.gather(0, above), raster.inverse.gather(0, below)
    one_surface = torch.maximum(upper, lower) < ONE_SURFACE * torch.minimum(upper, lower)
    share = torch.where(one_surface, share, (share > 0.5).float())
    inverse = torch.lerp(upper, lower, share)
    remission = torch.lerp(raster.remission.gather(0, above), raster.remission.gather(0, below), share)
    index = torch.where(share <= 0.5, raster.index.gather(0, above), raster.index.gather(0, below))
    return _Raster(*(torch.where(new, *parts) for parts in zip((inverse, remission, index), raster, strict=True)))


def _mean_gap(there: Tensor) -> float:
    """How many rows neighbours above each other are apart on average in (H, W) bool, those beyond FAR_PX left out."""
    alone = there.clone()  # what has met no neighbour above it yet
    counts = []
    for away in range(1, FAR_PX + 1):
        met = alone[away:] & there[:-away]
        alone[away:] ^= met
        counts.append(met.sum())
    numbers = torch.stack(counts).tolist()
    return sum(away * number for away, number in enumerate(numbers, 1)) / sum(numbers) if any(numbers) else 1.0
