"""Tileable noise for textures and clouds, and a spatial hash."""

from __future__ import annotations

from functools import cache

import numpy as np

from lidar2pano.simulate.scene.random_streams import stream

SIZE = 512  # pixels of a tile's side


def spectral(name: str, exponent: float, low: float = 1.0, high: float = 256.0, stretch: float = 1.0) -> np.ndarray:
    """Tileable spectral noise (SIZE, SIZE) float32 of mean 0 and deviation 1; rows run along v, columns along u.

    exponent  amplitude falls with frequency to this power (0 white, 1 rough, 2 soft).
    low, high the band in cycles a tile.  stretch  > 1: structures are longer along v than along u.
    """
    rows = np.fft.fftfreq(SIZE, 1 / SIZE).astype(np.float32)[:, None] * np.float32(stretch)
    columns = np.arange(SIZE // 2 + 1, dtype=np.float32)[None]
    frequency = np.sqrt(rows * rows + columns * columns)
    inside = (frequency >= low) & (frequency <= high)
    strength = np.where(inside, np.maximum(frequency, 1e-3) ** np.float32(-exponent), 0).astype(np.float32)
    field = np.fft.irfft2(_white(sum(map(ord, name)) % 5) * strength, s=(SIZE, SIZE)).astype(np.float32)
    shift = stream(0, "noise", name).integers(0, SIZE, 2)  # few spectra serve all names: shifted against each other
    field = np.roll(field, tuple(shift.tolist()), axis=(0, 1))
    return field / field.std()


@cache
def _white(index: int) -> np.ndarray:
    rng = stream(0, "white", index)
    return np.fft.rfft2(rng.standard_normal((SIZE, SIZE), dtype=np.float32)).astype(np.complex64)


def voronoi(name: str, count: int, jitter: float = 0.9, flat: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Tileable Voronoi cells, `count` along a side (a divisor of SIZE): border and cell_value (SIZE, SIZE) float32.

    border  distance to the cell's border in cells;  cell_value  one random number in [0, 1) a cell.
    flat    > 1 makes the cells wider than high.
    """
    rng, step = stream(0, "pebbles", name), SIZE // count
    place = rng.uniform(0.5 - jitter / 2, 0.5 + jitter / 2, (2, count, count)).astype(np.float32)
    cell_values = rng.random((count, count), dtype=np.float32)
    inner = (np.arange(step, dtype=np.float32) + 0.5) / step
    shape = (count, step, count, step)
    first, second = np.full(shape, 9, np.float32), np.full(shape, 9, np.float32)
    cell_value = np.zeros(shape, np.float32)
    for row in (-1, 0, 1):
        for column in (-1, 0, 1):
            v, u = (np.roll(axis, (-row, -column), (0, 1)) for axis in place)
            dv = (inner[None, :, None] - v[:, None, :] - row) * flat
            du = inner[None, None, :] - u[:, :, None] - column
            away = np.sqrt(dv[:, :, :, None] ** 2 + du[:, None] ** 2)
            nearer = away < first
            second = np.where(nearer, first, np.minimum(second, away))
            first = np.where(nearer, away, first)
            cell_value = np.where(nearer, np.roll(cell_values, (-row, -column), (0, 1))[:, None, :, None], cell_value)
    return ((second - first) / 2).reshape(SIZE, SIZE), cell_value.reshape(SIZE, SIZE)


def spatial_hash(place: np.ndarray, cell_m: float, salt: int) -> np.ndarray:
    """Spatial hash: a number in [0, 1) for each point (3, N), metres, constant within cubes of `cell_m`."""
    # The shift keeps floors and walls at round coordinates away from the cubes' faces, where rounding would decide.
    cell = np.floor(place * np.float32(1 / cell_m) + np.float32(0.382)).astype(np.int32).view(np.uint32)
    mixed = cell[0] * np.uint32(73856093) ^ cell[1] * np.uint32(19349663) ^ cell[2] * np.uint32(83492791)
    mixed ^= np.uint32(salt * 0x9E3779B9 & 0xFFFFFFFF)
    mixed ^= mixed >> np.uint32(16)
    mixed *= np.uint32(0x7FEB352D)
    mixed ^= mixed >> np.uint32(15)
    mixed *= np.uint32(0x846CA68B)
    mixed ^= mixed >> np.uint32(16)
    return (mixed >> np.uint32(8)).astype(np.float32) * np.float32(2**-24)


def bilinear(tile: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Values (N,) of a repeating tile, interpolated between its pixels: x to the right, y down, both (N,)."""
    left, low = np.floor(x), np.floor(y)
    fx, fy = x - left, y - low
    left, low = left.astype(np.int32) & (SIZE - 1), low.astype(np.int32) & (SIZE - 1)
    right, high = (left + 1) & (SIZE - 1), (low + 1) & (SIZE - 1)
    flat = tile.reshape(-1)
    lower = flat.take(low * SIZE + left) * (1 - fx) + flat.take(low * SIZE + right) * fx
    upper = flat.take(high * SIZE + left) * (1 - fx) + flat.take(high * SIZE + right) * fx
    return lower * (1 - fy) + upper * fy
