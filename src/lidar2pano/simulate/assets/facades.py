"""Facades: walls with openings, windows and doors, steps, canopies, balconies, awnings and shop signs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from lidar2pano.simulate.scene.mesh import Mesh, Tint, mesh, projected_uv
from lidar2pano.simulate.scene.surfaces import MATERIAL_IDS, OBJECT_TYPE_IDS

Span = tuple[float, float]
PLAIN: Tint = (1.0, 1.0, 1.0)
DEEP = -0.6  # where walls begin, metres: the ground may fall away along a house
PANE_TINTS: tuple[Tint, ...] = (
    PLAIN,
    PLAIN,
    PLAIN,
    (1.6, 1.6, 1.6),
    (6.0, 5.5, 4.8),
    (9.0, 8.0, 7.0),
)  # the last: curtains


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
    "f": (2, 3, 7, 6),
    "k": (1, 0, 4, 5),
    "l": (0, 2, 6, 4),
    "r": (3, 1, 5, 7),
    "t": (6, 7, 5, 4),
    "u": (0, 1, 3, 2),
}
_ORDER = np.array(list(_FACES.values()))
_CORNERS = np.array([(a, o, u) for u in (0, 1) for o in (0, 1) for a in (0, 1)])
_WAYS = np.array([(0, 1, 0), (0, -1, 0), (-1, 0, 0), (1, 0, 0), (0, 0, 1), (0, 0, -1)], dtype=float)
_CUT = ("railing", "pickets")  # their uv runs 0..1 over the board's height


class Boards:
    """Boards that become one mesh of one object type."""

    def __init__(self, object_type: str = "building") -> None:
        self.object_type = object_type
        self._rows: list[tuple[float, ...]] = []
        self._finish: list[tuple[float, ...]] = []
        self._faces: list[str] = []

    def add(  # noqa: PLR0913 position, size and finish
        self, wall: Wall, along: Span, out: Span, up: Span, material: str, tint: Tint = PLAIN, faces: str = "flrtu"
    ) -> None:
        """A board; `faces` of it are built: front, k (back), left, right, top, under."""
        self._rows.append((*wall.left, *wall.right, *wall.out, *along, *out, *up))
        self._finish.append((MATERIAL_IDS[material], *tint))
        self._faces.append(faces)

    def mesh(self) -> Mesh:
        """All boards."""
        rows, finish = np.array(self._rows).reshape(-1, 12), np.array(self._finish).reshape(-1, 4)
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
        start = 4 * np.arange(len(board))[:, None]
        return Mesh(
            vertices=points.reshape(-1, 3).astype(np.float32),
            normals=np.repeat(normals, 4, axis=0).astype(np.float32),
            uv=uv.reshape(-1, 2).astype(np.float32),
            faces=np.concatenate([start + (0, 1, 2), start + (0, 2, 3)], axis=1).reshape(-1, 3).astype(np.int32),
            material=np.repeat(finish[board, 0], 2).astype(np.uint8),
            object_type=np.full(2 * len(board), OBJECT_TYPE_IDS[self.object_type], dtype=np.uint8),
            tint=np.repeat(finish[board, 1:], 2, axis=0).astype(np.float32),
        )


class Opening(NamedTuple):
    """An opening in a wall: centre and width along it, lower and upper edge, and its type."""

    middle: float
    width: float
    low: float
    high: float
    what: str = "window"  # or door, glass-door, shop, gate

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


def wall_with_openings(  # noqa: PLR0913 outline, openings and finish
    wall: Wall,
    low: float,
    top: Callable[[np.ndarray], np.ndarray],
    bends: Sequence[float],
    openings: Sequence[Opening],
    material: str,
    tint: Tint,
) -> Mesh:
    """The face of a wall with holes, from `low` to `top`: heights at places `along`, straight between the `bends`."""
    cuts = sorted({0.0, wall.length, *bends, *(edge for hole in openings for edge in hole.along)})
    crown = top(np.array(cuts))
    quads: list[tuple[Span, Span, Span, Span]] = []
    for left, right, high_left, high_right in zip(cuts[:-1], cuts[1:], crown[:-1], crown[1:], strict=True):
        middle, foot = (left + right) / 2, low
        for hole in sorted(
            (hole for hole in openings if abs(hole.middle - middle) < hole.width / 2), key=lambda h: h.low
        ):
            if hole.low > foot:
                quads.append(((left, foot), (right, foot), (right, hole.low), (left, hole.low)))
            foot = hole.high
        quads.append(((left, foot), (right, foot), (right, high_right), (left, high_left)))
    corner = np.array(quads).reshape(-1, 2)
    points = wall.at(corner[:, 0], 0.0, corner[:, 1])
    start = 4 * np.arange(len(quads))[:, None]
    faces = np.concatenate([start + (0, 1, 2), start + (0, 2, 3)], axis=1).reshape(-1, 3)
    normals = np.tile((*wall.out, 0.0), (len(points), 1))
    return mesh(points, faces, material, "building", normals=normals, tint=tint)


def fill_opening(boards: Boards, wall: Wall, hole: Opening, style: WindowStyle, rng: np.random.Generator) -> None:
    """Fill an opening with a window, door or gate."""
    _reveal(boards, wall, hole, style)
    if hole.what == "gate":
        boards.add(wall, hole.along, (-style.deep, -style.deep + 0.03), hole.up, "shutter", style.door, "f")
    elif hole.what == "door":
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
    shop = hole.what == "shop"
    sashes = max(round(hole.width / 1.8), 1) if shop else 1 if hole.width < 0.75 else style.sashes
    sashes += int(not shop and hole.width > 1.7)
    bar = 0.05 if shop else 0.07
    tint = (1.3, 1.3, 1.3) if shop else PANE_TINTS[int(rng.integers(len(PANE_TINTS)))]
    levels = [hole.low + bar, hole.high - bar]
    if style.cross and not shop and hole.high - hole.low > 1.0:
        split = hole.low + 0.68 * (hole.high - hole.low)
        levels = [levels[0], split - 0.03, split + 0.03, levels[1]]
    step = (hole.width - bar) / sashes
    for i in range(sashes):
        side = (left + bar + i * step, left + (i + 1) * step)
        for low, high in zip(levels[::2], levels[1::2], strict=True):
            boards.add(wall, side, (back, back + 0.012), (low, high), "pane", tint, "f")
    if not shop and hole.what == "window":
        boards.add(
            wall, (left - 0.06, right + 0.06), (back, 0.05), (hole.low - 0.03, hole.low + 0.015), "stone", style.sill
        )
    if style.shutters == "roller" and not shop:
        down = hole.high - (hole.high - hole.low) * rng.choice(
            (0.0, 0.0, 0.1, 0.25, 0.5, 1.0), p=(0.3, 0.2, 0.2, 0.15, 0.1, 0.05)
        )
        boards.add(wall, hole.along, (back, back + 0.035), (down - 0.06, hole.high), "shutter", style.shutter, "fu")
    elif style.shutters == "swing" and hole.what == "window" and hole.width < 1.8:
        wide = hole.width / 2
        for foot in (left - wide - 0.02, right + 0.02):
            if not 0.0 < foot < wall.length - wide:
                continue
            boards.add(wall, (foot, foot + wide), (0.015, 0.05), hole.up, "shutter", style.shutter)


def _door(boards: Boards, wall: Wall, hole: Opening, style: WindowStyle, rng: np.random.Generator) -> None:
    (left, right), back = hole.along, -style.deep
    boards.add(wall, hole.along, (back, back), hole.up, "frame", style.frame, "f")
    boards.add(wall, (left + 0.06, right - 0.06), (back, back + 0.03), (hole.low, hole.high - 0.06), "door", style.door)
    glass, middle = rng.integers(3), hole.middle
    if glass == 0:
        boards.add(
            wall,
            (middle - 0.14, middle + 0.14),
            (back, back + 0.04),
            (hole.low + 0.5, hole.high - 0.3),
            "pane",
            PLAIN,
            "f",
        )
    elif glass == 1:
        boards.add(
            wall, (left + 0.2, right - 0.2), (back, back + 0.04), (hole.low + 1.2, hole.high - 0.25), "pane", PLAIN, "f"
        )
    boards.add(wall, (right - 0.2, right - 0.16), (back, back + 0.08), (hole.low + 0.95, hole.low + 1.2), "metal")


def rows(
    wall: Wall, middles: Sequence[float], low: float, size: tuple[float, float], what: str = "window"
) -> list[Opening]:
    """Openings of one size (width, height) side by side; without those too close to the ends of the wall."""
    width, height = size
    ends = (width / 2 + 0.3, wall.length - width / 2 - 0.3)
    return [Opening(middle, width, low, low + height, what) for middle in middles if ends[0] <= middle <= ends[1]]


SIGNS: tuple[tuple[Tint, Tint], ...] = (  # ground and ink of boards over shops
    ((1.6, 0.15, 0.12), (2.2, 2.2, 2.2)), ((0.15, 0.3, 1.2), (2.2, 2.2, 2.2)), ((2.1, 2.1, 2.0), (0.9, 0.1, 0.1)),
    ((2.1, 1.6, 0.15), (0.1, 0.1, 0.1)), ((0.15, 0.15, 0.16), (2.0, 1.9, 1.5)), ((0.2, 0.8, 0.3), (2.1, 2.1, 2.0)),
    ((2.0, 1.9, 1.6), (0.1, 0.25, 0.15)),
)  # fmt: skip


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


def balcony(boards: Boards, wall: Wall, along: Span, floor: float, out: float, finish: tuple[str, Tint]) -> None:
    """A slab at height `floor` that stands `out` from the wall, with a parapet of material and tint `finish`."""
    material, tint = finish
    boards.add(wall, along, (0.0, out), (floor - 0.18, floor), "concrete", (1.2, 1.2, 1.2))
    up, (left, right) = (floor + 0.02, floor + 0.98), along
    faces = "fk"
    boards.add(wall, along, (out - 0.06, out - 0.02), up, material, tint, faces)
    boards.add(wall, (left + 0.02, left + 0.06), (0.0, out - 0.02), up, material, tint, "lr")
    boards.add(wall, (right - 0.06, right - 0.02), (0.0, out - 0.02), up, material, tint, "lr")
    boards.add(
        wall, (left, right), (out - 0.08, out), (floor + 0.96, floor + 1.02), "dark-metal", (2.0, 2.0, 2.0), "fktu"
    )


def awning(wall: Wall, along: Span, up: float, out: float, tint: Tint) -> Mesh:
    """A cloth that slopes down from the wall over a shop's window, with a short fall at its edge."""
    left, right = along
    places = [(left, 0.05, up), (right, 0.05, up), (right, out, up - 0.55), (left, out, up - 0.55)]
    places += [(left, out + 0.01, up - 0.8), (right, out + 0.01, up - 0.8)]
    corner = np.array(places)
    points = wall.at(corner[:, 0], corner[:, 1], corner[:, 2])
    return mesh(points, np.array([(3, 2, 1), (3, 1, 0), (4, 5, 2), (4, 2, 3)]), "tarpaulin", "building", tint=tint)


def shop_sign(rng: np.random.Generator, boards: Boards, wall: Wall, along: Span, low: float) -> None:
    """A sign board with strokes of letters."""
    ground, ink = SIGNS[int(rng.integers(len(SIGNS)))]
    high = low + 0.55
    boards.add(wall, along, (0.0, 0.08), (low, high), "plastic", ground)
    letters = int(min((along[1] - along[0] - 0.6) / 0.35, 9))
    start = (along[0] + along[1] - 0.35 * letters) / 2
    for i in range(letters):
        left = start + 0.35 * i
        boards.add(wall, (left, left + 0.08), (0.08, 0.1), (low + 0.12, high - 0.12), "plastic", ink, "f")
        cross = high - rng.choice((0.2, 0.3, 0.42))
        boards.add(wall, (left, left + 0.25), (0.08, 0.1), (cross, cross + 0.07), "plastic", ink, "f")
