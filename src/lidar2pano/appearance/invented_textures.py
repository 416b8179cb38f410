"""Invented textures: noise fixed in space, the outlines it gives to crowns, facades, houses' and clothes' colours.

Noise is a random field, read at the point of each pixel, after Perlin 1985 (solid texture): leaves and gravel get the
scene's perspective, look the same from every side and stay in place when the sensor moves. One periodic tile of voxels
serves all wavelengths: it is smooth over a few voxels, so that the nearest voxel will do. A wavelength that a pixel
could not show is faded out (band limiting, as in Norton et al. 1982). Against the sky a translator's probabilities
change slowly; painted as they are, they become a grey halo between a tree and the sky.

A scan measures where walls stand, and its classes say that they are walls; it hardly shows their colours. Every wall is
divided into houses, floors and windows, at random but always alike: an opening's place depends on the place in space
alone, as with `solid_noise`. Grammars of facades are Mueller et al.'s (2006); this is their simplest case.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d, one_hot, pad

from lidar2pano.geometry.rasters import as_float
from lidar2pano.labels import COMMON15
from lidar2pano.scene.surfaces import azimuths, pixel_share, slopes, surface_profile, world_columns
from lidar2pano.views import View

BITS = 6  # the tile has 2^BITS voxels along each axis
VOXELS = 4  # per wavelength
NOISE_FARTHEST_M = 200.0  # nothing stands farther away
SKY_M = 4.0  # the sky is a sphere of this radius that goes with the viewer
COARSER = 4  # pixels of the raster for each at which long wavelengths are read
STRIP = 16  # rows that are looked up at a time on a CPU, so that they stay in its cache
AWAY_M = 4096.0  # added to coordinates, a multiple of every period: whole numbers are cut off, not rounded down
EDGE_PX = 0.4  # scale of the logistic function across an outline
SLOPE_REACH = 3  # pixels to each side over which the slope of the sky's probability is taken
LEAST_SLOPE = 0.002  # of it, per pixel
CROWN_DEG, CROWN_ROWS = 0.5, 2.0  # deviations of the Gaussian over which the outlines of crowns are evened
LEAFLESS, THINNING = 0.3, 0.15  # distance of the sky's probability from 0.5 where leaves end, and over which they do
BOUGH_DEG, BOUGH_ROWS = 2.0, 8.0  # and how far away their leaves are: at a step in depth noise would be drawn out
LEAVES_M = {0.5: 0.12, 2.0: 0.3}  # wavelengths, and how far leaves and boughs move the outline of a crown
CROWN = 17  # pixels around in which the nearest thing is what stands before the sky
LEAST_SHARE = 1e-6  # probability
REACH = 40  # columns at each side whose walls say how a wall runs
SAME_WALL = 0.25  # relative difference of the distances of what still belongs to the same wall
FARTHEST_M = 60.0  # walls beyond show no windows
LOWEST_M, HIGHEST_M = 0.5, 9.0  # heights above the road at which the distance of a wall is read
DIRECTIONS = 8  # in which walls run, per half turn: rounded, so that windows stand still while estimates waver
HOUSE_M = 11.0  # width of a house
COOLEST, WARMEST = -0.05, 0.25  # how much redder and less blue than grey houses are: plaster, sandstone, brick
YELLOW = 0.4  # how much greener they are, of that
EVERY = 4  # rows of a raster for each that distances are read from
LEAST = 0.3  # rows of a column that show a wall; with fewer the column has none
BAR_M = 0.08  # width of mullions and transoms, which divide windows into panes
NO_MULLION, NO_TRANSOM = 0.25, 0.4  # share of houses whose windows have none
# Openings are whole where a wall is the likeliest: the classes' noise made slats of panes.
WALL_SHARE = 2.0
AWAY = 1 << 20  # houses; keeps their numbers positive
DRAWN = 10_000_030  # which houses there are: with these, the ones beside a sensor whose pose is not known are light
LEGS_M, HEAD_M, HAIR_M = 0.85, 1.45, 1.66  # where legs, trunk and face end
# Red, green and blue in [-1, 1], less those of the mean person; outfits beside each other are blended.
TOPS = (
    (-0.25, -0.25, -0.2),
    (0.1, -0.15, -0.15),
    (0.5, 0.5, 0.48),
    (0.05, 0.1, 0.3),
    (0.2, 0.2, 0.2),
    (-0.1, 0.0, -0.12),
)
TROUSERS = (
    (-0.15, -0.08, 0.1),
    (-0.3, -0.3, -0.3),
    (-0.12, -0.06, 0.12),
    (0.08, 0.03, -0.06),
    (-0.3, -0.3, -0.28),
    (-0.15, -0.08, 0.08),
)
# Likewise, less the mean sign: the back, which is grey, yellow, white, blue, and grey again. (Red ones were lollipops.)
SIGNS = ((0.1, 0.1, 0.05), (0.6, 0.45, -0.2), (0.6, 0.6, 0.55), (-0.25, -0.05, 0.4), (0.1, 0.1, 0.05))
SKIN, HAIR = (0.4, 0.22, 0.12), (-0.3, -0.32, -0.34)
NAMES = ("building", "person", "traffic-sign", "vegetation")
BUILDING, PERSON, SIGN, VEGETATION = map(COMMON15.id_of, NAMES)
# Half of the deviations from image to image of how bright a class is in KITTI, colours in [-1, 1]: all of them, and
# what noise has beyond its deviation, burn things out.
VARIED = dict.fromkeys(("car", "truck", "other-vehicle", "fence"), 0.15) | {"pole": 0.1}
# How much brighter than the mean trees are in the sun of a painter that has one: up to LIT_M, and none at twice that,
# for there painters paint them darker than photographs are; those that it shines on as one sees them, which are on the
# world's left, and by as much less those before it. With or without it some are, by noise, at most.
LIT, LIT_M, SUNNY_SIDE, SUNLIT = 0.22, 15.0, 0.15, 0.2
LEAVES = (1.0, 1.03, 0.78)  # of red, green and blue in a brighter tree of KITTI's images
LIKELY = 0.05  # probability of people and of signs from which on they are given colours
HOUSES_VARIED = 0.5  # how much brighter or darker than the mean a house is, at most


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
        distance = radius = depth_m[rows].float().clamp(0.1, NOISE_FARTHEST_M)
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
    """Segments (B, C, H, W) with a sharp outline between the sky from the rest, one with leaves where trees grow.

    segments       (B, C, H, W): probabilities, whose ratios among all other classes stay as they are.
    probabilities  (B, C, H, W): those that say where the sky is;  depth_m: (B, H, W) metres.
    The leaves are solid noise in the world (T_world_sensor as for `solid_noise`), at the distance of the nearest thing.
    """
    share = probabilities[:, sky].float()
    nearest = _blurred(_nearest(depth_m.float())[:, None], BOUGH_DEG / 360 * view.columns, BOUGH_ROWS)[:, 0]
    nowhere = torch.zeros_like(nearest[0], dtype=torch.bool)
    noise = torch.stack(
        [solid_noise(distance_m, nowhere, view, tuple(LEAVES_M), T_world_sensor) for distance_m in nearest]
    )
    leaves_m = torch.einsum("bkhw,k->bhw", noise.clamp_(-2, 2), noise.new_tensor(list(LEAVES_M.values())))
    trees = probabilities[:, vegetation] / (1 - share).clamp(min=LEAST_SHARE)
    even = _blurred(share[:, None], CROWN_DEG / 360 * view.columns, CROWN_ROWS)[:, 0]
    excess = torch.lerp(share, even, trees) - 0.5
    leafy = ((LEAFLESS - excess.abs()) / THINNING).clamp_(0, 1)  # nearby, a metre is wider than what is unknown
    leaves_px = leaves_m * view.focal_px / nearest * trees * leafy
    open_sky = torch.sigmoid((_pixels_inside(excess) - leaves_px) / EDGE_PX)
    rest = (1 - open_sky) / (1 - segments[:, sky]).clamp(min=LEAST_SHARE)
    outlined = segments * rest[:, None]
    outlined[:, sky] = open_sky
    return outlined


def _pixels_inside(x: Tensor) -> Tensor:
    """About how many pixels each is on the positive side of where (B, H, W) is zero; columns are circular."""
    rows = torch.cat([x[:, :1].expand(-1, SLOPE_REACH, -1), x, x[:, -1:].expand(-1, SLOPE_REACH, -1)], 1)
    down = rows[:, 2 * SLOPE_REACH :] - rows[:, : -2 * SLOPE_REACH]
    across = x.roll(-SLOPE_REACH, 2) - x.roll(SLOPE_REACH, 2)
    return x / (torch.hypot(down, across) / (2 * SLOPE_REACH)).clamp(min=LEAST_SLOPE)


def _nearest(depth_m: Tensor) -> Tensor:
    """The least of (B, H, W) within CROWN pixels around each; columns are circular. A tenth of max_pool2d's time."""
    rows, reach = depth_m.shape[1], CROWN // 2
    window = pad(depth_m, (0, 0, reach, reach), value=torch.inf)
    for step in _doubling(CROWN):
        window = torch.minimum(window[:, :-step], window[:, step:])
    window = window[:, :rows].roll(reach, 2)
    for step in _doubling(CROWN):
        window = torch.minimum(window, window.roll(-step, 2))
    return window


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
    padded = pad(x, (0, 0, reach, reach), mode="replicate")
    blurred = torch.zeros_like(x)
    for row, weight in enumerate(down.tolist()):
        blurred.add_(padded[:, :, row : row + height], alpha=weight)
    return blurred


