"""What stands out from a wall: steps, canopies, balconies, awnings and the signs of shops."""

from __future__ import annotations

import numpy as np

from lidar2pano.simulate.facades import DEEP, PLAIN, Boards, Opening, Span, Tint, Wall
from lidar2pano.simulate.mesh import Mesh, mesh

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


def balcony(boards: Boards, wall: Wall, along: Span, floor: float, out: float, looks: tuple[str, Tint]) -> None:
    """A slab at height `floor` that stands `out` from the wall, with a parapet of material and tint `looks`."""
    material, tint = looks
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
    """A board with the strokes of some letters, over a shop or on a hall."""
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
