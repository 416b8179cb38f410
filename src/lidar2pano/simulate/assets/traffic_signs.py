"""Traffic signs: plates of coloured polygons on a post; they face +x."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lidar2pano.simulate.scene.mesh import Mesh, Tint, merged, mesh, tube

WHITE: Tint = (1.1, 1.1, 1.1)
RED: Tint = (0.85, 0.04, 0.05)
BLUE: Tint = (0.02, 0.16, 0.6)
YELLOW: Tint = (1.15, 0.72, 0.04)
BLACK: Tint = (0.03, 0.03, 0.03)
GREY: Tint = (0.55, 0.55, 0.55)
RAISED = 0.003  # metres from one layer of a plate to the next


class Layer(NamedTuple):
    """A convex polygon (N, 2), counter-clockwise: metres to the right and up from a plate's middle; and its tint."""

    outline: np.ndarray
    tint: Tint


Plate = list[Layer]  # the first layer is the plate's own outline


def _ngon(corners: int, radius: float, turn: float = 0.0, at: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """A regular polygon, its first corner at `turn` radians from the right."""
    angle = turn + 2 * np.pi * np.arange(corners) / corners
    return radius * np.column_stack([np.cos(angle), np.sin(angle)]) + at


def _disc(radius: float) -> np.ndarray:
    return _ngon(20, radius)


def _oblong(width: float, height: float, at: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    return np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (width / 2, height / 2) + at


def _bar(start: tuple[float, float], end: tuple[float, float], thick: float) -> np.ndarray:
    way = np.subtract(end, start)
    aside = np.array([way[1], -way[0]]) * thick / 2 / np.hypot(*way)
    return np.array([start + aside, end + aside, end - aside, start - aside])


_STROKES = {  # of digits, in a box 0..1 wide and 0..2 high
    "0": [(0, 0, 1, 0), (1, 0, 1, 2), (1, 2, 0, 2), (0, 2, 0, 0)],
    "1": [(0.6, 0, 0.6, 2), (0.1, 1.5, 0.6, 2)],
    "2": [(0, 2, 1, 2), (1, 2, 1, 1), (1, 1, 0, 0), (0, 0, 1, 0)],
    "3": [(0, 2, 1, 2), (0.3, 1, 1, 1), (0, 0, 1, 0), (1, 0, 1, 2)],
    "5": [(1, 2, 0, 2), (0, 2, 0, 1.1), (0, 1.1, 1, 1.1), (1, 1.1, 1, 0), (1, 0, 0, 0)],
    "6": [(1, 2, 0, 1.2), (0, 1.2, 0, 0), (0, 0, 1, 0), (1, 0, 1, 1.1), (1, 1.1, 0, 1.1)],
    "7": [(0, 2, 1, 2), (1, 2, 0.3, 0)],
    "8": [(0, 0, 1, 0), (1, 0, 1, 2), (1, 2, 0, 2), (0, 2, 0, 0), (0, 1, 1, 1)],
    "H": [(0, 0, 0, 2), (1, 0, 1, 2), (0, 1, 1, 1)],
    "P": [(0, 0, 0, 2), (0, 2, 1, 2), (1, 2, 1, 1), (1, 1, 0, 1)],
    "S": [(1, 2, 0, 2), (0, 2, 0, 1), (0, 1, 1, 1), (1, 1, 1, 0), (1, 0, 0, 0)],
    "T": [(0, 2, 1, 2), (0.5, 0, 0.5, 2)],
}


def _written(text: str, size: float, thick: float, tint: Tint) -> Plate:
    """Letters of height 2 x `size` around the middle."""
    layers, left = [], -(len(text) * 1.45 - 0.45) * size / 2
    for letter in text:
        for a, b, c, d in _STROKES[letter]:
            layers.append(
                Layer(_bar((left + a * size, (b - 1) * size), (left + c * size, (d - 1) * size), thick), tint)
            )
        left += 1.45 * size
    return layers


def _lines(rng: np.random.Generator, width: float, levels: list[float], high: float, tint: Tint) -> Plate:
    """Lines of writing, too small to be read."""
    layers = []
    for level in levels:
        left = -width / 2 * rng.uniform(0.5, 1.0)
        right = -left
        while left < right - 0.02:
            long = rng.uniform(0.3, 0.9) * high
            layers.append(Layer(_oblong(long, high * rng.choice((0.7, 1.0)), (left + long / 2, level)), tint))
            left += long + 0.25 * high
    return layers


def _arrow(size: float, turn: float, tint: Tint, at: tuple[float, float] = (0.0, 0.0)) -> Plate:
    """An arrow towards `turn` radians from the right."""
    way = size * np.array([np.cos(turn), np.sin(turn)])
    start, neck = np.subtract(at, way), np.add(at, 0.2 * way)
    head = _ngon(3, 0.65 * size, turn, (float(neck[0] + 0.3 * way[0]), float(neck[1] + 0.3 * way[1])))
    return [Layer(_bar((start[0], start[1]), (neck[0], neck[1]), 0.35 * size), tint), Layer(head, tint)]


def _banned(inner: Tint) -> Plate:
    return [Layer(_disc(0.3), RED), Layer(_disc(0.235), inner)]


def _speed_limit(rng: np.random.Generator) -> Plate:
    return [*_banned(WHITE), *_written(str(rng.choice(("30", "30", "50", "60", "70", "80"))), 0.11, 0.05, BLACK)]


def _give_way(rng: np.random.Generator) -> Plate:
    return [Layer(_ngon(3, 0.52, -np.pi / 2), RED), Layer(_ngon(3, 0.33, -np.pi / 2), WHITE)]


def _warning(rng: np.random.Generator) -> Plate:
    plate = [Layer(_ngon(3, 0.52, np.pi / 2), RED), Layer(_ngon(3, 0.35, np.pi / 2), WHITE)]
    if rng.uniform() < 0.5:
        return [*plate, Layer(_oblong(0.05, 0.24, (0, 0.02)), BLACK), Layer(_oblong(0.12, 0.04, (0, -0.12)), BLACK)]
    return [
        *plate,
        Layer(_bar((-0.1, -0.14), (0.1, 0.08), 0.05), BLACK),
        Layer(_bar((0.1, -0.14), (-0.1, 0.08), 0.05), BLACK),
    ]


def _priority(rng: np.random.Generator) -> Plate:
    return [
        Layer(_ngon(4, 0.42), WHITE),
        Layer(_ngon(4, 0.40), BLACK),
        Layer(_ngon(4, 0.39), WHITE),
        Layer(_ngon(4, 0.28), YELLOW),
    ]


def _stop(rng: np.random.Generator) -> Plate:
    plate = [Layer(_ngon(8, 0.45, np.pi / 8), WHITE), Layer(_ngon(8, 0.42, np.pi / 8), RED)]
    return [*plate, *_written("ST0P", 0.1, 0.05, WHITE)]


def _no_parking(rng: np.random.Generator) -> Plate:
    plate = [*_banned(BLUE), Layer(_bar((-0.2, 0.2), (0.2, -0.2), 0.06), RED)]
    return plate if rng.uniform() < 0.6 else [*plate, Layer(_bar((-0.2, -0.2), (0.2, 0.2), 0.06), RED)]


def _no_entry(rng: np.random.Generator) -> Plate:
    return [Layer(_disc(0.3), WHITE), Layer(_disc(0.285), RED), Layer(_oblong(0.42, 0.1), WHITE)]


def _one_way(rng: np.random.Generator) -> Plate:
    turn = 0.0 if rng.uniform() < 0.5 else np.pi
    return [Layer(_oblong(0.8, 0.3), BLUE), *_arrow(0.3, turn, WHITE)]


def _crossing(rng: np.random.Generator) -> Plate:
    plate = [Layer(_oblong(0.6, 0.6), BLUE), Layer(_ngon(3, 0.3, np.pi / 2, (0, -0.06)), WHITE)]
    plate += [Layer(_oblong(0.3, 0.03, (0, -0.17)), BLACK), Layer(_oblong(0.07, 0.2, (0, -0.01)), BLACK)]
    return [*plate, Layer(_ngon(8, 0.035, 0, (0, 0.12)), BLACK)]


def _direction(rng: np.random.Generator) -> Plate:
    ground, ink = (YELLOW, BLACK) if rng.uniform() < 0.7 else (WHITE, BLACK)
    pointed = np.array([(-0.6, -0.17), (0.5, -0.17), (0.66, 0), (0.5, 0.17), (-0.6, 0.17)])
    if rng.uniform() < 0.5:
        pointed = (pointed * (-1, 1))[::-1]
    return [Layer(pointed, ink), Layer(pointed * (0.97, 0.88), ground), *_lines(rng, 0.9, [0.0], 0.13, ink)]


def _town_name(rng: np.random.Generator) -> Plate:
    plate = [Layer(_oblong(1.2, 0.8), BLACK), Layer(_oblong(1.15, 0.75), YELLOW)]
    return [*plate, *_lines(rng, 1.0, [0.12], 0.2, BLACK), *_lines(rng, 0.7, [-0.15, -0.27], 0.08, BLACK)]


def _street_name(rng: np.random.Generator) -> Plate:
    ground, ink = (BLUE, WHITE) if rng.uniform() < 0.6 else (WHITE, BLACK)
    return [Layer(_oblong(0.9, 0.2), ink), Layer(_oblong(0.88, 0.18), ground), *_lines(rng, 0.8, [0.0], 0.1, ink)]


def _parking(rng: np.random.Generator) -> Plate:
    return [Layer(_oblong(0.6, 0.6), WHITE), Layer(_oblong(0.57, 0.57), BLUE), *_written("P", 0.17, 0.08, WHITE)]


def _cycle_path(rng: np.random.Generator) -> Plate:
    plate = [Layer(_disc(0.3), WHITE), Layer(_disc(0.285), BLUE)]
    for side in (-0.12, 0.12):
        plate += [Layer(_ngon(12, 0.09, 0, (side, -0.06)), WHITE), Layer(_ngon(12, 0.065, 0, (side, -0.06)), BLUE)]
    frame = [
        ((-0.12, -0.06), (-0.04, 0.07)),
        ((-0.04, 0.07), (0.09, 0.07)),
        ((0.12, -0.06), (0.08, 0.12)),
        ((0.0, -0.06), (0.09, 0.07)),
    ]
    return [*plate, *(Layer(_bar(*ends, 0.022), WHITE) for ends in frame)]


def _keep_right(rng: np.random.Generator) -> Plate:
    return [Layer(_disc(0.3), WHITE), Layer(_disc(0.285), BLUE), *_arrow(0.2, -np.pi / 4, WHITE)]


def _bus_stop(rng: np.random.Generator) -> Plate:
    plate = [Layer(_disc(0.22), (0.02, 0.4, 0.16)), Layer(_disc(0.2), YELLOW)]
    return [*plate, *_written("H", 0.1, 0.05, (0.02, 0.4, 0.16))]


SIGNS: dict[str, Callable[[np.random.Generator], Plate]] = {
    "speed limit": _speed_limit,
    "give way": _give_way,
    "priority road": _priority,
    "stop": _stop,
    "warning": _warning,
    "no parking": _no_parking,
    "no entry": _no_entry,
    "one way": _one_way,
    "crossing": _crossing,
    "parking": _parking,
    "cycle path": _cycle_path,
    "keep right": _keep_right,
    "direction": _direction,
    "town name": _town_name,
    "street name": _street_name,
    "bus stop": _bus_stop,
}
_OFTEN = {
    "speed limit": 3.0,
    "no parking": 4.0,
    "priority road": 2.0,
    "parking": 2.0,
    "stop": 0.4,
    "town name": 0.2,
    "bus stop": 0.3,
}
_HIGH = {"street name": 0.25, "one way": 0.2, "town name": -0.1, "keep right": -1.2}


def sign(rng: np.random.Generator, name: str | None = None) -> Mesh:
    """One of SIGNS on its post, some with a small plate below."""
    names = list(SIGNS)
    often = np.array([_OFTEN.get(each, 1.0) for each in names])
    name = name or names[int(rng.choice(len(names), p=often / often.sum()))]
    layers = SIGNS[name](rng)
    tall = float(np.ptp(layers[0].outline[:, 1]))
    middle = rng.uniform(2.05, 2.35) + _HIGH.get(name, 0.0) + tall / 2
    parts = [_plate(layers).placed((0.045, 0.0, middle))]
    top = middle + tall / 2 + 0.03
    if name == "street name":
        parts.append(_plate(SIGNS[name](rng)).placed((0.0, 0.045, middle + 0.22), np.pi / 2))
        top += 0.22
    elif rng.uniform() < 0.25 and name not in ("town name", "direction", "keep right", "bus stop"):
        small = [
            Layer(_oblong(0.42, 0.23), BLACK),
            Layer(_oblong(0.4, 0.21), WHITE),
            *_lines(rng, 0.32, [0.04, -0.04], 0.06, BLACK),
        ]
        parts.append(_plate(small).placed((0.045, 0.0, middle - tall / 2 - 0.14)))
    if name == "town name":
        return merged([*parts, *(post(top, 0.03).placed((0.0, side, 0.0)) for side in (-0.45, 0.45))])
    return merged([*parts, post(top, 0.03)])


def street_sign(name: str) -> Mesh:
    """A sign without random variation."""
    return sign(np.random.default_rng(0), name)


def post(height: float, radius: float) -> Mesh:
    """A grey post."""
    return tube(np.array([(0, 0, -0.2), (0, 0, height)]), radius, "metal", "pole", sides=8, tint=(0.9, 0.9, 0.9))


def _plate(layers: Plate) -> Mesh:
    """A plate in the plane x = 0 around the origin: its layers, each in front of the last, and its back."""
    parts = []
    for i, (outline, tint) in enumerate(layers):
        # Strokes of one colour lie side by side; only the first few layers need an offset.
        parts.append(_flat(outline, RAISED * min(i, 3), "sign", tint))
    parts.append(_flat(layers[0].outline[::-1], -0.012, "sign-back", (1.0, 1.0, 1.0)))
    return merged(parts)


def _flat(outline: np.ndarray, x: float, material: str, tint: Tint) -> Mesh:
    points = np.column_stack([np.full(len(outline), x), outline])
    fan = np.array([(0, i, i + 1) for i in range(1, len(outline) - 1)])
    return mesh(points, fan, material, "traffic-sign", tint=tint)
