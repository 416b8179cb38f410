"""Textures: tileable noise, the patterns drawn from it, and their sampling with mip levels; a spatial hash."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from lidar2pano.simulate.scene.random_streams import stream
from lidar2pano.simulate.scene.surfaces import MATERIALS, grid

SIZE = 512  # pixels of a tile's side
WIDE_M = 67.0  # metres before a wide pattern repeats
LEVELS = SIZE.bit_length()  # a tile of SIZE pixels, its half, ... and one pixel
STEP, MIDDLE = 100, 128  # a stored byte is 100 x factor, or 128 + 100 x slope
_STARTS = np.cumsum([0, *(4 ** (LEVELS - 1 - level) for level in range(LEVELS))]).astype(np.int32)


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


_GRID = tuple(axis.astype(np.float32) for axis in grid(SIZE))

Drawing = tuple[np.ndarray, np.ndarray]
"""Albedo factor (SIZE, SIZE) or (SIZE, SIZE, 3) of any mean; height (SIZE, SIZE) in millimetres."""


class Pattern(NamedTuple):
    """The size of a tile along u and v in metres, its drawing function, and the wide pattern laid over it."""

    size_m: tuple[float, float]
    draw: Callable[[], Drawing]
    wide: str = "blotches"


def _coloured(factor: np.ndarray, hue: np.ndarray, towards: tuple[float, float, float]) -> np.ndarray:
    """A grey factor whose colour moves towards `towards` (deviations of R, G, B) with the field `hue`."""
    return factor[..., None] * (1 + hue[..., None] * np.asarray(towards, dtype=np.float32))


def _smooth(value: np.ndarray, low: float, high: float) -> np.ndarray:
    t = np.clip((value - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def _bonded(columns: int, rows: int, joint: float, shift: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Bricks in bond: distance from the joint (0 in it, 1 within the brick), and one random number a brick.

    joint  width of a joint as a share of a brick's height.
    """
    u, v = _GRID
    row = np.floor(v * rows).astype(int)
    along = u * columns + row % 2 * shift
    column = np.floor(along).astype(int) % columns
    wide = rows / columns  # a brick is so many times as wide as high
    edge = np.minimum(np.minimum(along % 1, 1 - along % 1) * wide, np.minimum(v * rows % 1, 1 - v * rows % 1))
    cell_values = stream(0, "bond", columns, rows).random((rows, columns), dtype=np.float32)
    return _smooth(edge, joint * 0.4, joint), cell_values[row, column]


def _asphalt() -> Drawing:
    fine, cell_value = voronoi("asphalt", 128)
    speck = spectral("asphalt", 0.3, 30)
    stone = (cell_value - 0.5) * _smooth(fine, 0, 0.25)
    cracks = _smooth(np.abs(spectral("cracks", 1.6, 2, 60)), 0.0, 0.018)
    cracks = np.maximum(cracks, _smooth(spectral("where cracks", 2, 1, 4), -0.2, 0.6))  # only in places
    factor = 1 + 0.5 * stone + 0.09 * speck + 0.05 * spectral("asphalt b", 1.5, 2, 30)
    return factor * (0.6 + 0.4 * cracks), 1.2 * stone + 0.5 * speck + 2 * cracks


def _paint() -> Drawing:
    worn = _smooth(spectral("worn", 1.0, 4) + 0.5 * spectral("worn b", 0.4, 40), 1.1, 2.2)
    fine = spectral("paint", 0.4, 20)
    return 1 + 0.05 * fine - 0.55 * worn, 0.4 * fine - worn


def _cobbles() -> Drawing:
    inside, cell_value = _bonded(16, 16, 0.2)
    rough = spectral("cobbles", 1, 8)
    factor = (0.45 + 0.55 * inside) * (0.8 + 0.4 * cell_value + 0.07 * rough)
    return _coloured(factor, cell_value - 0.5, (0.12, 0, -0.12)), 9 * inside + 1.0 * rough


def _paving() -> Drawing:
    inside, cell_value = _bonded(8, 16, 0.08)
    fine = spectral("paving", 0.3, 20)
    factor = (0.55 + 0.45 * inside) * (0.9 + 0.2 * cell_value + 0.07 * fine + 0.05 * spectral("paving b", 1.5, 2, 40))
    return _coloured(factor, cell_value - 0.5, (0.05, 0, -0.05)), 3 * inside + 0.3 * fine


