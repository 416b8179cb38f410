"""Street furniture: signs, lamps, poles, traffic lights, bins, benches, shelters and cabinets; they face +x."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lidar2pano.simulate.scene.mesh import PLAIN, Mesh, Point, Tint, box, ellipsoid, loft, merged, polygons, tube
from lidar2pano.simulate.scene.random_streams import pick, weighted_choice

WHITE: Tint = (1.1, 1.1, 1.1)
RED: Tint = (0.85, 0.04, 0.05)
BLUE: Tint = (0.02, 0.16, 0.6)
YELLOW: Tint = (1.15, 0.72, 0.04)
BLACK: Tint = (0.03, 0.03, 0.03)
LIME: Tint = (0.02, 0.4, 0.16)
BINS: tuple[tuple[Tint, Tint], ...] = (  # tints of body and lid
    ((0.3, 0.31, 0.32), (0.3, 0.31, 0.32)), ((0.3, 0.31, 0.32), (2.0, 1.5, 0.1)),
    ((0.3, 0.31, 0.32), (0.2, 0.5, 1.4)), ((0.5, 0.35, 0.22), (0.5, 0.35, 0.22)), ((0.25, 0.6, 0.3), (0.25, 0.6, 0.3)),
)  # fmt: skip
TUB = [(0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7), (3, 2, 1, 0)]  # sides of a bin
GREEN: Tint = (1.0, 3.0, 1.8)  # times dark metal: the green of old lamp posts
UNLIT: dict[str, Tint] = {"light-red": (2.5, 0.7, 0.7), "light-yellow": (2.2, 1.6, 0.5), "light-green": (0.5, 1.7, 1.0)}
RAISED = 0.003  # metres from one layer of a plate to the next


class Layer(NamedTuple):
    """A convex polygon (N, 2), counter-clockwise: metres to the right and up from a plate's middle; and its tint."""

    outline: np.ndarray
    tint: Tint


Plate = list[Layer]  # the first layer is the plate's own outline


def _ngon(corners: int, radius: float, turn: float = 0.0, centre: Point = (0.0, 0.0)) -> np.ndarray:
    """A regular polygon, its first corner at `turn` radians from the right."""
    angle = turn + 2 * np.pi * np.arange(corners) / corners
    return radius * np.column_stack([np.cos(angle), np.sin(angle)]) + centre


def _disc(radius: float) -> np.ndarray:
    return _ngon(20, radius)


