"""The published spherical projection, written from its description, and the synthetic scan it was recorded on.

It clamps what is out of view into the border pixels and loses the pixel of point 0; ours does neither.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from golden_fill import unit
from lidar2pano.scan import Scan

ROWS, COLUMNS = 64, 2048
MEAN = np.array([12.12, 10.88, 0.23, -1.04, 0.21], np.float32)
STD = np.array([12.32, 11.47, 6.91, 0.86, 0.16], np.float32)


def synthetic_scan(points: int = 120_000) -> Scan:
    """The scan of the recorded projections: uniform in azimuth, elevation -26 to 4 degrees, range 1.5 to 80 m."""
    azimuth = np.pi * (2 * unit("scan.yaw", points) - 1)
    elevation = np.radians(30 * unit("scan.pitch", points) - 26)
    range_m = 1.5 + 78.5 * unit("scan.range", points) ** 2
    flat = range_m * np.cos(elevation)
    xyz = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), range_m * np.sin(elevation)], 1)
    return Scan(xyz=xyz.astype(np.float32), remission=unit("scan.remission", points).astype(np.float32))


class Projected(NamedTuple):
    """Names, shapes and types as recorded; N points, H x W pixels.

    proj_x, proj_y  (N,) column and row of each point.
    proj_idx        (H, W) int32 index of the nearest point, -1 where there is none.
    proj_mask       (H, W) uint8, 1 where proj_idx > 0.
    proj_range, proj_xyz, proj_remission  (H, W), (H, W, 3), (H, W) float32 of that point, -1 where there is none.
    net_input       (5, H, W) float32: range, x, y, z, remission, normalised; 0 where proj_mask is 0.
    """

    proj_x: np.ndarray
    proj_y: np.ndarray
    proj_idx: np.ndarray
    proj_mask: np.ndarray
    proj_range: np.ndarray
    proj_xyz: np.ndarray
    proj_remission: np.ndarray
    net_input: np.ndarray


def published_projection(scan: Scan, up: float, down: float, half_width: float) -> Projected:
    """Project; `up`, `down` and `half_width` bound the view, degrees."""
    range_m = np.linalg.norm(scan.xyz, 2, axis=1)
    yaw, pitch = -np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0]), np.arcsin(scan.xyz[:, 2] / range_m)
    across = 0.5 * (yaw / np.radians(half_width).item() + 1.0) * COLUMNS
    downwards = (1.0 - (pitch + np.radians(-down).item()) / np.radians(up - down).item()) * ROWS
    column = np.clip(np.floor(across), 0, COLUMNS - 1).astype(np.int16)
    row = np.clip(np.floor(downwards), 0, ROWS - 1).astype(np.int8)
    far_first = np.argsort(-range_m, kind="stable")  # the last to be written stays
    index = np.full((ROWS, COLUMNS), -1, np.int32)
    index[row[far_first], column[far_first]] = far_first
    mask = index > 0
    values = np.column_stack([range_m, scan.xyz, scan.remission])
    values = np.where(index[..., None] >= 0, values[index], np.float32(-1))
    normalised = (values - MEAN) / STD * mask[..., None]
    return Projected(column, row, index, mask.astype(np.uint8), values[..., 0], values[..., 1:4], values[..., 4],
                     np.moveaxis(normalised, 2, 0))  # fmt: skip
