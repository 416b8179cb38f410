"""Towns: the roads, terrain and land use around a drive, by the sort of street. Metres, m/s."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidar2pano.simulate.layout.roads import Bay, Marking, Road, Terrain, locate, winding_centreline
from lidar2pano.simulate.scene.random_streams import stream, weighted_choice

ROAD_MARGIN = 170.0  # metres of road before the start and after the end of the drive
SIDE_ROAD = 150.0  # metres


class Place(NamedTuple):
    """A road, its side roads, its traffic, and the land use along it.

    share             of the drives in such a place, where none is given.
    half_width        of the carriageway;  sidewalk: its width;  kerb: its height.
    bend_radius       of the tightest bends;  slope: of the terrain.
    junction_spacing  mean distance between side roads (0 = none);  light_share: junctions with traffic lights.
    speed             of the traffic;  vehicle_gap: mean distance between vehicles of one lane.
    parked_share      of the kerb with parked cars;  bay_share: of the road with parking bays.
    cyclists, walkers  per 100 metres of road.
    land_uses         names in LAND_USES with their weights.
    median            half width of the strip between two carriageways (0 = none).
    rare              factor on the frequency of RARE objects, but for passing cyclists and walkers.
    """

    share: float
    half_width: float
    bend_radius: float
    slope: float
    speed: float
    vehicle_gap: float
    marking: Marking
    surface: tuple[str, ...]
    paving: tuple[str, ...]
    land_uses: dict[str, float]
    sidewalk: float = 0.0
    kerb: float = 0.0
    junction_spacing: float = 0.0
    light_share: float = 0.0
    parked_share: float = 0.0
    bay_share: float = 0.0
    cyclists: float = 0.0
    walkers: float = 0.0
    median: float = 0.0
    rare: float = 1.0

    def mix(self, weights: Mapping[str, float]) -> dict[str, float]:
        """Weights by name, those of RARE objects times `rare`."""
        return {name: weight * (self.rare if name in RARE else 1.0) for name, weight in weights.items()}


RARE = ("truck", "trailer", "bus", "tram", "motorcycle", "motorcyclist", "bicycle", "person")
PLACES: dict[str, Place] = {
    "residential": Place(
        share=0.40, half_width=3.5, sidewalk=1.8, kerb=0.10, bend_radius=90, slope=0.035, junction_spacing=75,
        speed=8, vehicle_gap=90, parked_share=0.35, bay_share=0.2, cyclists=0.3, walkers=2.2, marking="none",
        surface=("asphalt", "asphalt", "asphalt-new", "cobbles"), paving=("paving", "paving", "asphalt"),
        land_uses={"houses": 5, "terraces": 2, "gardens": 1, "park": 0.6},
    ),
    "avenue": Place(
        share=0.22, half_width=4.6, sidewalk=3.0, kerb=0.12, bend_radius=200, slope=0.02, junction_spacing=95,
        light_share=0.5, speed=11, vehicle_gap=55, parked_share=0.3, bay_share=0.4, cyclists=0.8, walkers=5.0,
        marking="town", surface=("asphalt", "asphalt-new"), paving=("paving", "cobbles", "asphalt"),
        land_uses={"flats": 4, "terraces": 2, "park": 1, "halls": 0.7, "houses": 0.6},
    ),
    "outskirts": Place(
        share=0.14, half_width=3.6, sidewalk=1.6, kerb=0.10, bend_radius=180, slope=0.03, junction_spacing=120,
        light_share=0.15, speed=13, vehicle_gap=70, parked_share=0.15, bay_share=0.2, cyclists=0.3, walkers=1.0,
        marking="town", surface=("asphalt", "asphalt-new"), paving=("asphalt", "paving"),
        land_uses={"halls": 3, "houses": 2, "field": 1, "wood": 1, "gardens": 1},
    ),
    "country": Place(
        share=0.14, half_width=3.3, bend_radius=260, slope=0.05, junction_spacing=230, speed=20, vehicle_gap=80,
        cyclists=0.3, walkers=0.1, marking="country", surface=("asphalt", "asphalt-new"), paving=("asphalt",),
        land_uses={"field": 3, "wood": 3, "meadow": 1.5, "houses": 1},
    ),
    "motorway": Place(
        share=0.10, half_width=12.6, bend_radius=900, slope=0.015, speed=29, vehicle_gap=65, marking="motorway",
        surface=("asphalt", "asphalt-new"), paving=("asphalt",),
        land_uses={"field": 2, "wood": 3, "meadow": 2, "noise": 1}, median=1.9,
    ),
    # Only where it is asked for: a lesson in RARE objects.
    "centre": Place(
        share=0.0, half_width=4.0, sidewalk=3.4, kerb=0.10, bend_radius=150, slope=0.02, junction_spacing=85,
        light_share=0.4, speed=7, vehicle_gap=22, parked_share=0.55, bay_share=0.6, cyclists=3.0, walkers=22.0,
        marking="town", surface=("asphalt", "asphalt-new", "cobbles"), paving=("paving", "cobbles", "asphalt"),
        land_uses={"flats": 4, "terraces": 3, "halls": 1.5, "park": 1, "houses": 1}, rare=12.0,
    ),
}  # fmt: skip


class LandUse(NamedTuple):
    """The objects along a stretch of road, on one side; (least, most) are ranges.

    building      on the lots ("" = none);  width, depth: its size.
    setback       its distance from the sidewalk;  lot_gap: distance between lots.
    borders       of the lots towards the road, and their weights.
    street_trees  per 100 metres;  yard_plants: trees and bushes per 10 metres;  tree_density: per 100 m2.
    shrub_share   probability of a row of bushes;  lamp_spacing: distance between street lamps (0 = none).
    near, far     materials of the land: of the first 14 metres beyond the sidewalk, and of the rest.
    """

    building: str = ""
    width: tuple[float, float] = (8, 14)
    depth: tuple[float, float] = (8, 12)
    setback: tuple[float, float] = (2, 7)
    lot_gap: tuple[float, float] = (2, 8)
    borders: dict[str, float] = {}  # noqa: RUF012 never changed
    street_trees: float = 0.0
    yard_plants: float = 0.0
    shrub_share: float = 0.0
    tree_density: float = 0.0
    lamp_spacing: float = 0.0
    near: str = "grass"
    far: str = "meadow"


LAND_USES: dict[str, LandUse] = {
    "houses": LandUse(
        building="house", width=(9, 14), depth=(8.5, 12), setback=(3, 9), lot_gap=(4, 12),
        borders={"hedge": 6, "picket": 1.5, "wall": 1, "wire": 1, "railing": 1, "none": 1.5},
        street_trees=2.5, yard_plants=7.5, tree_density=0.45, lamp_spacing=26, shrub_share=0.7, far="grass",
    ),
    "terraces": LandUse(
        building="terrace", width=(8, 11), depth=(9, 12), setback=(1.0, 6), lot_gap=(0.0, 3.0),
        borders={"none": 3, "railing": 1, "hedge": 4, "wall": 1}, near="cobbles", far="grass",
        street_trees=3.0, yard_plants=2.5, tree_density=0.35, lamp_spacing=26, shrub_share=0.45,
    ),
    "flats": LandUse(
        building="flats", width=(14, 26), depth=(10, 14), setback=(1.5, 10), lot_gap=(2.0, 16),
        borders={"none": 4, "hedge": 3, "railing": 1}, near="cobbles", far="grass",
        street_trees=6.0, yard_plants=3.0, tree_density=0.3, lamp_spacing=26, shrub_share=0.6,
    ),
    "halls": LandUse(
        building="hall", width=(20, 38), depth=(14, 24), setback=(8, 18), lot_gap=(8, 25),
        borders={"wire": 3, "none": 2, "hedge": 1},
        street_trees=3.0, yard_plants=4.0, tree_density=0.1, lamp_spacing=28, shrub_share=0.8, far="gravel",
    ),
    "gardens": LandUse(
        building="shed", width=(3, 5), depth=(3, 4), setback=(4, 12), lot_gap=(8, 18),
        borders={"hedge": 4, "wire": 3, "picket": 2},
        street_trees=2.5, yard_plants=7.0, tree_density=0.5, shrub_share=0.8, lamp_spacing=28,
    ),
    "park": LandUse(
        street_trees=6.0, yard_plants=10.0, tree_density=0.45, lamp_spacing=28, shrub_share=0.8, far="grass",
    ),
    "wood": LandUse(yard_plants=2.5, tree_density=1.6, shrub_share=1.0, near="meadow", far="soil"),
    "field": LandUse(street_trees=2.0, yard_plants=4.0, shrub_share=0.85, near="meadow", far="field"),
    "meadow": LandUse(street_trees=3.0, yard_plants=6.0, tree_density=0.12, shrub_share=0.9, near="meadow"),
    "noise": LandUse(borders={"noise": 1}, yard_plants=3.0, tree_density=0.4, shrub_share=0.9, near="meadow"),
}  # fmt: skip


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

    stretches  of each road;  junctions: (s of the main road, side) of the beginnings of side roads.
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
            inside = (s >= stretch.start) & (s <= stretch.end) & (np.where(d > 0, 1, -1) == stretch.side)
            out[inside] = names.index(stretch.land_use)
        return out

    def height(self, xy: np.ndarray, *, on_sidewalk: bool = True) -> np.ndarray:
        """Height (...) of the sidewalk and the land behind it, or of the carriageway, at points (..., 2), metres."""
        return self.terrain.height(xy) + (self.roads[0].kerb if on_sidewalk else 0.0)


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
    junctions = tuple(mouth for _, mouth in sides)
    return Town(seed=seed, name=place, roads=roads, terrain=terrain, stretches=stretches, junctions=junctions)


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
        paired = rng.uniform() < 0.35
        first = int(rng.choice([-1, 1]))
        for side in (first, -first) if paired else (first,):
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
            end, land_use = min(s + run, road.length), weighted_choice(rng, parameters.land_uses)
            out.append(Stretch(start=s, end=end, side=side, land_use=land_use))
            s += run
    return out


def clear_of_roads(roads: Sequence[Road], xy: np.ndarray, margin: float) -> np.ndarray:
    """Return (N,) bool: points (N, 2) are at least `margin` metres away from all roads and their sidewalks."""
    at = locate(roads, xy)
    walk = np.array([road.sidewalk for road in roads])[at.road]
    return at.kerb_distance >= walk + margin
