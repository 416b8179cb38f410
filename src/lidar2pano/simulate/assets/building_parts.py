"""Parts of buildings: walls with windows and doors, balconies and canopies, plinths, roofs and chimneys; metres."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from lidar2pano.simulate.scene.mesh import (
    PLAIN,
    Mesh,
    Tint,
    box,
    merged,
    mesh,
    polygons,
    projected_uv,
    quadrilaterals,
    tube,
)
from lidar2pano.simulate.scene.random_streams import pick
from lidar2pano.simulate.scene.surfaces import MATERIAL_IDS

Span = tuple[float, float]
Finish = tuple[str, Tint]
"""Material and tint."""
Height = Callable[[np.ndarray], np.ndarray]
"""Height (N,) of a wall at places (N,) along it."""
DEEP = -0.6  # where walls begin, metres: the ground may fall away along a house
PANE_TINTS: tuple[Tint, ...] = (  # the last: curtains
    PLAIN, PLAIN, PLAIN, (1.6, 1.6, 1.6), (6.0, 5.5, 4.8), (9.0, 8.0, 7.0),
)  # fmt: skip
SIGNS: tuple[tuple[Tint, Tint], ...] = (  # ground and ink of boards over shops
    ((1.6, 0.15, 0.12), (2.2, 2.2, 2.2)), ((0.15, 0.3, 1.2), (2.2, 2.2, 2.2)), ((2.1, 2.1, 2.0), (0.9, 0.1, 0.1)),
    ((2.1, 1.6, 0.15), (0.1, 0.1, 0.1)), ((0.15, 0.15, 0.16), (2.0, 1.9, 1.5)), ((0.2, 0.8, 0.3), (2.1, 2.1, 2.0)),
    ((2.0, 1.9, 1.6), (0.1, 0.25, 0.15)),
)  # fmt: skip
THICK = 0.2  # of a roof's slab, metres upwards
PLASTERS: tuple[Tint, ...] = (
    (1.14, 1.16, 1.24), (1.14, 1.16, 1.24), (1.1, 1.08, 1.02), (1.14, 1.04, 0.86), (1.12, 0.98, 0.66),
    (0.98, 0.78, 0.5), (1.08, 0.84, 0.7), (0.82, 0.84, 0.9), (0.86, 0.94, 0.78), (0.6, 0.6, 0.62), (0.9, 0.66, 0.52),
    (0.95, 0.92, 0.86),
)  # fmt: skip
SHUTTERS: tuple[Tint, ...] = (
    (0.3, 0.5, 0.3), (0.55, 0.3, 0.15), (0.7, 0.25, 0.2), (1.5, 1.5, 1.5), (0.35, 0.45, 0.6), (0.9, 0.85, 0.75),
)  # fmt: skip
DOORS: tuple[Tint, ...] = (
    PLAIN, (0.7, 0.45, 0.25), (1.9, 2.1, 2.5), (0.4, 0.6, 0.6), (0.9, 0.35, 0.3), (0.5, 0.55, 0.65),
)  # fmt: skip
COVERS: tuple[Finish, ...] = (
    ("tiles", PLAIN), ("tiles", (1.15, 1.1, 1.0)), ("tiles", (0.8, 0.8, 0.85)), ("tiles", (0.6, 0.75, 0.9)),
    ("slate", PLAIN), ("slate", (1.5, 1.4, 1.3)),
)  # fmt: skip


class Wall(NamedTuple):
    """Left end of the base (x, y), unit vectors to the right and outwards, and the length in metres."""

    left: tuple[float, float]
    right: tuple[float, float]
    out: tuple[float, float]
    length: float

    def at(self, along: np.ndarray, out: np.ndarray | float, up: np.ndarray) -> np.ndarray:
        """Points (N, 3) of coordinates (N,) in the wall frame."""
        x = self.left[0] + along * self.right[0] + out * self.out[0]
        y = self.left[1] + along * self.right[1] + out * self.out[1]
        return np.stack(np.broadcast_arrays(x, y, up), axis=-1)


def four_walls(width: float, depth: float, middle: tuple[float, float] = (0.0, 0.0)) -> dict[str, Wall]:
    """The walls of a house of `width` (y) times `depth` (x): front (towards +x), back, left (+y) and right."""
    x, y, (a, b) = depth / 2, width / 2, middle
    return {
        "front": Wall((a + x, b - y), (0.0, 1.0), (1.0, 0.0), width),
        "left": Wall((a + x, b + y), (-1.0, 0.0), (0.0, 1.0), depth),
        "back": Wall((a - x, b + y), (0.0, -1.0), (-1.0, 0.0), width),
        "right": Wall((a - x, b - y), (1.0, 0.0), (0.0, -1.0), depth),
    }


_FACES = {  # corners are numbered along + 2 out + 4 up
    "f": (2, 3, 7, 6), "k": (1, 0, 4, 5), "l": (0, 2, 6, 4), "r": (3, 1, 5, 7), "t": (6, 7, 5, 4), "u": (0, 1, 3, 2),
}  # fmt: skip
_ORDER = np.array(list(_FACES.values()))
_CORNERS = np.array([(a, o, u) for u in (0, 1) for o in (0, 1) for a in (0, 1)])
_WAYS = np.array([(0, 1, 0), (0, -1, 0), (-1, 0, 0), (1, 0, 0), (0, 0, 1), (0, 0, -1)], dtype=float)
_CUT = ("railing", "pickets")  # their uv runs 0..1 over the board's height


class Boards:
    """The boards of one mesh."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, ...]] = []  # frame of the wall, extents, material and tint
        self._faces: list[str] = []

    def add(  # noqa: PLR0913 position, size and finish
        self, wall: Wall, along: Span, out: Span, up: Span, material: str, tint: Tint = PLAIN, faces: str = "flrtu"
    ) -> None:
        """A board; `faces` of it are built: front, k (back), left, right, top, under."""
        self._rows.append((*wall.left, *wall.right, *wall.out, *along, *out, *up, MATERIAL_IDS[material], *tint))
        self._faces.append(faces)

    def mesh(self) -> Mesh:
        """All boards."""
        rows, finish = np.hsplit(np.array(self._rows).reshape(-1, 16), [12])
        board, face = np.nonzero(np.array([[name in faces for name in _FACES] for faces in self._faces]))
        low, size = rows[:, 6::2], rows[:, 7::2] - rows[:, 6::2]
        place = low[board, None] + _CORNERS[_ORDER[face]] * size[board, None]
        frame = np.zeros((len(rows), 3, 3))
        frame[:, 0, :2], frame[:, 1, :2], frame[:, 2, 2] = rows[:, 2:4], rows[:, 4:6], 1.0
        points = place @ frame[board]
        points[..., :2] += rows[board, None, :2]
        normals = np.einsum("bi,bij->bj", _WAYS[face], frame[board])
        uv = projected_uv(points.reshape(-1, 3), np.repeat(normals, 4, axis=0)).reshape(-1, 4, 2)
        cut = np.isin(finish[board, 0], [MATERIAL_IDS[name] for name in _CUT])
        uv[cut, :, 1] = (points[cut, :, 2] - low[board][cut, None, 2]) / size[board][cut, None, 2]
        flat = np.repeat(normals, 4, axis=0)
        boards = quadrilaterals(points.reshape(-1, 3), "plaster", normals=flat, uv=uv.reshape(-1, 2))
        material = np.repeat(finish[board, 0], 2).astype(np.uint8)
        return replace(boards, material=material, tint=np.repeat(finish[board, 1:], 2, axis=0).astype(np.float32))


