"""Procedural patterns of surfaces, drawn once on tiles that repeat."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lidar2pano.simulate.render.noise import SIZE, spectral, voronoi
from lidar2pano.simulate.scene.random_streams import stream

Drawing = tuple[np.ndarray, np.ndarray]
"""Albedo factor (SIZE, SIZE) or (SIZE, SIZE, 3) of any mean; height (SIZE, SIZE) in millimetres."""


class Pattern(NamedTuple):
    """The size of a tile along u and v in metres, the function that draws it, and the wide pattern laid over it."""

    size_m: tuple[float, float]
    draw: Callable[[], Drawing]
    wide: str = "blotches"


def _grid() -> tuple[np.ndarray, np.ndarray]:
    v, u = np.meshgrid((np.arange(SIZE) + 0.5) / SIZE, (np.arange(SIZE) + 0.5) / SIZE, indexing="ij")
    return u.astype(np.float32), v.astype(np.float32)


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
    u, v = _grid()
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
    u, _ = _grid()
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
    u, v = _grid()
    columns, rows = 10, 8
    cell_values = stream(0, "tiles").random((rows, columns), dtype=np.float32)
    cell_value = cell_values[np.floor(v * rows).astype(int), np.floor(u * columns).astype(int)]
    up, across = v * rows % 1, u * columns % 1
    wave = np.cos(2 * np.pi * across)
    shade = 1 - 0.55 * _smooth(up, 0.86, 0.99) - 0.12 * _smooth(-wave, 0.3, 1)  # under the next row's edge
    moss = _smooth(spectral("moss", 1.2, 2), 1.0, 2.2)
    factor = shade * (0.78 + 0.44 * cell_value + 0.06 * spectral("tiles", 0.8, 8))
    return _coloured(factor * (1 - 0.3 * moss), cell_value - 0.5 - moss, (0.14, -0.04, -0.06)), 16 * (
        1 - up
    ) + 12 * wave


def _stone() -> Drawing:
    inside, cell_value = _bonded(5, 8, 0.07, 0.4)
    rough = spectral("stone", 1.1, 4)
    factor = (0.6 + 0.4 * inside) * (0.8 + 0.4 * cell_value + 0.09 * rough)
    return _coloured(factor, cell_value - 0.5, (0.14, 0, -0.14)), 7 * inside + 2.5 * rough


def _planks(count: int, gap: float) -> Drawing:
    u, _ = _grid()
    cell_values = stream(0, "planks", count).random(count, dtype=np.float32)
    cell_value = cell_values[np.floor(u * count).astype(int)]
    across = u * count % 1
    edge = _smooth(np.minimum(across, 1 - across), gap * 0.3, gap)
    fine = spectral("wood", 0.7, 3, 256, 14)
    fine = np.roll(fine, 97, axis=0) * 0.5 + fine
    return (0.4 + 0.6 * edge) * (0.8 + 0.4 * cell_value + 0.12 * fine), 3 * edge + 0.25 * fine


def _shutter() -> Drawing:
    _, v = _grid()
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
    u, v = _grid()
    letter, across = np.floor(u * 9).astype(int), u * 9 % 1
    cell_values = stream(0, "plate").random((9, 5, 3))
    cell_values[[0, 8]] = 1
    bars = (
        cell_values[letter, np.minimum((v - 0.2) / 0.12, 4).clip(0).astype(int), np.floor(across * 3).astype(int)]
        < 0.55
    )
    ink = bars & (np.abs(v - 0.5) < 0.3) & (np.abs(across - 0.5) < 0.38)
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
    _, other = voronoi("leaves", 16, 0.9, 1.02)
    factor = np.exp(0.9 * (cell_value - 0.5)) * (0.75 + 0.25 * _smooth(seam, 0, 0.12))
    v_lean, u_lean = np.sin(40 * cell_value), np.sin(57 * other + 1)
    u, v = _grid()
    lean = 40 * (u_lean * (u * 16 % 1) + v_lean * (v * 16 % 1))
    return _coloured(factor, np.sin(91 * cell_value), (0.14, 0.03, 0.0)), lean


def _litter() -> Drawing:
    """Fallen leaves: the factor is the share of the ground that they cover."""
    seam, cell_value = voronoi("litter", 64)
    place = spectral("litter", 1.4, 1, 14)
    return _smooth(seam, 0.02, 0.2) * _smooth(0.55 * place + 2.2 * (cell_value - 0.5), 0.2, 0.5), np.zeros_like(seam)


PATTERNS: dict[str, Pattern] = {
    "asphalt": Pattern((3.0, 3.0), _asphalt, "roadway"),
    "paint": Pattern((2.0, 2.0), _paint, "roadway"),
    "cobbles": Pattern((1.9, 1.9), _cobbles),
    "paving": Pattern((2.4, 2.4), _paving, "roadway"),
    "concrete": Pattern((3.0, 3.0), _concrete),
    "gravel": Pattern((1.6, 1.6), _gravel),
    "soil": Pattern((2.0, 2.0), _soil),
    "grass": Pattern((2.3, 2.3), lambda: _blades("grass", 0.8, 10), "lawn"),
    "meadow": Pattern((4.1, 4.1), lambda: _blades("meadow", 1.4, 26), "lawn"),
    "field": Pattern((6.0, 6.0), _field, "lawn"),
    "plaster": Pattern((2.6, 2.6), _plaster, "weather"),
    "brick": Pattern((2.0, 2.0), _brick, "weather"),
    "tiles": Pattern((2.2, 2.6), _tiles, "weather"),
    "stone": Pattern((2.6, 2.1), _stone, "weather"),
    "wood": Pattern((1.2, 2.4), lambda: _planks(8, 0.08), "weather"),
    "shutter": Pattern((1.0, 1.0), _shutter),
    "door": Pattern((1.0, 2.1), lambda: _planks(4, 0.03)),
    "pane": Pattern((5.3, 4.7), _pane),
    "metal": Pattern((1.5, 1.5), _metal),
    "car-paint": Pattern((2.0, 2.0), _car_paint),
    "cloth": Pattern((0.7, 0.7), _cloth),
    "plate": Pattern((0.52, 0.14), _plate),
    "bark": Pattern((0.9, 0.9), _bark),
    "birch": Pattern((0.8, 0.8), _birch),
    "leaves": Pattern((1.0, 1.0), _leaves),
    "litter": Pattern((3.4, 3.4), _litter),
}
