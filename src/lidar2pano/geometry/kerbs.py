"""Sidewalks lie a kerb above the road: what heights say about which of the two a pixel shows."""

from __future__ import annotations

import torch
from torch import Tensor

from lidar2pano.geometry.masks import as_float
from lidar2pano.geometry.odds import multiply_odds
from lidar2pano.geometry.surface import azimuths, cylinder_points
from lidar2pano.views import View

NEAREST_M, FARTHEST_M = 3.0, 25.0  # where the road's plane is fitted; up to there it is believed
EVERY = 4  # columns for each that it is fitted to
LEAST_PIXELS = 50  # there; fewer say nothing
ROUNDS, OFF_PLANE_M = 4, 0.12  # fits, and the distance from the last one's plane beyond which a pixel does not count
KERB_M, PER_M = 0.04, 40.0  # height that speaks for neither; what a metre more adds to the logarithm of the odds
LEAST_ODDS, MOST_ODDS = -1.0, 2.0  # in the logarithm: roads are not flat, and sidewalks may lie as low


def weigh_by_height(logits: Tensor, ids: Tensor, depth_m: Tensor, view: View, road: int, sidewalk: int) -> None:
    """Change logits (B, C, H, W) of road and sidewalk by how high a pixel lies above the road's plane; their sum stays.

    ids  (B, H, W): the best classes;  depth_m: (B, H, W), as of `measured_depth`. A scene that shows no road stays.
    """
    radius_m, z_m = cylinder_points(depth_m, view)
    azimuth = azimuths(view, device=depth_m.device).float()
    for number, (radius, z, best) in enumerate(zip(radius_m, z_m, ids, strict=True)):
        x, y = radius * azimuth.cos(), radius * azimuth.sin()
        near = (best == road) & (radius > NEAREST_M) & (radius < FARTHEST_M)
        sample = near[:, ::EVERY]
        plane = road_plane(*(part[:, ::EVERY][sample] for part in (x, y, z)))
        if plane is None:
            continue
        height_m = z - (plane[0] * x + plane[1] * y + plane[2])
        odds = ((height_m - KERB_M) * PER_M).clamp_(LEAST_ODDS, MOST_ODDS).mul_(as_float(radius < FARTHEST_M))
        multiply_odds(logits[number, None], sidewalk, [road], odds[None])


def road_plane(x: Tensor, y: Tensor, z: Tensor) -> Tensor | None:
    """The plane z = a x + b y + c, (3,), through most of the points (N,); None where there are too few.

    Least squares, again and again without what lies more than OFF_PLANE_M off the plane before.
    """
    if len(x) < LEAST_PIXELS:
        return None
    system, kept = torch.stack([x, y, torch.ones_like(x)], 1).double(), torch.ones_like(x, dtype=torch.float64)
    plane = system.new_zeros(3)
    for _ in range(ROUNDS):
        weighted = system * kept[:, None]
        square = weighted.T @ system + 1e-6 * torch.eye(3, dtype=torch.float64, device=x.device)
        plane = torch.linalg.solve(square, weighted.T @ z.double())
        kept = ((system @ plane - z).abs() < OFF_PLANE_M).double()
    return plane.float()