class Opening(NamedTuple):
    """An opening in a wall: centre and width along it, lower and upper edge, and its type."""

    middle: float
    width: float
    low: float
    high: float
    kind: str = "window"  # or door, glass-door, shop, gate

    @property
    def along(self) -> Span:
        """Its extent along the wall."""
        return self.middle - self.width / 2, self.middle + self.width / 2

    @property
    def up(self) -> Span:
        """Its extent upwards."""
        return self.low, self.high


class WindowStyle(NamedTuple):
    """The style of the windows and doors of one building."""

    frame: Tint = PLAIN
    sashes: int = 2
    cross: bool = False  # a bar across the upper third
    shutters: str = "none"  # or swing, roller
    shutter: Tint = PLAIN
    surround: str = ""  # material of a border around the openings
    surround_tint: Tint = PLAIN
    reveal: Tint = PLAIN
    sill: Tint = (0.9, 0.9, 0.9)
    door: Tint = PLAIN
    deep: float = 0.12  # how far frames stand behind the wall


def wall_with_openings(
    wall: Wall, low: float, top: Height, bends: Sequence[float], openings: Sequence[Opening], finish: Finish
) -> Mesh:
    """The face of a wall with holes, from `low` to `top`: heights at places `along`, straight between the `bends`."""
    cuts = sorted({0.0, wall.length, *bends, *(edge for hole in openings for edge in hole.along)})
    crown = top(np.array(cuts))
    quads: list[tuple[Span, Span, Span, Span]] = []
    for left, right, high_left, high_right in zip(cuts[:-1], cuts[1:], crown[:-1], crown[1:], strict=True):
        middle, foot = (left + right) / 2, low
        column = (hole for hole in openings if abs(hole.middle - middle) < hole.width / 2)
        for hole in sorted(column, key=lambda hole: hole.low):
            if hole.low > foot:
                quads.append(((left, foot), (right, foot), (right, hole.low), (left, hole.low)))
            foot = hole.high
        quads.append(((left, foot), (right, foot), (right, high_right), (left, high_left)))
    corner = np.array(quads).reshape(-1, 2)
    points = wall.at(corner[:, 0], 0.0, corner[:, 1])
    return quadrilaterals(points, *finish, normals=np.tile((*wall.out, 0.0), (len(points), 1)))