def _oblong(width: float, height: float, centre: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    return np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (width / 2, height / 2) + centre


def _bar(start: Point, end: Point, thick: float) -> np.ndarray:
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
            ends = (left + a * size, (b - 1) * size), (left + c * size, (d - 1) * size)
            layers.append(Layer(_bar(*ends, thick), tint))
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


def _arrow(size: float, turn: float) -> Plate:
    """A white arrow around the middle, towards `turn` radians from the right."""
    way = size * np.array([np.cos(turn), np.sin(turn)])
    head = _ngon(3, 0.65 * size, turn, 0.2 * way + 0.3 * way)
    return [Layer(_bar(-way, 0.2 * way, 0.35 * size), WHITE), Layer(head, WHITE)]


def _banned(inner: Tint) -> Plate:
    return [Layer(_disc(0.3), RED), Layer(_disc(0.235), inner)]


def _warning(rng: np.random.Generator) -> Plate:
    plate = [Layer(_ngon(3, 0.52, np.pi / 2), RED), Layer(_ngon(3, 0.35, np.pi / 2), WHITE)]
    if rng.uniform() < 0.5:
        return [*plate, Layer(_oblong(0.05, 0.24, (0, 0.02)), BLACK), Layer(_oblong(0.12, 0.04, (0, -0.12)), BLACK)]
    return [*plate, *(Layer(_bar((x, -0.14), (-x, 0.08), 0.05), BLACK) for x in (-0.1, 0.1))]


def _no_parking(rng: np.random.Generator) -> Plate:
    plate = [*_banned(BLUE), Layer(_bar((-0.2, 0.2), (0.2, -0.2), 0.06), RED)]
    return plate if rng.uniform() < 0.6 else [*plate, Layer(_bar((-0.2, -0.2), (0.2, 0.2), 0.06), RED)]


def _crossing(_: np.random.Generator) -> Plate:
    plate = [Layer(_oblong(0.6, 0.6), BLUE), Layer(_ngon(3, 0.3, np.pi / 2, (0, -0.06)), WHITE)]
    plate += [Layer(_oblong(0.3, 0.03, (0, -0.17)), BLACK), Layer(_oblong(0.07, 0.2, (0, -0.01)), BLACK)]
    return [*plate, Layer(_ngon(8, 0.035, 0, (0, 0.12)), BLACK)]


def _direction(rng: np.random.Generator) -> Plate:
    ground = YELLOW if rng.uniform() < 0.7 else WHITE
    pointed = np.array([(-0.6, -0.17), (0.5, -0.17), (0.66, 0), (0.5, 0.17), (-0.6, 0.17)])
    if rng.uniform() < 0.5:
        pointed = (pointed * (-1, 1))[::-1]
    return [Layer(pointed, BLACK), Layer(pointed * (0.97, 0.88), ground), *_lines(rng, 0.9, [0.0], 0.13, BLACK)]


def _town_name(rng: np.random.Generator) -> Plate:
    plate = [Layer(_oblong(1.2, 0.8), BLACK), Layer(_oblong(1.15, 0.75), YELLOW)]
    return [*plate, *_lines(rng, 1.0, [0.12], 0.2, BLACK), *_lines(rng, 0.7, [-0.15, -0.27], 0.08, BLACK)]


def _street_name(rng: np.random.Generator) -> Plate:
    ground, ink = (BLUE, WHITE) if rng.uniform() < 0.6 else (WHITE, BLACK)
    return [Layer(_oblong(0.9, 0.2), ink), Layer(_oblong(0.88, 0.18), ground), *_lines(rng, 0.8, [0.0], 0.1, ink)]


def _cycle_path(_: np.random.Generator) -> Plate:
    plate = [*_MANDATORY]
    for side in (-0.12, 0.12):
        plate += [Layer(_ngon(12, 0.09, 0, (side, -0.06)), WHITE), Layer(_ngon(12, 0.065, 0, (side, -0.06)), BLUE)]
    hub, seat, head = (-0.12, -0.06), (-0.04, 0.07), (0.09, 0.07)
    frame = [(hub, seat), (seat, head), ((0.12, -0.06), (0.08, 0.12)), ((0.0, -0.06), head)]
    return [*plate, *(Layer(_bar(*ends, 0.022), WHITE) for ends in frame)]


_MANDATORY = [Layer(_disc(0.3), WHITE), Layer(_disc(0.285), BLUE)]
_PRIORITY = ((0.42, WHITE), (0.40, BLACK), (0.39, WHITE), (0.28, YELLOW))
SIGNS: dict[str, Callable[[np.random.Generator], Plate]] = {
    "speed limit": lambda rng: [
        *_banned(WHITE), *_written(str(rng.choice(("30", "30", "50", "60", "70", "80"))), 0.11, 0.05, BLACK),
    ],
    "give way": lambda _: [Layer(_ngon(3, 0.52, -np.pi / 2), RED), Layer(_ngon(3, 0.33, -np.pi / 2), WHITE)],
    "priority road": lambda _: [Layer(_ngon(4, radius), tint) for radius, tint in _PRIORITY],
    "stop": lambda _: [
        Layer(_ngon(8, 0.45, np.pi / 8), WHITE), Layer(_ngon(8, 0.42, np.pi / 8), RED),
        *_written("ST0P", 0.1, 0.05, WHITE),
    ],
    "warning": _warning,
    "no parking": _no_parking,
    "no entry": lambda _: [Layer(_disc(0.3), WHITE), Layer(_disc(0.285), RED), Layer(_oblong(0.42, 0.1), WHITE)],
    "one way": lambda rng: [Layer(_oblong(0.8, 0.3), BLUE), *_arrow(0.3, 0 if rng.uniform() < 0.5 else np.pi)],
    "crossing": _crossing,
    "parking": lambda _: [
        Layer(_oblong(0.6, 0.6), WHITE), Layer(_oblong(0.57, 0.57), BLUE), *_written("P", 0.17, 0.08, WHITE),
    ],
    "cycle path": _cycle_path,
    "keep right": lambda _: [*_MANDATORY, *_arrow(0.2, -np.pi / 4)],
    "direction": _direction,
    "town name": _town_name,
    "street name": _street_name,
    "bus stop": lambda _: [Layer(_disc(0.22), LIME), Layer(_disc(0.2), YELLOW), *_written("H", 0.1, 0.05, LIME)],
}  # fmt: skip
_FREQUENCY = {
    "speed limit": 3.0, "no parking": 4.0, "priority road": 2.0, "parking": 2.0, "stop": 0.4, "town name": 0.2,
    "bus stop": 0.3,
}  # fmt: skip
_HIGH = {"street name": 0.25, "one way": 0.2, "town name": -0.1, "keep right": -1.2}


def sign(rng: np.random.Generator, name: str | None = None) -> Mesh:
    """One of SIGNS on its post, some with a small plate below."""
    name = name or weighted_choice(rng, {key: _FREQUENCY.get(key, 1.0) for key in SIGNS})
    layers = SIGNS[name](rng)
    tall = float(np.ptp(layers[0].outline[:, 1]))
    middle = rng.uniform(2.05, 2.35) + _HIGH.get(name, 0.0) + tall / 2
    parts = [_plate(layers).placed((0.045, 0.0, middle))]
    top = middle + tall / 2 + 0.03
    if name == "street name":
        parts.append(_plate(SIGNS[name](rng)).placed((0.0, 0.045, middle + 0.22), np.pi / 2))
        top += 0.22
    elif rng.uniform() < 0.25 and name not in ("town name", "direction", "keep right", "bus stop"):
        small = [Layer(_oblong(0.42, 0.23), BLACK), Layer(_oblong(0.4, 0.21), WHITE)]
        small += _lines(rng, 0.32, [0.04, -0.04], 0.06, BLACK)
        parts.append(_plate(small).placed((0.045, 0.0, middle - tall / 2 - 0.14)))
    post = tube([(0, 0, -0.2), (0, 0, top)], 0.03, "metal", (0.9, 0.9, 0.9))
    posts = [post.placed((0.0, side, 0.0)) for side in (-0.45, 0.45)] if name == "town name" else [post]
    return merged([*parts, *posts], "pole")


def _plate(layers: Plate) -> Mesh:
    """A plate in the plane x = 0 around the origin: its layers, each in front of the last, and its back."""
    # Strokes of one colour lie side by side; only the first few layers need an offset.
    faces = [(outline, RAISED * min(i, 3), "sign", tint) for i, (outline, tint) in enumerate(layers)]
    faces.append((layers[0].outline[::-1], -0.012, "sign-back", PLAIN))
    parts = []
    for outline, x, material, tint in faces:
        points = np.column_stack([np.full(len(outline), x), outline])
        parts.append(polygons(points, [range(len(outline))], material, tint))
    return merged(parts, "traffic-sign")


def street_lamp(rng: np.random.Generator) -> Mesh:
    """A lamp whose arm reaches to +x: a curved mast, a mast with a bracket, or a low post with a lantern."""
    form = str(rng.choice(("curved", "flat", "post", "mushroom"), p=(0.35, 0.3, 0.15, 0.2)))
    if form in ("post", "mushroom"):
        return _low_lamp(rng, form)
    height, reach = rng.uniform(5.5, 9.5), rng.uniform(0.6, 1.8)
    material, tint = ("metal", (0.9, 0.9, 0.9)) if rng.uniform() < 0.7 else ("dark-metal", GREEN)
    parts = [tube([(0, 0, -0.2), (0, 0, 1.1)], 0.085, material, tint)]
    if form == "curved":
        turn = np.linspace(0, 0.5 * np.pi, 6)
        bend = np.column_stack([reach * (1 - np.cos(turn)), 0 * turn, height - 0.8 + 0.8 * np.sin(turn)])
        course = np.concatenate([[(0, 0, 1.0)], bend])
        parts.append(tube(course, [0.075, 0.055, *[0.04] * 5], material, tint))
    else:
        parts.append(tube([(0, 0, 1.0), (0, 0, height)], [0.07, 0.045], material, tint))
        parts.append(tube([(0, 0, height - 0.05), (reach, 0, height + 0.05)], 0.035, material, tint))
    long, wide, flat = rng.uniform(0.5, 0.8), rng.uniform(0.2, 0.3), rng.uniform(0.08, 0.16)
    z = height if form == "curved" else height + 0.05
    parts.append(box((reach + long / 2 - 0.1, 0, z), (long, wide, flat), "plastic", (1.2, 1.2, 1.2)))
    parts.append(box((reach + long / 2 - 0.05, 0, z - flat / 2 - 0.02), (0.7 * long, 0.8 * wide, 0.04), "lamp"))
    return merged(parts, "pole")


def _low_lamp(rng: np.random.Generator, form: str) -> Mesh:
    height = rng.uniform(3.4, 4.6)
    tint = GREEN if rng.uniform() < 0.5 else (1.5, 1.5, 1.6)
    course = [(0, 0, level) for level in (-0.2, 0.8, 0.85, height)]
    parts = [tube(course, [0.09, 0.08, 0.05, 0.04], "dark-metal", tint)]
    if form == "post":
        parts.append(tube([(0, 0, height), (0, 0, height + 0.45)], [0.12, 0.2], "lamp", sides=6))
        parts.append(tube([(0, 0, height + 0.45), (0, 0, height + 0.65)], [0.24, 0.03], "dark-metal", tint, sides=6))
    else:
        parts.append(tube([(0, 0, height - 0.02), (0, 0, height + 0.22)], 0.13, "lamp", sides=10))
        parts.append(tube([(0, 0, height + 0.22), (0, 0, height + 0.32)], [0.42, 0.2], "plastic", sides=12))
    return merged(parts, "pole")


def pole(rng: np.random.Generator) -> Mesh:
    """A pole of wood or concrete for wires, with cross-arms along y and insulators."""
    height, lean = rng.uniform(7.0, 9.5), rng.normal(0, 0.05, 2)
    wooden = rng.uniform() < 0.75
    course = [(0.0, 0.0, -0.3), (float(lean[0]), float(lean[1]), height)]
    finish: tuple[str, Tint] = ("wood", (0.8, 0.8, 0.85)) if wooden else ("concrete", PLAIN)
    parts = [tube(course, [0.14, 0.09] if wooden else [0.2, 0.11], *finish)]
    for i in range(int(rng.integers(1, 3))):
        z = height - 0.35 - 0.7 * i
        parts.append(box((lean[0], lean[1], z), (0.09, 1.5, 0.1), *finish))
        for y in lean[1] + np.array((-0.65, -0.3, 0.3, 0.65)):
            foot = np.array((lean[0], y, z + 0.05))
            parts.append(tube([foot, foot + (0, 0, 0.16)], 0.035, "plastic", (1.6, 1.6, 1.6)))
    return merged(parts, "pole")


def traffic_light(rng: np.random.Generator) -> Mesh:
    """Lights towards +x, on a post; sometimes a second head on an arm over the road, to -y."""
    lit = list(UNLIT)[int(rng.choice(3, p=(0.5, 0.1, 0.4)))]
    arm = bool(rng.uniform() < 0.3)
    height = rng.uniform(5.4, 5.8) if arm else rng.uniform(3.2, 3.6)
    paint: tuple[str, Tint] = ("metal", (0.85, 0.85, 0.85)) if rng.uniform() < 0.6 else ("dark-metal", GREEN)
    parts = [tube([(0, 0, -0.2), (0, 0, height)], 0.1 if arm else 0.06, *paint)]
    parts.append(_head((0.16, 0, 2.65), lit))
    if rng.uniform() < 0.6:
        walk = "light-green" if lit == "light-red" else "light-red"
        parts.append(_head((0, 0.16, 2.4), walk, walkers=True))
    if arm:
        reach = rng.uniform(2.5, 4.5)
        parts.append(tube([(0, 0, height - 0.15), (0, -reach, height + 0.15)], [0.07, 0.045], *paint))
        parts.append(_head((0.14, 0.3 - reach, height + 0.05), lit, board=True))
    return merged(parts, "pole")


def _head(middle: Point, lit: str, *, walkers: bool = False, board: bool = False) -> Mesh:
    """A housing with lamps, red at the top; around `middle`; `lit`: the shining lamp; for `walkers`: small, to +y."""
    size, lamps = (0.8, 2) if walkers else (1.0, 3)
    step, colours = 0.3 * size, list(UNLIT)[:: 4 - lamps]
    parts = [box((0, 0, 0), (0.18, 0.3 * size, step * lamps + 0.04), "dark-metal", (0.7, 0.8, 0.7))]
    if board:
        parts.append(box((-0.04, 0, 0), (0.02, 0.55, step * lamps + 0.3), "dark-metal", (0.6, 0.6, 0.6)))
    for i, colour in enumerate(colours):
        z = step * ((lamps - 1) / 2 - i)
        finish = (colour, PLAIN) if colour == lit else ("light-off", UNLIT[colour])
        parts.append(tube([(0.09, 0, z), (0.1, 0, z)], 0.1 * size, *finish, sides=10))
        turn = np.linspace(-0.1, np.pi + 0.1, 7)
        rim = np.column_stack([np.zeros(7), 0.12 * size * np.cos(turn), z + 0.12 * size * np.sin(turn)])
        parts.append(loft(np.stack([rim + (0.09, 0, 0), rim + (0.26, 0, 0)]), "dark-metal", (0.6, 0.7, 0.6)))  # a hood
    return merged(parts, "traffic-light").placed(middle, np.pi / 2 if walkers else 0.0)


def bollard(rng: np.random.Generator) -> Mesh:
    """A bollard, of metal or stone."""
    height, radius = rng.uniform(0.75, 1.05), rng.uniform(0.05, 0.09)
    if rng.uniform() < 0.25:
        stone = tube([(0, 0, -0.1), (0, 0, 0.45)], [0.2, 0.17], "concrete", sides=10)
        return merged([stone, ellipsoid((0, 0, 0.45), (0.17, 0.17, 0.1), "concrete", detail=6)], "pole")
    tint = pick(rng, ((1.5, 1.5, 1.6), GREEN, (9.0, 1.0, 0.8)))
    shaft = tube([(0, 0, -0.1), (0, 0, height)], radius, "dark-metal", tint)
    band = tube([(0, 0, height - 0.25), (0, 0, height - 0.15)], radius + 0.004, "sign")
    head = ellipsoid((0, 0, height), (radius, radius, 0.5 * radius), "dark-metal", tint, detail=6)
    return merged([shaft, band, head], "pole")


def bin(rng: np.random.Generator) -> Mesh:  # noqa: A001 the builtin is not needed here
    """One to three wheelie bins side by side along y."""
    count = int(rng.choice((1, 2, 3), p=(0.4, 0.35, 0.25)))
    parts = []
    for i in range(count):
        body, lid = pick(rng, BINS)
        large = rng.uniform() < 0.25
        width, deep, high = (0.58, 0.72, 1.0) if large else (0.48, 0.54, 0.93)
        unit = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2
        low, top = unit * (0.78 * deep, 0.8 * width), unit * (deep, width)
        tub = polygons([*((*xy, 0.06) for xy in low), *((*xy, high) for xy in top)], TUB, "plastic", body)
        cover = box((0.02, 0, high + 0.035), (deep + 0.06, width + 0.04, 0.07), "plastic", lid)
        grip = box((-deep / 2 - 0.06, 0, high - 0.02), (0.08, 0.7 * width, 0.04), "plastic", body)
        x, ends = -deep / 2 + 0.08, (-0.45 * width, 0.45 * width - 0.05)
        wheels = [tube([(x, y, 0.1), (x, y + 0.05, 0.1)], 0.1, "rubber") for y in ends]
        foot = box((0.3 * deep, 0, 0.03), (0.08, 0.6 * width, 0.08), "plastic", body)
        place = (float(rng.normal(0, 0.05)), 0.66 * (i - (count - 1) / 2), 0.0)
        parts.append(merged([tub, cover, grip, foot, *wheels]).placed(place, float(rng.normal(0, 0.08))))
    return merged(parts, "other-object")


def bench(rng: np.random.Generator) -> Mesh:
    """A bench towards +x: slats of wood on feet of iron or concrete."""
    length = rng.uniform(1.6, 2.0)
    tint = (1.0, 1.0, 1.0) if rng.uniform() < 0.7 else (0.5, 0.9, 0.7)
    slats = [box((x, 0, 0.45), (0.09, length, 0.035), "wood", tint) for x in (-0.15, -0.04, 0.07, 0.18)]
    backed = bool(rng.uniform() < 0.75)
    if backed:
        slats += [box((-0.27 - 0.03 * i, 0, 0.58 + 0.13 * i), (0.035, length, 0.1), "wood", tint) for i in range(3)]
    feet = []
    for y in (-0.36 * length, 0.36 * length):
        feet.append(box((0.0, y, 0.2), (0.42, 0.07, 0.48), "concrete"))
        if backed:
            feet.append(box((-0.31, y, 0.6), (0.05, 0.06, 0.55), "dark-metal"))
    return merged([*slats, *feet], "other-object")


def bus_stop(rng: np.random.Generator) -> Mesh:
    """A glass shelter along y, open to +x, with a bench, and the stop's sign beside it."""
    length, deep, high = rng.uniform(3.0, 4.5), 1.4, 2.4
    grey: Tint = (2.0, 2.0, 2.1) if rng.uniform() < 0.6 else (1.0, 2.5, 1.6)
    parts = [box((0, 0, high + 0.06), (deep + 0.3, length + 0.2, 0.12), "plastic", (1.2, 1.2, 1.2))]
    corners = [(x * deep / 2, y * length / 2) for x, y in ((-1, -1), (-1, 0), (-1, 1), (1, -1), (1, 1))]
    posts = [box((x, y, high / 2 - 0.05), (0.06, 0.06, high + 0.1), "dark-metal", grey) for x, y in corners]
    parts.append(merged(posts, "pole"))
    glass: Tint = (3.0, 3.4, 3.4)
    parts.append(box((-deep / 2, 0, 1.3), (0.02, length - 0.1, 1.9), "pane", glass))
    parts += [box((0, side * length / 2, 1.3), (deep - 0.1, 0.02, 1.9), "pane", glass) for side in (-1, 1)]
    poster: Tint = (1.6 * rng.uniform(), 1.6 * rng.uniform(), 1.6 * rng.uniform())
    parts.append(box((0.02, length / 2 - 0.04, 1.35), (1.15, 0.06, 1.7), "plastic", poster))
    parts.append(box((-0.4, 0, 0.45), (0.4, 0.6 * length, 0.04), "wood"))
    parts += [box((-0.4, y, 0.2), (0.06, 0.06, 0.5), "dark-metal") for y in (-0.25 * length, 0.25 * length)]
    post = sign(np.random.default_rng(0), "bus stop")
    return merged([*parts, post.placed((0.75, -length / 2 - 0.6, 0.0), np.pi / 2)], "other-object")


def advertising_column(rng: np.random.Generator) -> Mesh:
    """A round column with posters."""
    radius, high = rng.uniform(0.55, 0.7), rng.uniform(2.5, 3.2)
    parts = [tube([(0, 0, -0.1), (0, 0, high)], radius, "concrete", sides=24)]
    parts.append(tube([(0, 0, -0.1), (0, 0, 0.3)], radius + 0.06, "stone", sides=24))
    parts.append(tube([(0, 0, high), (0, 0, high + 0.12)], radius + 0.08, "metal", sides=24))
    parts.append(ellipsoid((0, 0, high + 0.1), (radius, radius, 0.3), "metal", detail=8))
    for i in range(6):
        for low in (0.4, 0.45 + (high - 0.5) / 2):
            parts.append(_poster(rng, radius, 1.05 * i, low, (high - 0.7) / 2))
    return merged(parts, "other-object")


def _poster(rng: np.random.Generator, radius: float, turn: float, low: float, high: float) -> Mesh:
    angle = np.linspace(turn + 0.05, turn + rng.uniform(0.7, 1.0), 5)
    rim = (radius + 0.012) * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(5)])
    light, hue = rng.uniform(0.3, 1.8), rng.uniform(0.5, 1.3, 3)
    tint: Tint = (light * hue[0], light * hue[1], light * hue[2])
    return loft(np.stack([rim + (0, 0, low + high), rim + (0, 0, low)]), "plastic", tint)


def junction_box(rng: np.random.Generator) -> Mesh:
    """A grey cabinet for telephone or power."""
    width, deep, high = rng.uniform(0.5, 1.6), rng.uniform(0.3, 0.45), rng.uniform(0.85, 1.4)
    light = rng.uniform(0.9, 1.6)
    tint: Tint = (light, light, 0.95 * light) if rng.uniform() < 0.75 else (0.5, 0.7, 0.5)
    parts = [box((0, 0, high / 2), (deep, width, high), "plastic", tint)]
    parts.append(box((0, 0, 0.0), (deep + 0.06, width + 0.06, 0.24), "concrete"))
    parts.append(box((0, 0, high + 0.02), (deep + 0.06, width + 0.06, 0.05), "plastic", tint))
    doors = max(round(width / 0.6), 1)
    for i in range(1, doors):
        y = width * (i / doors - 0.5)
        parts.append(box((deep / 2, y, high / 2 + 0.05), (0.01, 0.015, high - 0.2), "dark-metal"))
    return merged(parts, "other-object")
