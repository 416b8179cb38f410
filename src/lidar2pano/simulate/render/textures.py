"""Textures with mip levels: variation of albedo and slope over a surface."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from lidar2pano.simulate.render.noise import SIZE, spectral
from lidar2pano.simulate.render.patterns import PATTERNS
from lidar2pano.simulate.scene.random_streams import stream
from lidar2pano.simulate.scene.surfaces import MATERIALS

WIDE_M = 67.0  # metres before a wide pattern repeats
LEVELS = SIZE.bit_length()  # a tile of SIZE pixels, its half, ... and one pixel
STEP, MIDDLE = 100, 128  # a stored byte is 100 x factor, or 128 + 100 x slope
_STARTS = np.cumsum([0, *(4 ** (LEVELS - 1 - level) for level in range(LEVELS))]).astype(np.int32)


def _blotches() -> np.ndarray:
    return 1 + 0.06 * spectral("blotches", 1.4, 1, 60)


def _roadway() -> np.ndarray:
    """Repaired patches, seams filled with bitumen, stains."""
    rng, factor = stream(0, "roadway"), 1 + 0.055 * spectral("roadway", 1.2, 1, 100)
    for _ in range(26):
        row, column = rng.integers(0, SIZE, 2)
        high, wide = rng.integers(6, 40, 2)
        rows, columns = np.ix_((row + np.arange(high)) % SIZE, (column + np.arange(wide)) % SIZE)
        factor[rows, columns] *= rng.choice((0.72, 0.82, 0.88, 1.1))
        edge = np.ones((high, wide), dtype=bool)
        edge[1:-1, 1:-1] = False
        factor[rows, columns] *= np.where(edge, 0.7, 1).astype(np.float32)
    seams = np.abs(spectral("seams", 2.0, 1, 40)) < 0.012
    stains = spectral("stains", 0.9, 20, 120) > 3.3
    return factor * np.where(seams & (spectral("seams b", 2, 1, 6) > 0.4), 0.6, 1) * np.where(stains, 0.7, 1)


def _lawn() -> np.ndarray:
    tone = spectral("lawn", 1.3, 1, 120)
    dry = np.clip(spectral("dry", 1.4, 1, 60), -1, 2.5)
    return (1 + 0.10 * tone)[..., None] * (1 + dry[..., None] * np.array((0.09, 0.02, 0.03), dtype=np.float32))


def _weather() -> np.ndarray:
    return 1 + 0.045 * spectral("weather", 1.3, 1, 120) + 0.03 * spectral("weather b", 0.9, 8, 160)


WIDE: dict[str, Callable[[], np.ndarray]] = {
    "blotches": _blotches,
    "roadway": _roadway,
    "lawn": _lawn,
    "weather": _weather,
}

TEXTURES = ("", *PATTERNS)
TEXTURE_IDS: dict[str, int] = {name: index for index, name in enumerate(TEXTURES)}
OF_MATERIAL = np.array([TEXTURE_IDS[material.texture] for material in MATERIALS.values()], dtype=np.uint8)
"""Texture id of each material (M,)."""

_SIZES = [(1.0, 1.0), *(pattern.size_m for pattern in PATTERNS.values()), *[(WIDE_M, WIDE_M)] * len(WIDE)]
_PER_M = (1 / np.array(_SIZES, dtype=np.float32)).T.copy()  # tiles per metre along u, v: (2, textures)
_WIDE_OF = np.array(
    [len(TEXTURES) + list(WIDE).index(wide) for wide in ("blotches", *(pattern.wide for pattern in PATTERNS.values()))]
)


def sample(texture: np.ndarray, uv: np.ndarray, footprint_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Albedo factor (N, 3), mean 1, and slope (N, 2) along u and v of textures.

    texture      (N,) ids of TEXTURES; 0 is uniform.
    uv           (N, 2) metres.
    footprint_m  (N,) width of a pixel on the surface: finer detail is averaged.
    """
    taps, weights = _corners(np.asarray(texture, dtype=np.int32), uv, footprint_m)
    found = np.zeros((5, len(taps[0])), dtype=np.float32)
    pool = _pool()
    for tap, weight in zip(taps, weights, strict=True):
        texel = pool.take(tap).view(np.uint8).reshape(-1, 8)
        for channel in range(5):
            found[channel] += texel[:, channel] * weight
    found *= np.float32(1 / STEP)
    found[3:] -= np.float32(MIDDLE / STEP)
    return found[:3].T, found[3:].T


