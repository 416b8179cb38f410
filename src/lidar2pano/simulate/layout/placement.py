"""Placement of objects in a town, without overlaps, and their meshes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from lidar2pano.simulate.layout.roads import Road
from lidar2pano.simulate.layout.town import LAND_USES, LandUse, Stretch, Town
from lidar2pano.simulate.scene.mesh import Mesh
from lidar2pano.simulate.scene.random_streams import stream

COARSE, SHAPES = 0.3, 6  # below this detail plants of one maker share so many meshes
CELL = 8.0  # metres: cells of the occupancy grid
PLANTS = ("tree", "far tree", "bush")

Maker = Callable[[np.random.Generator, float], Mesh]
"""(random generator, detail in (0, 1]) -> a mesh in the object frame (Mesh)."""
Circle = tuple[float, float, float]
"""x, y and radius, metres."""


class Template(NamedTuple):
    """A sort of object: its maker, name (of its random streams) and radius of its footprint in metres.

    on_sidewalk    stands at the level of the sidewalk, not of the carriageway.
    follows_slope  its z axis is the normal of the ground (vehicles).
    has_instance   it has an instance number (the "things" of SemanticKITTI).
    """

    make: Maker
    name: str
    radius: float
    on_sidewalk: bool = True
    follows_slope: bool = False
    has_instance: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlacedObject:
    """An object in the world frame.

    number  of its random stream.
    position      (x, y, z) metres;  yaw: radians;  normal: of the ground, for objects that follow its slope.
    """

    template: Template
    number: int
    position: tuple[float, float, float]
    yaw: float
    normal: tuple[float, float, float] | None = None

    def mesh(self, seed: int, detail: float) -> Mesh:
        """Its mesh in the world frame; distant plants of one maker share a few meshes."""
        make, name = self.template[:2]
        if detail < COARSE and name in PLANTS:
            made = _shape(make, name, self.number % SHAPES, detail)
        else:
            made = make(stream(seed, name, self.number), detail)
        if self.normal is None:
            return made.placed(self.position, self.yaw)
        return on_slope(made, self.position, self.yaw, self.normal)


@lru_cache(maxsize=256)
def _shape(make: Maker, name: str, number: int, detail: float) -> Mesh:
    return make(stream(0, "far", name, number), detail)


def on_slope(mesh: Mesh, position: tuple[float, float, float], yaw: float, normal: tuple[float, float, float]) -> Mesh:
    """The mesh moved to `position`, its x axis towards `yaw`, its z axis along the `normal` of the ground."""
    up = np.asarray(normal)
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    ahead = ahead - up * (ahead @ up)
    ahead /= np.linalg.norm(ahead)
    return mesh.transformed(np.stack([ahead, np.cross(up, ahead), up], axis=1), position)


@dataclass(slots=True, eq=False)
class OccupancyGrid:
    """Occupied footprints: circles in the cells of a grid."""

    cells: dict[tuple[int, int], list[Circle]] = field(default_factory=dict[tuple[int, int], list[Circle]])

    def is_free(self, x: float, y: float, radius: float) -> bool:
        """Return True where a circle overlaps no occupied one."""
        return all(
            (a - x) ** 2 + (b - y) ** 2 > (r + radius) ** 2
            for cell in _cells(x, y, radius)
            for a, b, r in self.cells.get(cell, ())
        )

    def occupy(self, x: float, y: float, radius: float) -> None:
        """Occupy a circle."""
        for cell in _cells(x, y, radius):
            self.cells.setdefault(cell, []).append((x, y, radius))

    def covering_circles(self, x: float, y: float, yaw: float, size: tuple[float, float]) -> list[Circle]:
        """Circles over a rectangle of `size` (along its x, along its y), except its corners."""
        deep, wide = size
        radius = min(deep, wide) / 2
        reach = max(deep, wide) / 2 - radius
        steps = np.linspace(-reach, reach, max(int(np.ceil(reach / max(radius, 0.1))), 1) * 2 + 1)
        turn = yaw if deep >= wide else yaw + np.pi / 2
        return [(x + step * np.cos(turn), y + step * np.sin(turn), radius) for step in steps]


def _cells(x: float, y: float, radius: float) -> Iterator[tuple[int, int]]:
    for i in range(int((x - radius) // CELL), int((x + radius) // CELL) + 1):
        for j in range(int((y - radius) // CELL), int((y + radius) // CELL) + 1):
            yield i, j


@dataclass(slots=True, eq=False)
class Planner:
    """The objects placed so far, and their footprints."""

    town: Town
    objects: list[PlacedObject] = field(default_factory=list[PlacedObject])
    occupied: OccupancyGrid = field(default_factory=OccupancyGrid)

    def rng(self, *names: str | int) -> np.random.Generator:
        """A random stream of this town."""
        return stream(self.town.seed, *names)

    def stretches(self, name: str) -> Iterator[tuple[np.random.Generator, Road, Stretch, LandUse]]:
        """All stretches: the random stream of `name` there, road, stretch, land use."""
        number = 0
        for index, (road, row) in enumerate(zip(self.town.roads, self.town.stretches, strict=True)):
            for stretch in row:
                yield self.rng(name, index, number), road, stretch, LAND_USES[stretch.land_use]
                number += 1

    def add(self, template: Template, xy: np.ndarray, yaw: float) -> None:
        """Place an object at a point (2,)."""
        z = float(self.town.height(xy, on_sidewalk=template.on_sidewalk))
        normal = tuple(self.town.terrain.normal(xy).tolist()) if template.follows_slope else None
        position = (float(xy[0]), float(xy[1]), z)
        self.objects.append(
            PlacedObject(template=template, number=len(self.objects), position=position, yaw=yaw, normal=normal)
        )

    def add_if_free(self, template: Template, xy: np.ndarray, yaw: float) -> bool:
        """Place an object if its footprint is free, and occupy it; whether it was placed."""
        circle = (float(xy[0]), float(xy[1]), template.radius)
        if not self.occupied.is_free(*circle):
            return False
        self.occupied.occupy(*circle)
        self.add(template, xy, yaw)
        return True
