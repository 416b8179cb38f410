"""Town: the roads, terrain and land use around a drive, as a function of a seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidar2pano.simulate.layout.ground import Terrain
from lidar2pano.simulate.layout.places import LAND_USES, PLACES, Place
from lidar2pano.simulate.layout.roads import Bay, Road, locate, winding_centreline
from lidar2pano.simulate.scene.random_streams import stream, weighted_choice

ROAD_MARGIN = 170.0  # metres of road before the start and after the end of the drive
SIDE_ROAD = 150.0  # metres


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """One land use along one side (+1 left, -1 right) of a road, from `start` to `end` metres."""

    start: float
    end: float
    side: int
    land_use: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Town:
    """Roads, the first is the main road of the drive, terrain, and land use on both sides of each road.

    stretches  of each road;  junctions: (s of the main road, side) at which side roads begin.
    """

    seed: int
    name: str
    roads: tuple[Road, ...]
    terrain: Terrain
    stretches: tuple[tuple[Stretch, ...], ...]
    junctions: tuple[tuple[float, int], ...]

    @property
    def place(self) -> Place:
        """The parameters of the place."""
        return PLACES[self.name]

    def land_use_ids(self, road: int, s: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Indices (N,) in LAND_USES at positions (s, d) beside a road."""
        out = np.zeros(len(s), dtype=np.int64)
        names = list(LAND_USES)
        for stretch in self.stretches[road]:
            here = (s >= stretch.start) & (s <= stretch.end) & (np.where(d > 0, 1, -1) == stretch.side)
            out[here] = names.index(stretch.land_use)
        return out

    def height(self, xy: np.ndarray, road: int = 0, *, on_sidewalk: bool = True) -> np.ndarray:
        """Height (...) of the sidewalk and the land behind it, or of the carriageway, at points (..., 2), metres."""
        return self.terrain.height(xy) + (self.roads[road].kerb if on_sidewalk else 0.0)


def build_town(seed: int, length: float, place: str) -> Town:
    """The town around a drive of `length` metres; `place` in PLACES."""
    parameters = PLACES[place]
    main = _main_road(stream(seed, "main road"), parameters, length)
    sides = _side_roads(stream(seed, "side roads"), parameters, main)
    roads = (main, *(road for road, _ in sides))
    stretches = tuple(
        tuple(_stretches(stream(seed, "quarters", index), parameters, road)) for index, road in enumerate(roads)
    )
    terrain = Terrain.random(stream(seed, "terrain"), parameters.slope * stream(seed, "town").uniform(0.2, 1.3))
    return Town(
        seed=seed, name=place, roads=roads, terrain=terrain, stretches=stretches, junctions=tuple(at for _, at in sides)
    )


def _main_road(rng: np.random.Generator, parameters: Place, length: float) -> Road:
    bends = parameters.bend_radius * (20 if rng.uniform() < 0.3 else 1)  # some roads are straight
    xy, heading = winding_centreline(rng, (-ROAD_MARGIN, 0.0), 0.0, length + 2 * ROAD_MARGIN, bends)
    return Road(
        xy=xy,
        heading=heading,
        half_width=parameters.half_width * rng.uniform(0.92, 1.15),
        sidewalk=parameters.sidewalk * rng.uniform(0.8, 1.3),
        kerb=parameters.kerb * rng.uniform(0.7, 1.2),
        marking=parameters.marking,
        surface=str(rng.choice(parameters.surface)),
        paving=str(rng.choice(parameters.paving)),
        bays=tuple(_bays(rng, parameters, length + 2 * ROAD_MARGIN)),
        median=parameters.median,
    )


def _bays(rng: np.random.Generator, parameters: Place, length: float) -> list[Bay]:
    out: list[Bay] = []
    for side in (-1, 1):
        s = rng.uniform(0, 40)
        while s < length - 30:
            run = rng.uniform(18, 70)
            if rng.uniform() < parameters.bay_share:
                out.append(Bay(start=s, end=min(s + run, length), side=side, width=2.1))
            s += run + rng.uniform(6, 25)
    return out


def _side_roads(rng: np.random.Generator, parameters: Place, main: Road) -> list[tuple[Road, tuple[float, int]]]:
    out: list[tuple[Road, tuple[float, int]]] = []
    if not parameters.junction_spacing:
        return out
    s = rng.uniform(0.3, 1.0) * parameters.junction_spacing
    while s < main.length - 10:
        both = rng.uniform() < 0.35
        first = int(rng.choice([-1, 1]))
        for side in (first, -first) if both else (first,):
            out.append((_side_road(rng, parameters, main, s, side), (s, side)))
        s += parameters.junction_spacing * rng.uniform(0.6, 1.6)
    return out


def _side_road(rng: np.random.Generator, parameters: Place, main: Road, s: float, side: int) -> Road:
    start, heading = main.at(np.array([s]), 0.0)
    turn = float(heading[0]) + side * (np.pi / 2 + rng.normal(0, 0.08))
    xy, headings = winding_centreline(rng, start[0], turn, SIDE_ROAD, max(parameters.bend_radius, 120))
    return Road(
        xy=xy,
        heading=headings,
        half_width=min(parameters.half_width, 3.6) * rng.uniform(0.85, 1.05),
        sidewalk=min(parameters.sidewalk, 2.2) * rng.uniform(0.8, 1.1),
        kerb=main.kerb,
        marking=parameters.marking if parameters.marking != "motorway" else "country",
        surface=main.surface if rng.uniform() < 0.7 else str(rng.choice(parameters.surface)),
        paving=main.paving,
    )


def _stretches(rng: np.random.Generator, parameters: Place, road: Road) -> list[Stretch]:
    out: list[Stretch] = []
    scale = 1.0 if parameters.kerb else 1.7
    for side in (-1, 1):
        s = 0.0
        while s < road.length:
            run = scale * rng.uniform(50, 150)
            out.append(
                Stretch(
                    start=s,
                    end=min(s + run, road.length),
                    side=side,
                    land_use=weighted_choice(rng, parameters.land_uses),
                )
            )
            s += run
    return out


def clear_of_roads(roads: Sequence[Road], xy: np.ndarray, margin: float) -> np.ndarray:
    """Whether points (N, 2) are at least `margin` metres away from all roads and their sidewalks: (N,) bool."""
    at = locate(roads, xy)
    walk = np.array([road.sidewalk for road in roads])[at.road]
    return at.kerb_distance >= walk + margin