def sample_wide(texture: np.ndarray, uv: np.ndarray, footprint_m: np.ndarray) -> np.ndarray:
    """Albedo factor (N, 3) of the wide pattern laid over a texture, at uv (N, 2) in metres."""
    return sample(_WIDE_OF[texture], uv, footprint_m)[0]


def _corners(texture: np.ndarray, uv: np.ndarray, footprint_m: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The four texels around each uv at the mip level of the footprint, and their bilinear weights."""
    per_u, per_v = _PER_M[0].take(texture), _PER_M[1].take(texture)
    texels = np.maximum(footprint_m * (SIZE / 2) * (per_u + per_v), 1e-6)
    level = np.clip(np.log2(texels) + 0.5, 0, LEVELS - 1).astype(np.int32)
    size = np.right_shift(SIZE, level).astype(np.int32)
    start = _STARTS.take(level) + texture * _STARTS[-1]
    x, y = (uv[:, axis] * per * size - np.float32(0.5) for axis, per in enumerate((per_u, per_v)))
    left, low = np.floor(x), np.floor(y)
    x, y = x - left, y - low
    left, low = left.astype(np.int32), low.astype(np.int32)
    columns = [left & (size - 1), (left + 1) & (size - 1)]
    rows = [start + (low & (size - 1)) * size, start + ((low + 1) & (size - 1)) * size]
    taps = [row + column for row in rows for column in columns]
    return taps, [(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y]


@cache
def _pool() -> np.ndarray:
    """All tiles with all mip levels, eight bytes a texel: R, G, B factor, two slopes, padding."""
    pool = np.zeros((len(_SIZES), _STARTS[-1], 8), dtype=np.uint8)
    pool[0] = STEP, STEP, STEP, MIDDLE, MIDDLE, 0, 0, 0
    drawings = [pattern.draw() for pattern in PATTERNS.values()] + [(draw(), None) for draw in WIDE.values()]
    for index, (factor, height_mm) in enumerate(drawings, start=1):
        tile = np.zeros((SIZE, SIZE, 5), dtype=np.float32)
        tile[..., :3] = _normalised(factor, index != TEXTURE_IDS["litter"])
        if height_mm is not None:
            tile[..., 3:] = _slopes(height_mm, _SIZES[index])
        for level in range(LEVELS):
            texels = tile.reshape(-1, 5) * STEP + np.array(
                (0.5, 0.5, 0.5, MIDDLE + 0.5, MIDDLE + 0.5), dtype=np.float32
            )
            pool[index, _STARTS[level] : _STARTS[level + 1], :5] = np.clip(texels, 0, 255)
            if len(tile) > 1:
                tile = (tile[::2, ::2] + tile[1::2, ::2] + tile[::2, 1::2] + tile[1::2, 1::2]) / 4
    return pool.view(np.uint64).reshape(-1)


def _normalised(factor: np.ndarray, to_one: bool) -> np.ndarray:
    """The factor in three channels, within the range of a byte, scaled to mean 1."""
    factor = np.broadcast_to(factor if factor.ndim == 3 else factor[..., None], (SIZE, SIZE, 3)).astype(np.float32)
    for _ in range(2 if to_one else 0):
        factor = np.clip(factor / factor.mean((0, 1)), 0, 255 / STEP)
    return factor


def _slopes(height_mm: np.ndarray, size_m: tuple[float, float]) -> np.ndarray:
    """Slopes along u and v of a height map."""
    runs = (size_m[0] * 2000 / SIZE, size_m[1] * 2000 / SIZE)
    rise = [np.roll(height_mm, -1, axis) - np.roll(height_mm, 1, axis) for axis in (1, 0)]
    slope = np.stack([rise[0] / runs[0], rise[1] / runs[1]], axis=-1).clip(-1.2, 1.2)
    return slope - slope.mean((0, 1))