def _gaussian(deviation: float, like: Tensor) -> Tensor:
    place = torch.arange(-math.ceil(3 * deviation), math.ceil(3 * deviation) + 1).to(like)
    weight = torch.exp(-place.square() / (2 * deviation**2))
    return weight / weight.sum()


class Facades(NamedTuple):
    """What walls show: `openings` (B, H, W) in [0, 1], the share of windows and doors in each pixel.

    tone  (B, 3, W): how bright the house of each column is in red, green and blue, about uniform in [-1, 1].
    """

    openings: Tensor
    tone: Tensor


class Walls(NamedTuple):
    """The wall of every column, each (B, W): distance from the view's axis, where along it, numbers of its house.

    house  int64, random but the same for one house;  along_m: from the house's left end;  width_m: of a pixel along it.
    """

    radius_m: Tensor
    along_m: Tensor
    width_m: Tensor
    house: Tensor


def facades(
    walls: Tensor, radius_m: Tensor, above_m: Tensor, view: View, T_world_sensor: np.ndarray | None = None
) -> Facades:
    """Openings and tones of walls.

    walls     (B, H, W): probability that a pixel shows a building.
    radius_m  (B, H, W): distance from the view's axis;  above_m: (B,), how high the view's origin is above the road.
    T_world_sensor  (4, 4): where the facades hang; None: on the sensor frame.
    """
    slope, above_m = slopes(view, device=walls.device)[:, None], above_m[:, None, None]
    profile, weight = wall_profile(*(part[:, ::EVERY] for part in (walls, radius_m, radius_m * slope + above_m)))
    surfaces = _walls(profile, weight, view, T_world_sensor)
    level_m = slope * surfaces.radius_m[:, None] + above_m
    elsewhere = ((radius_m / surfaces.radius_m[:, None] - 1).abs() / SAME_WALL - 1).clamp(0, 1)
    openings = _openings(surfaces, level_m, view) * (WALL_SHARE * walls).clamp(max=1) * (1 - elsewhere)
    warm = COOLEST + (WARMEST - COOLEST) * _uniform(surfaces.house, 9)
    tone = (2 * _uniform(surfaces.house, 0) - 1)[:, None] + torch.stack([warm, YELLOW * warm, -warm], 1)
    return Facades(openings, tone)