def fill_opening(boards: Boards, wall: Wall, hole: Opening, style: WindowStyle, rng: np.random.Generator) -> None:
    """Fill an opening with a window, door or gate."""
    _reveal(boards, wall, hole, style)
    if hole.kind == "gate":
        boards.add(wall, hole.along, (-style.deep, -style.deep + 0.03), hole.up, "shutter", style.door, "f")
    elif hole.kind == "door":
        _door(boards, wall, hole, style, rng)
    else:
        _window(boards, wall, hole, style, rng)


def _reveal(boards: Boards, wall: Wall, hole: Opening, style: WindowStyle) -> None:
    (left, right), out = hole.along, (-style.deep, 0.0)
    boards.add(wall, (left - 0.02, left), out, hole.up, "plaster", style.reveal, "r")
    boards.add(wall, (right, right + 0.02), out, hole.up, "plaster", style.reveal, "l")
    boards.add(wall, hole.along, out, (hole.high, hole.high + 0.02), "plaster", style.reveal, "u")
    boards.add(wall, hole.along, out, (hole.low - 0.02, hole.low), "stone", style.sill, "t")
    if style.surround:
        wide, finish = 0.14, (style.surround, style.surround_tint)
        boards.add(wall, (left - wide, left), (0, 0.03), (hole.low, hole.high), *finish, "fl")
        boards.add(wall, (right, right + wide), (0, 0.03), (hole.low, hole.high), *finish, "fr")
        boards.add(wall, (left - wide, right + wide), (0, 0.05), (hole.high, hole.high + wide + 0.04), *finish)