def _concrete() -> Drawing:
    stains = spectral("concrete", 1.5, 2, 80, 0.4)
    fine = spectral("concrete b", 0.2, 30)
    holes = _smooth(spectral("holes", 0.6, 30, 90), 2.6, 3.2)
    return (1 + 0.09 * stains + 0.05 * fine) * (1 - 0.4 * holes), 0.5 * fine - 3 * holes


def _gravel() -> Drawing:
    seam, cell_value = voronoi("gravel", 64)
    solid = _smooth(seam, 0, 0.2)
    factor = (0.5 + 0.5 * solid) * (0.7 + 0.6 * cell_value)
    return _coloured(factor, cell_value - 0.5, (0.12, 0, -0.14)), 9 * solid + 4 * cell_value


def _soil() -> Drawing:
    seam, cell_value = voronoi("soil", 32)
    lumps = spectral("soil", 1.3, 3)
    crumbs = _smooth(seam, 0, 0.3) * cell_value
    return 0.85 + 0.18 * lumps + 0.35 * crumbs, 9 * lumps + 6 * crumbs


def _blades(name: str, dry: float, height: float) -> Drawing:
    """Grass: many thin upright strokes in shades of green, tufts, and straws in yellow."""
    strokes = 0.8 * spectral(name, 0.4, 24, 256, 0.45) + 0.5 * spectral(name + " b", 0.5, 16, 256, 2.2)
    tufts = spectral(name + " tufts", 1.2, 3, 50)
    straw = _smooth(spectral(name + " straw", 0.5, 12, 200, 0.4), 1.3, 2.4)
    factor = np.exp(0.34 * strokes + 0.22 * tufts) + 0.5 * straw
    hue = np.clip(0.5 * tufts + 0.4 * spectral(name + " hue", 1.6, 2, 40) + 2.5 * straw, -1.5, 3)
    return _coloured(factor, hue, (0.16 * dry, 0.02, 0.04 * dry)), height * (strokes + 1.4 * tufts)


def _field() -> Drawing:
    u, _ = _GRID
    furrow = np.cos(2 * np.pi * (u * 24 + 0.02 * spectral("furrow", 2, 1, 8)))
    clods = spectral("field", 1.0, 6)
    factor = 0.95 + 0.12 * furrow + 0.22 * clods
    return _coloured(factor, clods, (0.06, 0, -0.05)), 14 * furrow + 7 * clods


def _plaster() -> Drawing:
    fine, soft = spectral("plaster", 0.3, 40), spectral("plaster b", 1.6, 2, 30, 0.5)
    return 1 + 0.035 * fine + 0.03 * soft, 0.6 * fine


def _brick() -> Drawing:
    inside, cell_value = _bonded(8, 24, 0.16)
    rough = spectral("brick", 0.6, 10)
    clay = _coloured(0.7 + 0.5 * cell_value + 0.08 * rough, cell_value - 0.5, (0.2, -0.05, -0.1))
    mortar = np.array((1.25, 2.2, 2.6), dtype=np.float32) * (1 + 0.1 * rough[..., None])
    return clay * inside[..., None] + mortar * (1 - inside[..., None]), 4 * inside + 0.6 * rough


def _tiles() -> Drawing:
    u, v = _GRID
    columns, rows = 10, 8
    cell_values = stream(0, "tiles").random((rows, columns), dtype=np.float32)
    cell_value = cell_values[np.floor(v * rows).astype(int), np.floor(u * columns).astype(int)]
    up, across = v * rows % 1, u * columns % 1
    wave = np.cos(2 * np.pi * across)
    shade = 1 - 0.55 * _smooth(up, 0.86, 0.99) - 0.12 * _smooth(-wave, 0.3, 1)  # under the next row's edge
    moss = _smooth(spectral("moss", 1.2, 2), 1.0, 2.2)
    factor = shade * (0.78 + 0.44 * cell_value + 0.06 * spectral("tiles", 0.8, 8)) * (1 - 0.3 * moss)
    return _coloured(factor, cell_value - 0.5 - moss, (0.14, -0.04, -0.06)), 16 * (1 - up) + 12 * wave


def _stone() -> Drawing:
    inside, cell_value = _bonded(5, 8, 0.07, 0.4)
    rough = spectral("stone", 1.1, 4)
    factor = (0.6 + 0.4 * inside) * (0.8 + 0.4 * cell_value + 0.09 * rough)
    return _coloured(factor, cell_value - 0.5, (0.14, 0, -0.14)), 7 * inside + 2.5 * rough


