"""Planner: a town's list of things while it grows; nothing stands on a road or in another thing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from lidar2pano.simulate.layout.places import QUARTERS, Quarter
from lidar2pano.simulate.layout.roads import Road
from lidar2pano.simulate.layout.town import Stretch, Town
from lidar2pano.simulate.scene.mesh import Mesh
from lidar2pano.simulate.scene.random_streams import stream

COARSE, SHAPES = 0.3, 6  # detail below which plants of one maker share this many shapes
SQUARE = 8.0  # metres: side of the squares by which footprints are found
PLANTS = ("tree", "far tree", "bush")

Maker = Callable[[np.random.Generator, float], Mesh]
"""(its own stream, detail in (0, 1]) -> a mesh that stands on z = 0 and looks along x."""


class Piece(NamedTuple):
    """What can be put somewhere: its maker, name (of its random streams) and footprint's radius in metres.

    raised   on the pavement's level;  square: square to the ground;  counted: it has an instance number.
    """

    make: Maker
    name: str
    radius: float
    raised: bool = True
    square: bool = False
    counted: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Thing:
    """A thing in the world's frame.

    make      its maker;  name, number: of its random stream.
    at        (x, y, z) metres;  yaw radians;  normal: of the ground for things that stand square on it (vehicles).
    radius    of its footprint, metres.
    counted   whether it has an instance number (SemanticKITTI's "things").
    """

    make: Maker
    name: str
    number: int
    at: tuple[float, float, float]
    yaw: float
    radius: float
    normal: tuple[float, float, float] | None = None
    counted: bool = False

    def mesh(self, seed: int, detail: float) -> Mesh:
        """Its triangles, in place; far away a few shapes stand for all plants of one maker."""
        if detail < COARSE and self.name in PLANTS:
            made = _shape(self.make, self.name, self.number % SHAPES, detail)
        else:
            made = self.make(stream(seed, self.name, self.number), detail)
        return made.placed(self.at, self.yaw) if self.normal is None else set_on(made, self.at, self.yaw, self.normal)


@lru_cache(maxsize=256)
def _shape(make: Maker, name: str, number: int, detail: float) -> Mesh:
    return make(stream(0, "far", name, number), detail)


def set_on(mesh: Mesh, at: tuple[float, float, float], yaw: float, normal: tuple[float, float, float]) -> Mesh:
    """A mesh that stands at `at`, looks along `yaw` and is square to the ground's `normal`."""
    up = np.asarray(normal)
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    ahead = ahead - up * (ahead @ up)
    ahead /= np.linalg.norm(ahead)
    return mesh.transformed(np.stack([ahead, np.cross(up, ahead), up], axis=1), at)


@dataclass(slots=True, eq=False)
class Occupied:
    """Footprints that are taken: circles (x, y, radius), by the squares of a grid that they reach into."""

    squares: dict[tuple[int, int], list[tuple[float, float, float]]] = field(
        default_factory=dict[tuple[int, int], list[tuple[float, float, float]]]
    )

    def free(self, x: float, y: float, radius: float) -> bool:
        """Whether a circle overlaps none of those that are taken."""
        return all(
            (a - x) ** 2 + (b - y) ** 2 > (r + radius) ** 2
            for square in _squares(x, y, radius)
            for a, b, r in self.squares.get(square, ())
        )

    def take(self, x: float, y: float, radius: float) -> None:
        """Take a circle."""
        for square in _squares(x, y, radius):
            self.squares.setdefault(square, []).append((x, y, radius))

    def footprint(self, x: float, y: float, yaw: float, size: tuple[float, float]) -> list[tuple[float, float, float]]:
        """Circles that cover a rectangle of `size` (along its x, along its y) but for its corners."""
        deep, wide = size
        radius = min(deep, wide) / 2
        reach = max(deep, wide) / 2 - radius
        steps = np.linspace(-reach, reach, max(int(np.ceil(reach / max(radius, 0.1))), 1) * 2 + 1)
        turn = yaw if deep >= wide else yaw + np.pi / 2
        return [(x + step * np.cos(turn), y + step * np.sin(turn), radius) for step in steps]


def _squares(x: float, y: float, radius: float) -> Iterator[tuple[int, int]]:
    for i in range(int((x - radius) // SQUARE), int((x + radius) // SQUARE) + 1):
        for j in range(int((y - radius) // SQUARE), int((y + radius) // SQUARE) + 1):
            yield i, j


@dataclass(slots=True, eq=False)
class Planner:
    """Things so far, and the footprints that are taken."""

    town: Town
    things: list[Thing] = field(default_factory=list[Thing])
    occupied: Occupied = field(default_factory=Occupied)

    def rng(self, *names: str | int) -> np.random.Generator:
        """A stream of this town's."""
        return stream(self.town.seed, *names)

    def stretches(self) -> list[tuple[int, Road, Stretch, Quarter]]:
        """Every stretch of every road."""
        return [
            (index, self.town.roads[index], stretch, QUARTERS[stretch.quarter])
            for index, row in enumerate(self.town.stretches)
            for stretch in row
        ]

    def stand(self, piece: Piece, xy: np.ndarray, yaw: float) -> None:
        """Add a thing at a place (2,)."""
        z = float(self.town.height(xy, raised=piece.raised))
        self.things.append(
            Thing(
                make=piece.make,
                name=piece.name,
                number=len(self.things),
                at=(float(xy[0]), float(xy[1]), z),
                yaw=yaw,
                radius=piece.radius,
                normal=tuple(self.town.terrain.normal(xy).tolist()) if piece.square else None,
                counted=piece.counted,
            )
        )

    def try_stand(self, piece: Piece, xy: np.ndarray, yaw: float) -> bool:
        """Add a thing where its circle is free, and take the circle."""
        circle = (float(xy[0]), float(xy[1]), piece.radius)
        if not self.occupied.free(*circle):
            return False
        self.occupied.take(*circle)
        self.stand(piece, xy, yaw)
        return True
