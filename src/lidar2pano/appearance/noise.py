"""Noise that hangs in space: a random field, read at the point of each pixel, and the outlines that it gives to crowns.

After Perlin 1985 (solid texture): leaves and gravel get the scene's perspective, look the same from every side and
stay where they are when the sensor moves. One periodic tile of voxels serves all wavelengths: it is smooth over a few
voxels, so that the nearest voxel will do. A wavelength that a pixel could not show is faded out (band limiting, as in
Norton et al. 1982). Against the sky a translator's probabilities change slowly; painted as they are, they become a grey
halo between a tree and the sky.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from lidar2pano.geometry.rasters import as_float
from lidar2pano.scene.surfaces import azimuths, slopes
from lidar2pano.views import View

BITS = 6  # the tile has 2^BITS voxels along each axis
VOXELS = 4  # per wavelength
FARTHEST_M = 200.0  # nothing stands farther away
SKY_M = 4.0  # the sky is a sphere of this radius that goes with the viewer
COARSER = 4  # pixels of the raster for each at which long wavelengths are read
STRIP = 16  # rows that are looked up at a time on a CPU, so that they stay in its cache
AWAY_M = 4096.0  # added to coordinates, a multiple of every period: whole numbers are cut off, not rounded down
EDGE_PX = 0.4  # scale of the logistic function across an outline
REACH = 3  # pixels to each side over which the slope of the sky's probability is taken
LEAST_SLOPE = 0.002  # of it, per pixel
CROWN_DEG, CROWN_ROWS = 0.5, 2.0  # deviations of the Gaussian over which the outlines of crowns are evened
LEAFLESS, THINNING = 0.3, 0.15  # distance of the sky's probability from 0.5 where leaves end, and over which they do
BOUGH_DEG, BOUGH_ROWS = 2.0, 8.0  # and how far away their leaves are: at a step in depth noise would be drawn out
LEAVES_M = {0.5: 0.12, 2.0: 0.3}  # wavelengths, and how far leaves and boughs move the outline of a crown
CROWN = 17  # pixels around in which the nearest thing is what stands before the sky
LEAST = 1e-6  # probability


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


def against_the_sky(  # noqa: PLR0913, PLR0917 which class is what is the caller's to know
    segments: Tensor,
    probabilities: Tensor,
    depth_m: Tensor,
    view: View,
    T_world_sensor: np.ndarray | None,
    sky: int,
    vegetation: int,
) -> Tensor:
    """Segments (B, C, H, W) in which a sharp outline parts the sky from the rest, one with leaves where trees grow.

    segments       (B, C, H, W): probabilities, whose ratios among all other classes stay as they are.
    probabilities  (B, C, H, W): those that say where the sky is;  depth_m: (B, H, W) metres.
    The leaves are solid noise in the world (T_world_sensor as for `solid_noise`), at the distance of the nearest thing.
    """
    share = probabilities[:, sky].float()
    nearest = _blurred(_nearest(depth_m.float())[:, None], BOUGH_DEG / 360 * view.columns, BOUGH_ROWS)[:, 0]
    nowhere = torch.zeros_like(nearest[0], dtype=torch.bool)
    noise = torch.stack([solid_noise(one, nowhere, view, tuple(LEAVES_M), T_world_sensor) for one in nearest])
    leaves_m = torch.einsum("bkhw,k->bhw", noise.clamp_(-2, 2), noise.new_tensor(list(LEAVES_M.values())))
    trees = probabilities[:, vegetation] / (1 - share).clamp(min=LEAST)
    even = _blurred(share[:, None], CROWN_DEG / 360 * view.columns, CROWN_ROWS)[:, 0]
    above = torch.lerp(share, even, trees) - 0.5
    leafy = ((LEAFLESS - above.abs()) / THINNING).clamp_(0, 1)  # nearby, a metre is wider than what is unknown
    leaves_px = leaves_m * view.focal_px / nearest * trees * leafy
    open_sky = torch.sigmoid((_pixels_inside(above) - leaves_px) / EDGE_PX)
    rest = (1 - open_sky) / (1 - segments[:, sky]).clamp(min=LEAST)
    outlined = segments * rest[:, None]
    outlined[:, sky] = open_sky
    return outlined


def _pixels_inside(x: Tensor) -> Tensor:
    """About how many pixels each is on the positive side of where (B, H, W) is zero; columns are circular."""
    rows = torch.cat([x[:, :1].expand(-1, REACH, -1), x, x[:, -1:].expand(-1, REACH, -1)], 1)
    down = rows[:, 2 * REACH :] - rows[:, : -2 * REACH]
    across = x.roll(-REACH, 2) - x.roll(REACH, 2)
    return x / (torch.hypot(down, across) / (2 * REACH)).clamp(min=LEAST_SLOPE)


def _nearest(depth_m: Tensor) -> Tensor:
    """The least of (B, H, W) within CROWN pixels around each; columns are circular. A tenth of max_pool2d's time."""
    rows, reach = depth_m.shape[1], CROWN // 2
    around = pad(depth_m, (0, 0, reach, reach), value=torch.inf)
    for step in _doubling(CROWN):
        around = torch.minimum(around[:, :-step], around[:, step:])
    around = around[:, :rows].roll(reach, 2)
    for step in _doubling(CROWN):
        around = torch.minimum(around, around.roll(-step, 2))
    return around


def _doubling(length: int) -> list[int]:
    """Shifts that one after the other join so many neighbours: each at most as far as what is joined already."""
    steps, joined = [], 1
    while joined < length:
        steps.append(min(joined, length - joined))
        joined += steps[-1]
    return steps


def _blurred(x: Tensor, columns: float, rows: float) -> Tensor:
    """(B, C, H, W) under a Gaussian with these deviations; columns are circular, the first and last row go on."""
    across, down = _gaussian(columns, x), _gaussian(rows, x)
    reach = len(across) // 2
    wave = torch.cat([across[reach:], across.new_zeros(x.shape[3] - len(across)), across[:reach]])
    x = torch.fft.irfft(torch.fft.rfft(x) * torch.fft.rfft(wave).real, n=x.shape[3])  # a tenth of a convolution's time
    reach, height = len(down) // 2, x.shape[2]
    around = pad(x, (0, 0, reach, reach), mode="replicate")
    blurred = torch.zeros_like(x)
    for row, weight in enumerate(down.tolist()):
        blurred.add_(around[:, :, row : row + height], alpha=weight)
    return blurred


def _gaussian(deviation: float, like: Tensor) -> Tensor:
    place = torch.arange(-math.ceil(3 * deviation), math.ceil(3 * deviation) + 1).to(like)
    weight = torch.exp(-place.square() / (2 * deviation**2))
    return weight / weight.sum()
