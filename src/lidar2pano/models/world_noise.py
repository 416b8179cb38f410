"""Noise that hangs on the world: the texture of a place is the same in every scan of a drive."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lidar2pano.labels import COMMON15
from lidar2pano.scene.record import Scene
from lidar2pano.scene.surfaces import world_columns
from lidar2pano.views import PANORAMA

SKY = COMMON15.id_of("sky")
SKY_OCTAVE = 1 << 10  # the sky's noise hangs on directions: it has an octave of its own
FACTORS = (0x1F0A2BE71D163FA1, 0x3C6EF372FE94F82B, 0x510E527FADE682D1, 0x1B873593CC9E2D51)  # odd, of the hashed numbers
MIXED = ((30, -0x40A7B892E31B1A47), (27, -0x6B2FB644ECCEEE15))  # splitmix64's shifts and factors (Steele et al. 2014)
UNIFORM_BITS = 24


def world_noise(scene: Scene, channels: int, fold: int, seed: int = 0) -> Tensor:
    """Return normal noise (1, channels, H / fold, W / fold) float32, fixed to the surfaces of the world.

    It is a function of the world's cell around the middle of a pixel of the latents: a cube whose edge is
    a power of two metres, half to once a pixel's width at that distance; in the sky of the direction. A drive thus
    keeps its textures.
    scene  a single one;  fold: pixels of its raster per pixel of the latents, in rows and in columns.
    seed   another one gives another picture.
    """
    view, device = scene.view, scene.depth_m.device
    middle = (slice(None), slice(fold // 2, None, fold), slice(fold // 2, None, fold))
    radius_m, z_m = (part[middle][0].double() for part in scene.cylinder)
    direction, place = world_columns(view, scene.T_world_sensor, device)
    pose_z = 0.0 if scene.T_world_sensor is None else float(scene.T_world_sensor[2, 3])
    direction = direction[:, fold // 2 :: fold]
    x, y = (place[axis] + radius_m * direction[axis] for axis in (0, 1))
    octave = (radius_m.clamp(min=1e-3) * fold / view.focal_px).log2().floor()
    cells = [(part / octave.exp2()).floor() for part in (x, y, z_m + view.origin[2] + pose_z)]
    azimuth = torch.atan2(direction[1], direction[0]) * view.focal_px / fold
    first = round((PANORAMA.up - view.up) * view.rows / (view.up - view.down) / fold)  # row: numbers are elevations
    rows = torch.arange(first, first + len(radius_m), device=device, dtype=torch.float64)[:, None].expand_as(radius_m)
    sky = scene.ids[middle][0] == SKY
    celestial = (azimuth.round().expand_as(rows), rows, torch.zeros_like(rows), torch.full_like(rows, SKY_OCTAVE))
    numbers = [
        torch.where(sky, of_sky, of_surface).long()
        for of_sky, of_surface in zip(celestial, (*cells, octave), strict=True)
    ]
    key = sum((number * factor for number, factor in zip(numbers, FACTORS, strict=True)), start=numbers[0] * 0 + seed)
    return _normal(_hashed(key), channels)[None]


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