def _planks(count: int, gap: float) -> Drawing:
    u, _ = _GRID
    cell_values = stream(0, "planks", count).random(count, dtype=np.float32)
    cell_value = cell_values[np.floor(u * count).astype(int)]
    across = u * count % 1
    edge = _smooth(np.minimum(across, 1 - across), gap * 0.3, gap)
    fine = spectral("wood", 0.7, 3, 256, 14)
    fine = np.roll(fine, 97, axis=0) * 0.5 + fine
    return (0.4 + 0.6 * edge) * (0.8 + 0.4 * cell_value + 0.12 * fine), 3 * edge + 0.25 * fine


def _shutter() -> Drawing:
    _, v = _GRID
    slat = v * 22 % 1
    return 0.55 + 0.55 * _smooth(slat, 0, 0.16) - 0.15 * slat, 7 * slat


def _pane() -> Drawing:
    curtain = spectral("curtain", 0.8, 2, 40, 30)
    room = spectral("room", 2.0, 1, 8)
    return np.exp(0.35 * room + 0.15 * curtain), 0.15 * spectral("pane", 2.2, 1, 6)


def _metal() -> Drawing:
    dirt = spectral("metal", 1.3, 2, 100, 4)
    return 1 + 0.07 * dirt + 0.03 * spectral("metal b", 0.4, 20), 0.4 * spectral("dents", 2, 2, 30)


def _car_paint() -> Drawing:
    dust = spectral("dust", 1.2, 2, 120)
    return 1 + 0.03 * dust + 0.015 * spectral("flakes", 0, 60), 0.05 * spectral("peel", 1.5, 4, 60)


def _cloth() -> Drawing:
    folds = spectral("folds", 1.7, 2, 40, 0.6)
    weave = spectral("weave", 0.2, 60)
    return 1 + 0.13 * folds + 0.05 * weave, 14 * folds + 0.5 * weave


def _plate() -> Drawing:
    """Number plate: seven random letters of bars, and the blue band."""
    u, v = _GRID
    letter, across = np.floor(u * 9).astype(int), u * 9 % 1
    cell_values = stream(0, "plate").random((9, 5, 3))
    cell_values[[0, 8]] = 1
    row, column = np.minimum((v - 0.2) / 0.12, 4).clip(0).astype(int), np.floor(across * 3).astype(int)
    ink = (cell_values[letter, row, column] < 0.55) & (np.abs(v - 0.5) < 0.3) & (np.abs(across - 0.5) < 0.38)
    blue = np.where(u < 0.08, 1.0, 0.0)[..., None] * np.array((0.85, 0.7, 0.1), dtype=np.float32)
    return (1 - 0.93 * ink[..., None]) * (1 - blue), np.zeros_like(u)


def _bark() -> Drawing:
    ridges = np.abs(spectral("bark", 0.8, 5, 120, 0.22))
    moss = _smooth(spectral("bark moss", 1.5, 1, 20), 0.6, 2)
    factor = 0.45 + 0.55 * np.minimum(ridges, 1.6) + 0.08 * spectral("bark b", 0.4, 20)
    return _coloured(factor, moss, (-0.25, 0.1, -0.2)), 12 * np.minimum(ridges, 1.6)


def _birch() -> Drawing:
    scars = _smooth(spectral("birch", 0.7, 3, 90, 6), 1.3, 1.8)
    return (1 + 0.06 * spectral("birch b", 0.8, 6)) * (1 - 0.85 * scars), -2 * scars


def _leaves() -> Drawing:
    """Leaves: each Voronoi cell has its own shade, and the slope of its own random plane."""
    seam, cell_value = voronoi("leaves", 16)
    _, second_value = voronoi("leaves", 16, 0.9, 1.02)
    factor = np.exp(0.9 * (cell_value - 0.5)) * (0.75 + 0.25 * _smooth(seam, 0, 0.12))
    v_lean, u_lean = np.sin(40 * cell_value), np.sin(57 * second_value + 1)
    u, v = _GRID
    lean = 40 * (u_lean * (u * 16 % 1) + v_lean * (v * 16 % 1))
    return _coloured(factor, np.sin(91 * cell_value), (0.14, 0.03, 0.0)), lean


def _litter() -> Drawing:
    """Fallen leaves: the factor is the covered share of the ground."""
    seam, cell_value = voronoi("litter", 64)
    place = spectral("litter", 1.4, 1, 14)
    return _smooth(seam, 0.02, 0.2) * _smooth(0.55 * place + 2.2 * (cell_value - 0.5), 0.2, 0.5), np.zeros_like(seam)