def _window(boards: Boards, wall: Wall, hole: Opening, style: WindowStyle, rng: np.random.Generator) -> None:
    (left, right), back = hole.along, -style.deep
    boards.add(wall, hole.along, (back, back), hole.up, "frame", style.frame, "f")
    shop = hole.kind == "shop"
    sashes = max(round(hole.width / 1.8), 1) if shop else 1 if hole.width < 0.75 else style.sashes
    sashes += int(not shop and hole.width > 1.7)
    bar = 0.05 if shop else 0.07
    tint = (1.3, 1.3, 1.3) if shop else pick(rng, PANE_TINTS)
    levels = [hole.low + bar, hole.high - bar]
    if style.cross and not shop and hole.high - hole.low > 1.0:
        split = hole.low + 0.68 * (hole.high - hole.low)
        levels = [levels[0], split - 0.03, split + 0.03, levels[1]]
    step = (hole.width - bar) / sashes
    for i in range(sashes):
        side = (left + bar + i * step, left + (i + 1) * step)
        for low, high in zip(levels[::2], levels[1::2], strict=True):
            boards.add(wall, side, (back, back + 0.012), (low, high), "pane", tint, "f")
    if not shop and hole.kind == "window":
        sill = (hole.low - 0.03, hole.low + 0.015)
        boards.add(wall, (left - 0.06, right + 0.06), (back, 0.05), sill, "stone", style.sill)
    if style.shutters == "roller" and not shop:
        closed = rng.choice((0.0, 0.0, 0.1, 0.25, 0.5, 1.0), p=(0.3, 0.2, 0.2, 0.15, 0.1, 0.05))
        down = hole.high - (hole.high - hole.low) * closed
        boards.add(wall, hole.along, (back, back + 0.035), (down - 0.06, hole.high), "shutter", style.shutter, "fu")
    elif style.shutters == "swing" and hole.kind == "window" and hole.width < 1.8:
        wide = hole.width / 2
        for foot in (left - wide - 0.02, right + 0.02):
            if 0.0 < foot < wall.length - wide:
                boards.add(wall, (foot, foot + wide), (0.015, 0.05), hole.up, "shutter", style.shutter)


def _door(boards: Boards, wall: Wall, hole: Opening, style: WindowStyle, rng: np.random.Generator) -> None:
    (left, right), back = hole.along, -style.deep
    boards.add(wall, hole.along, (back, back), hole.up, "frame", style.frame, "f")
    boards.add(wall, (left + 0.06, right - 0.06), (back, back + 0.03), (hole.low, hole.high - 0.06), "door", style.door)
    narrow = ((hole.middle - 0.14, hole.middle + 0.14), (hole.low + 0.5, hole.high - 0.3))
    wide = ((left + 0.2, right - 0.2), (hole.low + 1.2, hole.high - 0.25))
    if pane := pick(rng, (narrow, wide, None)):
        boards.add(wall, pane[0], (back, back + 0.04), pane[1], "pane", PLAIN, "f")
    boards.add(wall, (right - 0.2, right - 0.16), (back, back + 0.08), (hole.low + 0.95, hole.low + 1.2), "metal")


def rows(wall: Wall, middles: Sequence[float], low: float, size: tuple[float, float]) -> list[Opening]:
    """Windows of one size (width, height) side by side; without those too close to the ends of the wall."""
    width, height = size
    ends = (width / 2 + 0.3, wall.length - width / 2 - 0.3)
    return [Opening(middle, width, low, low + height) for middle in middles if ends[0] <= middle <= ends[1]]


def steps(boards: Boards, wall: Wall, hole: Opening) -> None:
    """Steps from the ground to a door's sill."""
    count = max(round(hole.low / 0.17), 1)
    for i in range(count):
        out, top = 0.28 * (count - i) + 0.55, hole.low * (i + 1) / count
        boards.add(wall, (hole.along[0] - 0.2, hole.along[1] + 0.2), (0.0, out), (DEEP, top), "stone", PLAIN, "flrt")


