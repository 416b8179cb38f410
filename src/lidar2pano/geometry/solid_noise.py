"""Noise that hangs in space: a random field, read at the point that each pixel of a panorama shows.

After Perlin 1985 (solid texture): leaves and gravel get the scene's perspective, look the same from every side and
stay where they are when the sensor moves. One periodic tile of voxels serves all wavelengths: it is smooth over a few
voxels, so that the nearest voxel will do. A wavelength that a pixel could not show is faded out (band limiting, as in
Norton et al. 1982).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from lidar2pano.geometry.masks import as_float
from lidar2pano.geometry.surface import azimuths, slopes
from lidar2pano.views import View

BITS = 6  # the tile has 2^BITS voxels along each axis
VOXELS = 4  # per wavelength
FARTHEST_M = 200.0  # nothing stands farther away
SKY_M = 4.0  # the sky is a sphere of this radius that goes with the viewer
COARSER = 4  # pixels of the raster for each at which long wavelengths are read
STRIP = 16  # rows that are looked up at a time on a CPU, so that they stay in its cache
AWAY_M = 4096.0  # added to coordinates, a multiple of every period: whole numbers are cut off, not rounded down


@lru_cache(maxsize=4)
def noise_tile(device: torch.device, dtype: torch.dtype) -> Tensor:
    """The tile (2^(3 BITS),): periodic normal noise without what is finer than a wavelength, variance 1, fixed seed."""
    side = 2**BITS
    white = torch.randn(side, side, side, generator=torch.Generator().manual_seed(7))
    axis = torch.fft.fftfreq(side)
    squared = axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis[: side // 2 + 1].abs() ** 2
    kept = torch.exp(-squared / (2 * (0.5 / VOXELS) ** 2))
    tile = torch.fft.irfftn(torch.fft.rfftn(white) * kept, s=white.shape)
    tile = (tile - tile.mean()) / tile.std()
    return tile.flatten().to(device=device, dtype=dtype)


def solid_noise(
    depth_m: Tensor, sky: Tensor, view: View, wavelengths_m: Sequence[float], T_world_sensor: np.ndarray | None = None
) -> Tensor:
    """Noise (K, H, W) of K wavelengths at the points of a panorama, about normal, in the depths' dtype.

    depth_m        (H, W) metres from the view's origin;  sky: (H, W) bool, read by direction alone.
    wavelengths_m  each a power of two, at most 64 m.
    T_world_sensor  (4, 4): where the noise hangs; None: on the sensor frame.
    A wavelength is at full strength where it is twice as long as a pixel is wide, and gone where it is as long.
    """
    finest = min(wavelengths_m) / VOXELS
    shifts = [round(float(np.log2(wave / VOXELS / finest))) for wave in wavelengths_m]
    column, row, start, sky_start = _axes(view, T_world_sensor, finest, depth_m.device)
    tile = noise_tile(depth_m.device, depth_m.dtype)
    slope = slopes(view, device=depth_m.device)
    per_depth = torch.rsqrt(1 + slope * slope)[:, None]
    sky_m, no_m, minus_one = slope.new_tensor([SKY_M, 1e-3, -1.0]).unbind()
    out = depth_m.new_empty(len(wavelengths_m), *depth_m.shape)
    has_sky = sky.any(1).tolist() if sky.device.type == "cpu" else [True] * view.rows  # a GPU is not waited for
    strip = STRIP if depth_m.device.type == "cpu" else view.rows
    for top in range(0, view.rows, strip):
        rows = slice(top, top + strip)
        distance = radius = depth_m[rows].float().clamp(0.1, FARTHEST_M)
        if any(has_sky[rows]):
            is_sky = as_float(sky[rows])
            radius, distance = torch.lerp(distance, sky_m, is_sky), torch.lerp(distance, no_m, is_sky)
        radius = radius * per_depth[rows]
        x, y, z = (
            (column[axis] + row[axis, rows, None]).mul_(radius).add_(start[axis]).to(torch.int32) for axis in range(3)
        )
        if any(sky_start) and any(has_sky[rows]):  # of the sky the sensor's place does not matter: take it back
            is_sky = sky[rows].int()
            for part, move in zip((x, y, z), sky_start, strict=True):
                part.sub_(is_sky, alpha=move)
        x, y = x.bitwise_left_shift_(2 * BITS), y.bitwise_left_shift_(BITS)
        inverse = distance.reciprocal_().mul_(view.focal_px)
        for number, (wave, shift) in enumerate(zip(wavelengths_m, shifts, strict=True)):
            mask = 2**BITS - 1 << shift
            place = z.bitwise_and(mask)
            place.bitwise_or_(y.bitwise_and(mask << BITS)).bitwise_or_(x.bitwise_and(mask << 2 * BITS))
            noise = tile.index_select(0, place.bitwise_right_shift_(shift).flatten()).view(place.shape)
            share = torch.add(minus_one, inverse, alpha=wave).clamp_(0, 1)
            torch.mul(noise, share, out=out[number, rows])
    return out


def smooth_noise(
    radius_m: Tensor, z_m: Tensor, view: View, wavelength_m: float, T_world_sensor: np.ndarray | None = None
) -> Tensor:
    """Noise (B, H, W) float32 of one long wavelength, about normal: the tile between its voxels, trilinear.

    radius_m, z_m  (B, H, W): as `surface.cylinder_points` gives them. Read at every COARSER-th row and column of the
                   raster, which must divide by it, and carried to the pixels around.
    T_world_sensor  (4, 4): where the noise hangs; None: on the sensor frame.
    """
    pose = torch.from_numpy(np.eye(4) if T_world_sensor is None else np.asarray(T_world_sensor, dtype=np.float64))
    middle = slice(COARSER // 2, None, COARSER)
    radius, z = (part[:, middle, middle].double() for part in (radius_m, z_m))
    angle = azimuths(view, device=radius.device)[middle]
    origin = radius.new_tensor(view.origin)
    sensor = torch.stack([radius * angle.cos(), radius * angle.sin(), z], -1) + origin
    place = (sensor @ pose[:3, :3].T.to(radius) + pose[:3, 3].to(radius)) * (VOXELS / wavelength_m)
    low = place.floor()
    share, low = (place - low).float(), low.long()
    tile, mask = noise_tile(radius.device, torch.float32), 2**BITS - 1
    ends = low & mask, (low + 1) & mask
    noise = torch.zeros_like(share[..., 0])
    for corner in itertools.product((0, 1), repeat=3):
        x, y, level = (ends[step][..., axis] for axis, step in enumerate(corner))
        weight = [share[..., axis] if step else 1 - share[..., axis] for axis, step in enumerate(corner)]
        noise += tile[x << 2 * BITS | y << BITS | level] * weight[0] * weight[1] * weight[2]
    return noise.repeat_interleave(COARSER, 1).repeat_interleave(COARSER, 2)


def _axes(
    view: View, T_world_sensor: np.ndarray | None, voxel_m: float, device: torch.device
) -> tuple[Tensor, Tensor, list[float], list[int]]:
    """What a point is made of, in voxels: radius x (column (3, W) + row (3, H)) + start; and start without AWAY_M."""
    pose = np.eye(4) if T_world_sensor is None else np.asarray(T_world_sensor, dtype=np.float64)
    rotation = torch.from_numpy(pose[:3, :3].copy())
    angle = azimuths(view)
    flat = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)])
    column = (rotation @ flat / voxel_m).float().to(device)
    row = (rotation[:, 2:] * slopes(view).double() / voxel_m).float().to(device)
    place = (pose[:3, :3] @ np.array(view.origin) + pose[:3, 3]) % AWAY_M
    moved = [round(value) for value in (place / voxel_m).tolist()]
    return column, row, [AWAY_M / voxel_m + value for value in moved], moved