PATTERNS: dict[str, Pattern] = {
    "asphalt": Pattern((3.0, 3.0), _asphalt, "roadway"), "paint": Pattern((2.0, 2.0), _paint, "roadway"),
    "cobbles": Pattern((1.9, 1.9), _cobbles), "paving": Pattern((2.4, 2.4), _paving, "roadway"),
    "concrete": Pattern((3.0, 3.0), _concrete), "gravel": Pattern((1.6, 1.6), _gravel),
    "soil": Pattern((2.0, 2.0), _soil), "grass": Pattern((2.3, 2.3), lambda: _blades("grass", 0.8, 10), "lawn"),
    "meadow": Pattern((4.1, 4.1), lambda: _blades("meadow", 1.4, 26), "lawn"),
    "field": Pattern((6.0, 6.0), _field, "lawn"), "plaster": Pattern((2.6, 2.6), _plaster, "weather"),
    "brick": Pattern((2.0, 2.0), _brick, "weather"), "tiles": Pattern((2.2, 2.6), _tiles, "weather"),
    "stone": Pattern((2.6, 2.1), _stone, "weather"), "wood": Pattern((1.2, 2.4), lambda: _planks(8, 0.08), "weather"),
    "shutter": Pattern((1.0, 1.0), _shutter), "door": Pattern((1.0, 2.1), lambda: _planks(4, 0.03)),
    "pane": Pattern((5.3, 4.7), _pane), "metal": Pattern((1.5, 1.5), _metal),
    "car-paint": Pattern((2.0, 2.0), _car_paint), "cloth": Pattern((0.7, 0.7), _cloth),
    "plate": Pattern((0.52, 0.14), _plate), "bark": Pattern((0.9, 0.9), _bark), "birch": Pattern((0.8, 0.8), _birch),
    "leaves": Pattern((1.0, 1.0), _leaves), "litter": Pattern((3.4, 3.4), _litter),
}  # fmt: skip


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


WIDE: dict[str, Callable[[], np.ndarray]] = {
    "blotches": lambda: 1 + 0.06 * spectral("blotches", 1.4, 1, 60),
    "roadway": _roadway,
    "lawn": _lawn,
    "weather": lambda: 1 + 0.045 * spectral("weather", 1.3, 1, 120) + 0.03 * spectral("weather b", 0.9, 8, 160),
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
    values = np.zeros((5, len(taps[0])), dtype=np.float32)
    pool = _pool()
    for tap, weight in zip(taps, weights, strict=True):
        texel = pool.take(tap).view(np.uint8).reshape(-1, 8)
        for channel in range(5):
            values[channel] += texel[:, channel] * weight
    values *= np.float32(1 / STEP)
    values[3:] -= np.float32(MIDDLE / STEP)
    return values[:3].T, values[3:].T


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
        rgb = np.broadcast_to(factor if factor.ndim == 3 else factor[..., None], (SIZE, SIZE, 3)).astype(np.float32)
        for _ in range(0 if index == TEXTURE_IDS["litter"] else 2):  # to mean 1, within the range of a byte
            rgb = np.clip(rgb / rgb.mean((0, 1)), 0, 255 / STEP)
        tile = np.concatenate([rgb, np.zeros((SIZE, SIZE, 2), dtype=np.float32)], axis=-1)
        if height_mm is not None:
            tile[..., 3:] = _slopes(height_mm, _SIZES[index])
        for level in range(LEVELS):
            texels = tile.reshape(-1, 5) * STEP + (np.array((0, 0, 0, MIDDLE, MIDDLE), dtype=np.float32) + 0.5)
            pool[index, _STARTS[level] : _STARTS[level + 1], :5] = np.clip(texels, 0, 255)
            if len(tile) > 1:
                tile = (tile[::2, ::2] + tile[1::2, ::2] + tile[::2, 1::2] + tile[1::2, 1::2]) / 4
    return pool.view(np.uint64).reshape(-1)


def _slopes(height_mm: np.ndarray, size_m: tuple[float, float]) -> np.ndarray:
    """Slopes along u and v of a height map."""
    rises = [np.roll(height_mm, -1, axis) - np.roll(height_mm, 1, axis) for axis in (1, 0)]
    slopes = [rise / (size * 2000 / SIZE) for rise, size in zip(rises, size_m, strict=True)]
    slope = np.stack(slopes, axis=-1).clip(-1.2, 1.2)
    return slope - slope.mean((0, 1))