def canopy(boards: Boards, wall: Wall, hole: Opening, tint: Tint) -> None:
    """A small roof over a door."""
    up = (hole.high + 0.15, hole.high + 0.25)
    boards.add(wall, (hole.along[0] - 0.35, hole.along[1] + 0.35), (0.0, 1.0), up, "wood", tint)


def balcony(boards: Boards, wall: Wall, along: Span, floor: float, out: float, finish: Finish) -> None:
    """A slab at height `floor`, `out` metres deep, with a parapet of material and tint `finish`."""
    boards.add(wall, along, (0.0, out), (floor - 0.18, floor), "concrete", (1.2, 1.2, 1.2))
    up, (left, right), rail = (floor + 0.02, floor + 0.98), along, (floor + 0.96, floor + 1.02)
    boards.add(wall, along, (out - 0.06, out - 0.02), up, *finish, "fk")
    for side in ((left + 0.02, left + 0.06), (right - 0.06, right - 0.02)):
        boards.add(wall, side, (0.0, out - 0.02), up, *finish, "lr")
    boards.add(wall, along, (out - 0.08, out), rail, "dark-metal", (2.0, 2.0, 2.0), "fktu")


def awning(wall: Wall, along: Span, up: float, out: float, tint: Tint) -> Mesh:
    """A cloth sloping down from the wall over a shop's window, with a short fall at its edge."""
    left, right = along
    places = [(left, 0.05, up), (right, 0.05, up), (right, out, up - 0.55), (left, out, up - 0.55)]
    places += [(left, out + 0.01, up - 0.8), (right, out + 0.01, up - 0.8)]
    return polygons(wall.at(*np.array(places).T), [(3, 2, 1, 0), (4, 5, 2, 3)], "tarpaulin", tint)


def shop_sign(rng: np.random.Generator, boards: Boards, wall: Wall, along: Span, low: float) -> None:
    """A sign board with strokes of letters."""
    ground, ink = pick(rng, SIGNS)
    high = low + 0.55
    boards.add(wall, along, (0.0, 0.08), (low, high), "plastic", ground)
    letters = int(min((along[1] - along[0] - 0.6) / 0.35, 9))
    start = (along[0] + along[1] - 0.35 * letters) / 2
    for i in range(letters):
        left = start + 0.35 * i
        boards.add(wall, (left, left + 0.08), (0.08, 0.1), (low + 0.12, high - 0.12), "plastic", ink, "f")
        cross = high - rng.choice((0.2, 0.3, 0.42))
        boards.add(wall, (left, left + 0.25), (0.08, 0.1), (cross, cross + 0.07), "plastic", ink, "f")


class Roof(NamedTuple):
    """A pitched roof over a footprint `long` (y, along its ridge) times `span` (x), centred at the origin.

    form      gable, hip or half-hip.
    eaves     height of the walls below it;  slope: metres up for each metre inwards.
    overhang  how far it stands out at the eaves, and at the verges (gables).
    """

    form: str
    long: float
    span: float
    eaves: float
    slope: float
    overhang: tuple[float, float]
    finish: Finish

    @property
    def ridge(self) -> float:
        """Height of its underside at the ridge."""
        return self.eaves + self.slope * self.span / 2

    @property
    def cut(self) -> float:
        """Height at which a half-hip begins; the ridge for gables, the eaves for hips."""
        share = {"gable": 1.0, "hip": 0.0, "half-hip": 0.6}[self.form]
        return self.eaves + share * (self.ridge - self.eaves)

    def gable(self, wall_length: float) -> tuple[Height, list[float]]:
        """Height of the wall under a gable as a function of the position along it, and the positions of its kinks."""
        half = wall_length / 2
        shoulder = (self.cut - self.eaves) / self.slope
        bends = [half] if self.form == "gable" else [shoulder, wall_length - shoulder]

        def top(along: np.ndarray) -> np.ndarray:
            return np.minimum(self.eaves + self.slope * np.minimum(along, wall_length - along), self.cut) + 0.04

        return top, bends

    def mesh(self) -> Mesh:
        """The roof with its ridge along y."""
        out, verge = self.overhang
        x, low, high = self.span / 2 + out, self.eaves - self.slope * out, self.ridge
        y = self.long / 2 + (out if self.form == "hip" else verge)
        if self.form == "half-hip":
            inner, end = (high - self.cut) / self.slope, y - 0.8 * (high - self.cut) / self.slope
            points = [
                (x, -y, low), (x, y, low), (inner, y, self.cut), (0, end, high), (0, -end, high), (inner, -y, self.cut),
                (-x, y, low), (-x, -y, low), (-inner, -y, self.cut), (-inner, y, self.cut),
            ]  # fmt: skip
            slopes = [[0, 1, 2, 3, 4, 5], [6, 7, 8, 4, 3, 9], [2, 9, 3], [8, 5, 4]]
            return slabs(np.array(points), slopes, self.finish)
        end = max(y - x, 0.05) if self.form == "hip" else y
        points = [(x, -y, low), (x, y, low), (0, end, high), (0, -end, high), (-x, y, low), (-x, -y, low)]
        slopes = [[0, 1, 2, 3], [4, 5, 3, 2], *([[1, 4, 2], [5, 0, 3]] if self.form == "hip" else [])]
        return slabs(np.array(points), slopes, self.finish)


