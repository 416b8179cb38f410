"""Town: a drive's roads and land, and every thing beside them, as a function of a seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidar2pano.simulate.layout.ground import Terrain
from lidar2pano.simulate.layout.places import PLACES, QUARTERS, Place
from lidar2pano.simulate.layout.roads import Bay, Road, course, locate
from lidar2pano.simulate.scene.random_streams import stream, weighted_choice

AHEAD = 170.0  # metres of road before the drive's start and beyond its end
SIDE_ROAD = 150.0  # metres


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """A quarter along one side (+1 left, -1 right) of a road, from `start` to `end` metres."""

    start: float
    end: float
    side: int
    quarter: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Town:
    """Roads (the first is the one that is driven along), land, and the quarters on both sides of each road.

    stretches  per road; junctions: places (s of the main road, side) where side roads begin.
    """

    seed: int
    name: str
    roads: tuple[Road, ...]
    terrain: Terrain
    stretches: tuple[tuple[Stretch, ...], ...]
    junctions: tuple[tuple[float, int], ...]

    @property
    def place(self) -> Place:
        """The main road's numbers."""
        return PLACES[self.name]

    def quarters(self, road: int, s: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Numbers (N,) in QUARTERS of places beside a road."""
        out = np.zeros(len(s), dtype=np.int64)
        names = list(QUARTERS)
        for stretch in self.stretches[road]:
            here = (s >= stretch.start) & (s <= stretch.end) & (np.where(d > 0, 1, -1) == stretch.side)
            out[here] = names.index(stretch.quarter)
        return out

    def height(self, xy: np.ndarray, road: int = 0, *, raised: bool = True) -> np.ndarray:
        """Height (...) of the land or (not raised) of the carriageway at places (..., 2), metres."""
        return self.terrain.height(xy) + (self.roads[road].kerb if raised else 0.0)


def town(seed: int, length: float, place: str) -> Town:
    """The town around a drive of `length` metres; `place` in PLACES."""
    row = PLACES[place]
    main = _main_road(stream(seed, "main road"), row, length)
    sides = _side_roads(stream(seed, "side roads"), row, main)
    roads = (main, *(road for road, _ in sides))
    stretches = tuple(tuple(_stretches(stream(seed, "quarters", index), row, road)) for index, road in enumerate(roads))
    terrain = Terrain.drawn(stream(seed, "terrain"), row.steep * stream(seed, "town").uniform(0.2, 1.3))
    return Town(
        seed=seed, name=place, roads=roads, terrain=terrain, stretches=stretches, junctions=tuple(at for _, at in sides)
    )


def _main_road(rng: np.random.Generator, row: Place, length: float) -> Road:
    bends = row.bends * (20 if rng.uniform() < 0.3 else 1)  # some are straight
    xy, heading = course(rng, (-AHEAD, 0.0), 0.0, length + 2 * AHEAD, bends)
    return Road(
        xy=xy,
        heading=heading,
        half_width=row.half * rng.uniform(0.92, 1.15),
        sidewalk=row.walk * rng.uniform(0.8, 1.3),
        kerb=row.kerb * rng.uniform(0.7, 1.2),
        marking=row.marking,
        surface=str(rng.choice(row.surface)),
        paving=str(rng.choice(row.paving)),
        bays=tuple(_bays(rng, row, length + 2 * AHEAD)),
        median=row.median,
    )


def _bays(rng: np.random.Generator, row: Place, length: float) -> list[Bay]:
    out: list[Bay] = []
    for side in (-1, 1):
        s = rng.uniform(0, 40)
        while s < length - 30:
            run = rng.uniform(18, 70)
            if rng.uniform() < row.bays:
                out.append(Bay(start=s, end=min(s + run, length), side=side, width=2.1))
            s += run + rng.uniform(6, 25)
    return out


def _side_roads(rng: np.random.Generator, row: Place, main: Road) -> list[tuple[Road, tuple[float, int]]]:
    out: list[tuple[Road, tuple[float, int]]] = []
    if not row.junctions:
        return out
    s = rng.uniform(0.3, 1.0) * row.junctions
    while s < main.length - 10:
        both = rng.uniform() < 0.35
        first = int(rng.choice([-1, 1]))
        for side in (first, -first) if both else (first,):
            out.append((_side_road(rng, row, main, s, side), (s, side)))
        s += row.junctions * rng.uniform(0.6, 1.6)
    return out


def _side_road(rng: np.random.Generator, row: Place, main: Road, s: float, side: int) -> Road:
    start, heading = main.at(np.array([s]), 0.0)
    turn = float(heading[0]) + side * (np.pi / 2 + rng.normal(0, 0.08))
    xy, headings = course(rng, start[0], turn, SIDE_ROAD, max(row.bends, 120))
    return Road(
        xy=xy,
        heading=headings,
        half_width=min(row.half, 3.6) * rng.uniform(0.85, 1.05),
        sidewalk=min(row.walk, 2.2) * rng.uniform(0.8, 1.1),
        kerb=main.kerb,
        marking=row.marking if row.marking != "motorway" else "country",
        surface=main.surface if rng.uniform() < 0.7 else str(rng.choice(row.surface)),
        paving=main.paving,
    )


def _stretches(rng: np.random.Generator, row: Place, road: Road) -> list[Stretch]:
    out: list[Stretch] = []
    long = 1.0 if row.kerb else 1.7
    for side in (-1, 1):
        s = 0.0
        while s < road.length:
            run = long * rng.uniform(50, 150)
            out.append(
                Stretch(start=s, end=min(s + run, road.length), side=side, quarter=weighted_choice(rng, row.quarters))
            )
            s += run
    return out


def clear_of_roads(roads: Sequence[Road], xy: np.ndarray, margin: float) -> np.ndarray:
    """Which places (N, 2) lie at least `margin` metres beyond every road's kerb, the pavement included: (N,) bool."""
    at = locate(roads, xy)
    walk = np.array([road.sidewalk for road in roads])[at.road]
    return at.outside >= walk + margin
