"""Noise that hangs on the world: a place keeps the noise that it was first painted from, while it is in view.

Each pixel of the latents has a particle that carries its noise on (cf. Chang et al. 2024, How I warped your noise). A
particle belongs to one pixel alone, so that noise stays white. (Noise that was a function of the world's cells did not
stay: predicted depths waver by more than a cell.)
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidar2pano.geometry.flow import moved_ends, relative_pose
from lidar2pano.geometry.projection import directions, nearest_points, pixels
from lidar2pano.scene.record import Scene
from lidar2pano.scene.surfaces import azimuths, same_surface
from lidar2pano.views import PANORAMA, View

FACTORS = (0x1F0A2BE71D163FA1, 0x3C6EF372FE94F82B, 0x510E527FADE682D1)  # odd, of the hashed numbers
MIXED = ((30, -0x40A7B892E31B1A47), (27, -0x6B2FB644ECCEEE15))  # splitmix64's shifts and factors (Steele et al. 2014)
UNIFORM_BITS = 24


class Particles(NamedTuple):
    """Noise, and where it hangs: one particle in each pixel of the latents' raster h x w.

    noise           (channels, h, w) float32.
    rays            (h, w, 3) float64: unit vectors from the view's origin to the particles, sensor axes.
    distance_m      (h, w) float32 metres from there; infinite in the sky.
    T_world_sensor  (4, 4) float64, metres.
    scan            number of the scan in its stream.
    """

    noise: Tensor
    rays: Tensor
    distance_m: Tensor
    T_world_sensor: np.ndarray
    scan: int


def world_noise(
    past: Particles | None, scene: Scene, channels: int, fold: int, seed: int = 0
) -> tuple[Particles | None, Tensor]:
    """Return the particles, None without a pose, and normal noise (1, channels, H / fold, W / fold) float32.

    past   particles of the previous scan. Those that the scene shows, at about their distance, come along; in a pixel
           that several reach, the one nearest to its middle stays. The others, and all without a pose, are new.
    scene  a single one;  fold: pixels of its raster per pixel of the latents, in rows and in columns.
    seed   another one gives another picture.
    """
    raster = scene.view.scaled(1 / fold)
    scan = 0 if past is None else past.scan + 1
    noise = _direction_noise(raster, channels, scan, seed, scene.depth_m.device)
    if scene.T_world_sensor is None:
        return None, noise[None]
    rays = directions(raster, device=noise.device).double()
    distance_m = scene.depth_with_sky_m[0, fold // 2 :: fold, fold // 2 :: fold]
    new = Particles(noise, rays, distance_m, scene.T_world_sensor, scan)
    particles = new if past is None or past.noise.shape != noise.shape else _carried(past, new, raster)
    return particles, particles.noise[None]


def _carried(past: Particles, new: Particles, raster: View) -> Particles:
    """Return new particles, replaced by those of the previous scan that have come to their places."""
    T_new_past = relative_pose(new.T_world_sensor, past.T_world_sensor)
    ends = moved_ends(past.rays, past.distance_m, T_new_past, past.rays.new_tensor(raster.origin))
    x, y, z = ends.unbind(-1)
    row, column = pixels(x, y, z, raster)
    pixel_row, pixel_column = row.floor(), column.floor()
    inside = (pixel_row >= 0) & (pixel_row < raster.rows)
    if not raster.circular:
        inside &= (pixel_column >= 0) & (pixel_column < raster.columns)
    cells = raster.rows * raster.columns
    cell = torch.where(inside, pixel_row * raster.columns + pixel_column.remainder(raster.columns), 0).long()
    inverse = torch.where(past.distance_m.isfinite(), 1 / ends.norm(dim=-1), 0.0)
    inverse_now = 1 / new.distance_m.flatten()[cell]
    inside &= same_surface(inverse_now, inverse) | (inverse_now == inverse)  # both are 0 in the sky
    offset = torch.hypot(row - pixel_row - 0.5, column - pixel_column - 0.5).float()
    index = nearest_points(torch.where(inside, cell, cells).flatten(), offset.flatten(), cells).view(row.shape)
    came, source = index >= 0, index.clamp(min=0)
    rays = (ends / ends.norm(dim=-1, keepdim=True)).flatten(0, 1)[source]
    return new._replace(
        noise=torch.where(came, past.noise.flatten(1)[:, source], new.noise),
        rays=torch.where(came[..., None], rays, new.rays),
    )


def _direction_noise(raster: View, channels: int, scan: int, seed: int, device: torch.device) -> Tensor:
    """Return noise (channels, h, w) of a raster's directions: the same on rasters of other rows or columns."""
    first_row = round((PANORAMA.up - raster.up) * raster.rows / (raster.up - raster.down))
    row = torch.arange(first_row, first_row + raster.rows, device=device)[:, None]
    column = (azimuths(raster, device=device) * raster.focal_px).floor().long()
    key = row * FACTORS[0] + column * FACTORS[1] + row.new_tensor(scan) * FACTORS[2] + seed
    return _normal(_hashed(key), channels)


def _hashed(key: Tensor) -> Tensor:
    """Mix the bits of int64 numbers of any shape."""
    for shift, factor in MIXED:
        key = (key ^ _shifted(key, shift)) * factor
    return key ^ _shifted(key, 31)


def _shifted(key: Tensor, bits: int) -> Tensor:
    """Shift int64 numbers to the right as if they were unsigned."""
    return (key >> bits) & ((1 << (64 - bits)) - 1)


def _normal(key: Tensor, channels: int) -> Tensor:
    """Draw normal numbers (channels, h, w) float32 by hashed int64 keys (h, w), after Box and Muller (1958)."""
    pairs = -(-channels // 2)
    number = torch.arange(1, pairs + 1, device=key.device)[:, None, None] * FACTORS[1]
    hashed = _hashed(key + number)
    first, second = (_shifted(part, 64 - UNIFORM_BITS).double() for part in (hashed, hashed << UNIFORM_BITS))
    scale = 2.0**-UNIFORM_BITS
    radius = torch.sqrt(-2 * torch.log((first + 0.5) * scale))
    angle = 2 * math.pi * scale * second
    return torch.cat([radius * angle.cos(), radius * angle.sin()])[:channels].float()