def slabs(points: np.ndarray, slopes: Sequence[Sequence[int]], finish: Finish) -> Mesh:
    """Slopes (polygons of points (N, 3), counter-clockwise from above) as one slab: covering, underside and edges."""
    parts, edges = [], list[tuple[int, int]]()
    for slope in slopes:
        corner = points[list(slope)]
        along = corner[1] - corner[0]
        along /= np.linalg.norm(along)
        normal = np.cross(along, corner[-1] - corner[0])
        normal /= np.linalg.norm(normal)
        up = np.cross(normal, along)
        uv = np.stack([(corner - corner[0]) @ along, (corner - corner[0]) @ up], axis=1)
        outside, fan = np.tile(normal, (len(corner), 1)), [(0, i, i + 1) for i in range(1, len(slope) - 1)]
        parts.append(mesh(corner + (0, 0, THICK), fan, *finish, normals=outside, uv=uv))
        parts.append(mesh(corner, np.flip(fan, 1), "wood", normals=-outside, uv=uv))
        edges += pairwise([*slope, slope[0]])
    rim = np.array([pair for pair in edges if pair[::-1] not in edges])
    a, b = points[rim[:, 0]], points[rim[:, 1]]
    sides = np.stack([a, b, b + (0, 0, THICK), a + (0, 0, THICK)], axis=1).reshape(-1, 3)
    return merged([*parts, quadrilaterals(sides, "wood", (1.3, 1.25, 1.2))])


def flat_roof(width: float, depth: float, height: float, tint: Tint) -> Mesh:
    """A flat roof with a parapet around it; width along y."""
    boards = Boards()
    for wall in four_walls(width + 0.1, depth + 0.1).values():
        along, cap = (-0.03, wall.length + 0.03), (height + 0.42, height + 0.48)
        boards.add(wall, (0.0, wall.length), (-0.3, 0.0), (height, height + 0.45), "plaster", tint, "fkt")
        boards.add(wall, along, (-0.33, 0.04), cap, "metal", (0.7, 0.7, 0.7), "fktu")
    lid = box((0, 0, height + 0.05), (depth, width, 0.1), "gravel", open_sides=("bottom",))
    return merged([boards.mesh(), lid])