def wall_profile(walls: Tensor, radius_m: Tensor, height_m: Tensor) -> tuple[Tensor, Tensor]:
    """Logarithm of the distance (B, W) of each column's wall, and how many rows (B, W) it was read from."""
    inside = (height_m > LOWEST_M) & (height_m < HIGHEST_M) & (radius_m < FARTHEST_M)
    profile, total = surface_profile(walls * inside, radius_m, SAME_WALL, LEAST, REACH // 2)
    return profile.nan_to_num(math.log(FARTHEST_M)), total


def _walls(profile: Tensor, weight: Tensor, view: View, T_world_sensor: np.ndarray | None) -> Walls:
    """Straight walls through the profile around every column, and the houses they are divided into."""
    ray, start = world_columns(view, T_world_sensor, profile.device)
    point = profile.exp().double()[:, None] * ray  # (B, 2, W) from the view's axis
    mean, tangent = _lines(point, profile, weight)
    number = _direction(tangent, weight)
    normal = torch.stack([-tangent[:, 1], tangent[:, 0]], 1)
    facing = (normal * ray).sum(1)
    radius = (normal * mean).sum(1) / torch.where(facing.abs() < 0.05, 0.05 * facing.sign() + 1e-9, facing)
    radius = torch.where((radius / profile.exp()).log().abs() < 0.3, radius, profile.exp())  # else no wall is there
    run = number * (math.pi / DIRECTIONS)
    along = ((radius[:, None] * ray + start[:, None]) * torch.stack([run.cos(), run.sin()], 1)).sum(1)
    house = (along / HOUSE_M).floor()
    width = radius / view.focal_px / facing.abs().clamp(min=0.05)
    beyond = mean[:, 1] * run.cos() > mean[:, 0] * run.sin()  # of the two that face each other across a street
    mixed = _mixed(((house.long() + AWAY) * 2 + beyond) * DIRECTIONS + number.long() + DRAWN)
    return Walls(radius.float(), (along - house * HOUSE_M).float(), width.float(), mixed)


def _lines(point: Tensor, profile: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Means and unit tangents (B, 2, W) of the lines through the points (B, 2, W) around each column.

    Neighbours count by their weight and by how near their distance is to the column's own; columns are circular.
    """
    sums = torch.zeros(6, *profile.shape, dtype=torch.float64, device=profile.device)
    x, y = point.unbind(1)
    terms = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y]) * weight
    for shift in range(-REACH, REACH + 1, 2):
        near = torch.exp(-((profile.roll(shift, 1) - profile) / SAME_WALL).square())
        sums += terms.roll(shift, 2) * near
    count = sums[0].clamp(min=1e-6)
    mx, my = sums[1] / count, sums[2] / count
    xx, xy, yy = sums[3] / count - mx * mx, sums[4] / count - mx * my, sums[5] / count - my * my
    turn = torch.atan2(2 * xy, xx - yy) / 2
    return torch.stack([mx, my], 1), torch.stack([turn.cos(), turn.sin()], 1)


def _direction(tangent: Tensor, weight: Tensor) -> Tensor:
    """Number (B, W) of the direction of most walls around a column, of DIRECTIONS per half turn."""
    number = (torch.atan2(tangent[:, 1], tangent[:, 0]) * (DIRECTIONS / math.pi)).round().remainder(DIRECTIONS)
    votes = one_hot(number.long(), DIRECTIONS).movedim(2, 1) * weight[:, None]
    return avg_pool1d(pad(votes.float(), (REACH, REACH), mode="circular"), 2 * REACH + 1, 1).argmax(1)


def _openings(walls: Walls, level_m: Tensor, view: View) -> Tensor:
    """Share (B, H, W) of panes and doors in each pixel, of walls whose pixels are level_m above the road."""
    house = walls.house
    storey = (2.6 + 0.7 * _uniform(house, 1))[:, None]
    sill, tall = (0.7 + 0.4 * _uniform(house, 2))[:, None], (1.1 + 0.5 * _uniform(house, 3))[:, None]
    count = (3 + 3 * _uniform(house, 4)).floor()
    wide = 0.9 + 0.6 * _uniform(house, 5)
    base = (0.1 + 0.7 * _uniform(house, 6))[:, None]
    every = HOUSE_M / count
    window = (walls.along_m / every).floor()
    aside = (walls.along_m - (window + 0.5) * every).abs()
    is_door = window == (count * _uniform(house, 7)).floor()
    floor = ((level_m - base) / storey).floor()
    up = level_m - base - floor * storey
    door = (is_door[:, None] & (floor == 0)).float()
    middle = torch.lerp(sill + tall / 2, torch.full_like(sill, 1.0), door)
    tall = torch.lerp(tall, torch.full_like(tall, 2.1), door)
    pixel_m = walls.radius_m / view.focal_px
    across = pixel_share(wide / 2 - aside, walls.width_m) * (every / walls.width_m / 2 - 1).clamp(0, 1)
    upward = pixel_share(tall / 2 - (up - middle).abs(), pixel_m[:, None])
    mullion = _bar(aside, walls.width_m) * (_uniform(house, 10) >= NO_MULLION)
    transom = _bar(up - middle - tall / 6, pixel_m[:, None]) * (_uniform(house, 11) >= NO_TRANSOM)[:, None]
    glass = 1 - (1 - door) * torch.maximum(mullion[:, None], transom)
    blind = _uniform(_mixed(house + window.long() * 7 + 1), 0)  # a column of windows may be missing
    storeys = (2 + 3 * _uniform(house, 8)).floor()[:, None]
    exists = (floor >= 0) & (floor < storeys) & (blind > 0.1)[:, None]
    return across[:, None] * upward * glass * exists


def _bar(middle_m: Tensor, pixel_m: Tensor) -> Tensor:
    """The share of pixels that is a bar, so far from its middle; bars as fine as a pixel fade out, as they flicker."""
    share = pixel_share(BAR_M / 2 - middle_m, pixel_m) - pixel_share(-BAR_M / 2 - middle_m, pixel_m)
    return share * (BAR_M / pixel_m - 1).clamp(0, 1)


def _mixed(number: Tensor) -> Tensor:
    """Pseudo-random numbers int64 in [0, 2^31), of numbers (splitmix's multipliers, 31 bits)."""
    mask = 0x7FFFFFFF
    number = number & mask
    number = ((number ^ (number >> 15)) * 0x2C1B3C6D) & mask
    number = ((number ^ (number >> 12)) * 0x297A2D39) & mask
    return number ^ (number >> 15)


def _uniform(house: Tensor, kind: int) -> Tensor:
    """Uniform numbers (B, W) float32 in [0, 1), one kind for each `which`."""
    return _mixed(house * 31 + kind * 0x1B873593 + 1).float() / 0x80000000


def clothing(height_m: Tensor, noise: Tensor) -> Tensor:
    """How much brighter than the mean person people are at N pixels, in red, green and blue in [-1, 1]: (N, 3) float32.

    height_m  (N,): above the road, metres;  noise: (N,) in [-1, 1], about the same all over a person: the outfit.
    """
    tops, trousers = (_blended(colours, noise) for colours in (TOPS, TROUSERS))
    height_m = height_m[:, None]
    head = torch.where(height_m < HAIR_M, noise.new_tensor(SKIN), noise.new_tensor(HAIR))
    return torch.where(height_m < LEGS_M, trousers, torch.where(height_m < HEAD_M, tops, head))


def sign_colours(noise: Tensor) -> Tensor:
    """How much brighter than the mean sign signs are at N pixels, in red, green and blue in [-1, 1]: (N, 3) float32.

    noise  (N,) in [-1, 1], about the same all over a sign.
    """
    return _blended(SIGNS, noise)


def _blended(colours: Sequence[tuple[float, ...]], noise: Tensor) -> Tensor:
    """Of colours from -1 to 1 at even distances those at N places, (N, 3): each is the mean of the two beside it."""
    place = (noise + 1) / 2 * (len(colours) - 1)
    low = place.long().clamp(0, len(colours) - 2)
    table = noise.new_tensor(colours)
    return torch.lerp(table[low], table[low + 1], (place - low)[:, None])


def invented_tones(
    segments: Tensor,
    height_m: Tensor,
    radius_m: Tensor,
    noise: Tensor,
    house: Tensor,
    openings: Tensor,
    left: Tensor | None = None,
) -> Tensor:
    """How much brighter than the mean of its class each pixel is, in red, green and blue in [-1, 1]: (B, 3, H, W).

    segments   (B, classes, H, W): probabilities;  height_m, radius_m: (B, H, W) above the road, and from the axis.
    noise      (B, H, W) in [-1, 1], about the same all over a thing.
    house, openings  of `facades`;  left: (W,) of unit vectors to what columns show, how far to the world's left; None:
               there is no sun.
    """
    varied = segments.new_tensor([VARIED.get(name, 0.0) for name in COMMON15.classes], dtype=torch.float32)
    brighter = torch.einsum("bchw,c->bhw", segments.float(), varied) * noise
    trees = segments[:, VEGETATION].float() * _sunlight(noise, radius_m, left)
    tones = brighter[:, None] + trees[:, None] * noise.new_tensor(LEAVES)[:, None, None]
    tones = tones + segments[:, BUILDING, None] * _house_tones(house, openings)
    _add_colours(tones, segments, height_m, noise)
    return tones


def _add_colours(tones: Tensor, segments: Tensor, height_m: Tensor, noise: Tensor) -> None:
    """Add to tones (B, 3, H, W) those of people and signs, a few pixels each."""
    people, signs = ((segments[:, number] > LIKELY).nonzero(as_tuple=True) for number in (PERSON, SIGN))
    dressed, lettered = clothing(height_m[people], noise[people]), sign_colours(noise[signs])
    for number, place, colours in ((PERSON, people, dressed), (SIGN, signs, lettered)):
        tones.movedim(1, 3)[place] += segments[:, number][place].float()[:, None] * colours


def _sunlight(noise: Tensor, radius_m: Tensor, left: Tensor | None) -> Tensor:
    """How much brighter than the mean trees are (B, H, W), by noise (B, H, W) and where they stand: see LIT."""
    bright = noise.clamp(min=0).mul_(SUNLIT)
    if left is not None:
        bright.add_((2 - radius_m / LIT_M).clamp_(0, 1), alpha=LIT).add_(SUNNY_SIDE * left)
    return bright


def _house_tones(house: Tensor, openings: Tensor) -> Tensor:
    """How much brighter than the mean (B, 3, H, W) houses are, of `facades`: the windows of bright ones are not.

    (Panes as bright as the plaster around them were hardly seen.)
    """
    tones = (HOUSES_VARIED * house)[:, :, None]
    return tones - openings[:, None] * tones.clamp(min=0)