def dormer(roof: Roof, place: float, rise: float, size: tuple[float, float], finish: Finish) -> Mesh:
    """A dormer of `size` (width, height) on the slope towards +x, at y = `place`, its sill `rise` over the eaves.

    `finish`: material and tint of its sides.
    """
    width, height = size
    x, low = roof.span / 2 - rise / roof.slope, roof.eaves + rise + 0.1
    back = min(height + 0.5, roof.ridge - low) / roof.slope
    wall = four_walls(width, back, (x - back / 2, place))["front"]
    cheeks = box((x - back / 2, place, low + height / 2), (back, width, height), *finish)
    boards = Boards()
    boards.add(wall, (0.12, width - 0.12), (0.0, 0.03), (low + 0.2, low + height - 0.1), "frame", faces="flrtu")
    count = max(round(width / 0.75), 1)
    step = (width - 0.31) / count
    for i in range(count):
        side = (0.19 + i * step, 0.12 + (i + 1) * step)
        boards.add(wall, side, (0.0, 0.045), (low + 0.27, low + height - 0.17), "pane", faces="f")
    y, top, out = width / 2 + 0.2, low + height, x + 0.25
    if width >= 2.0:  # one long slope, flatter than the roof
        ends = (
            (out, -y, top - 0.1),
            (out, y, top - 0.1),
            (x - back - 0.3, y, top + 0.4),
            (x - back - 0.3, -y, top + 0.4),
        )
        cover = slabs(np.array(ends) + (0, place, 0), [[0, 1, 2, 3]], roof.finish)
        return merged([cheeks, boards.mesh(), cover])
    peak = top + 0.45 * width
    points = np.array([(end, *ridge) for end in (out, x - back - 1) for ridge in ((-y, top), (0, peak), (y, top))])
    cover = slabs(points + (0, place, 0), [[4, 1, 2, 5], [1, 4, 3, 0]], roof.finish)
    gable = np.array([(x, -width / 2, top), (x, width / 2, top), (x, 0, peak)]) + (0, place, 0)
    return merged([cheeks, boards.mesh(), cover, mesh(gable, [(0, 1, 2)], *finish)])


def skylight(roof: Roof, place: float, rise: float) -> Mesh:
    """A roof window on the slope towards +x: y of its middle, height of its foot over the eaves."""
    lean = np.hypot(1.0, roof.slope)
    inwards, up = np.array([-1.0, 0, roof.slope]) / lean, np.array([roof.slope, 0, 1.0]) / lean
    foot = np.array([roof.span / 2 - rise / roof.slope, place, roof.eaves + rise + THICK])
    parts = []
    for grow, lift, material, light in ((0.0, 0.05, "dark-metal", 2.0), (-0.07, 0.062, "pane", 1.5)):
        wide, long = 0.4 + grow, 0.6 + grow
        sides = [(i * wide, 0.6 + j * long) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        corner = [foot + inwards * run + (0, aside, 0) + up * lift for aside, run in sides]
        parts.append(polygons(corner, [(0, 1, 2, 3)], material, (light, light, light)))
    return merged(parts)


def chimney(rng: np.random.Generator, place: tuple[float, float], foot: float, top: float) -> Mesh:
    """A chimney from under the roof (`foot`) to its top."""
    side, x, y = rng.uniform(0.4, 0.7), *place
    shaft = box((x, y, (foot + top) / 2), (side, side, top - foot), "brick", open_sides=("bottom",))
    cap = box((x, y, top + 0.04), (side + 0.14, side + 0.14, 0.08), "concrete")
    pot = tube([(x, y, top), (x, y, top + 0.3)], 0.1, "tiles", sides=6)
    return merged([shaft, cap, pot])


def gutters(roof: Roof) -> Mesh:
    """Gutters along both eaves, and a pipe down at each."""
    out, _ = roof.overhang
    x, z, y = roof.span / 2 + out + 0.05, roof.eaves - roof.slope * out + 0.1, roof.long / 2
    parts = []
    for side in (-1, 1):
        parts.append(tube([(side * x, -y, z), (side * x, y, z)], 0.07, "metal", sides=6))
        wall, foot = side * (roof.span / 2 + 0.07), side * (y - 0.25)
        course = [(side * x, foot, z), (wall, foot, z - 0.35), (wall, foot, -0.1)]
        parts.append(tube(np.array(course), 0.05, "metal", sides=5, closed=False))
    return merged(parts)


class Shell(NamedTuple):
    """The walls of a building and the style of their openings."""

    walls: dict[str, Wall]
    finish: Finish
    style: WindowStyle
    base: float  # height of the ground floor
    storeys: int
    storey: float  # height of each
    dressed: tuple[str, ...] = ("front", "left", "back", "right")  # walls with borders around their windows

    @property
    def eaves(self) -> float:
        """Height of the walls."""
        return self.base + self.storeys * self.storey

    def sill(self, floor: int) -> float:
        """Height of the window sills of a floor."""
        return self.base + floor * self.storey + 0.9


def window_style(rng: np.random.Generator, shutters: str, wall: Tint) -> WindowStyle:
    """A style of windows; `shutters` as in Style, `wall` the tint of the plaster in the reveals."""
    dark, white = rng.uniform() < 0.2, (1.5, 1.5, 1.5)
    return WindowStyle(
        frame=(0.35, 0.22, 0.14) if dark else (0.35, 0.36, 0.38) if rng.uniform() < 0.15 else PLAIN,
        cross=bool(rng.uniform() < 0.25),
        shutters=shutters,
        shutter=pick(rng, SHUTTERS) if shutters == "swing" else white if rng.uniform() < 0.7 else (0.9, 0.85, 0.75),
        surround=pick(rng, ("stone", "plaster", ""), p=(0.15, 0.2, 0.65)),
        surround_tint=(1.1, 0.85, 0.75) if rng.uniform() < 0.4 else (1.2, 1.2, 1.2),
        reveal=wall,
        sill=(0.9, 0.9, 0.9) if rng.uniform() < 0.6 else (1.5, 1.55, 1.6),
        door=pick(rng, DOORS),
    )


def window_columns(rng: np.random.Generator, length: float, every: float) -> list[float]:
    """Centres of windows along a wall."""
    count = max(round((length - 0.6) / every), 1)
    margin = length / count / 2
    middles = np.linspace(margin, length - margin, count) + rng.uniform(-0.06, 0.06, count) * length / count
    return [float(middle) for middle in middles]


def has_gable(roof: Roof, name: str) -> bool:
    """Return True where a wall ends in a gable; only for roofs with gables at left and right (their ridge along y)."""
    return roof.form != "hip" and name in ("left", "right")


def closed_walls(
    rng: np.random.Generator, boards: Boards, shell: Shell, holes: dict[str, list[Opening]], roof: Roof | None
) -> list[Mesh]:
    """The four walls with their openings filled."""
    parts = []
    for name, wall in shell.walls.items():
        top, bends = flat_top(shell.eaves + 0.04), list[float]()
        if roof is not None and has_gable(roof, name):
            top, bends = roof.gable(wall.length)
        parts.append(wall_with_openings(wall, DEEP, top, bends, holes[name], shell.finish))
        style = shell.style if name in shell.dressed else shell.style._replace(surround="")
        for hole in holes[name]:
            fill_opening(boards, wall, hole, style, rng)
    return parts


def flat_top(height: float) -> Height:
    """The height of a level wall."""
    return lambda along: np.full(len(along), height)


def plinth(boards: Boards, shell: Shell, holes: dict[str, list[Opening]], tint: Tint) -> None:
    """A plinth around the walls, up to the ground floor; interrupted at doors."""
    for name, wall in shell.walls.items():
        edges = [-0.03, wall.length + 0.03]
        for hole in holes[name]:
            if hole.low < shell.base + 0.1:
                edges += [hole.along[0] - 0.02, hole.along[1] + 0.02]
        edges.sort()
        for span in zip(edges[::2], edges[1::2], strict=True):
            boards.add(wall, span, (0.0, 0.03), (DEEP, max(shell.base, 0.3)), "plaster", tint, "flrt")
