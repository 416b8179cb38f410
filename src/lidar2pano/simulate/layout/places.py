"""Places: the sorts of street that a drive leads through, and the land use beside them. Metres, m/s."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from lidar2pano.simulate.layout.ground import GroundCover
from lidar2pano.simulate.layout.roads import Marking


class Place(NamedTuple):
    """A road, its side roads, its traffic, and the land use along it.

    share             of the drives that are in such a place, where none is given.
    half_width        of the carriageway;  sidewalk: its width;  kerb: its height.
    bend_radius       of the tightest bends;  slope: of the terrain.
    junction_spacing  mean distance between side roads (0 = none);  light_share: junctions with traffic lights.
    speed             of the traffic;  vehicle_gap: mean distance between vehicles of one lane.
    parked_share      of the kerb with parked cars;  bay_share: of the road with parking bays.
    cyclists, walkers  per 100 metres of road.
    land_uses         names in LAND_USES with their weights.
    median            half width of the strip between two carriageways (0 = none).
    rare              how many times as frequent as elsewhere what RARE names is, but for passing cyclists and walkers.
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
        """Weights by name, those of what is rare elsewhere (RARE) times `rare`."""
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
    # Only where it is asked for: a lesson in what other places have little of.
    "centre": Place(
        share=0.0, half_width=4.0, sidewalk=3.4, kerb=0.10, bend_radius=150, slope=0.02, junction_spacing=85,
        light_share=0.4, speed=7, vehicle_gap=22, parked_share=0.55, bay_share=0.6, cyclists=3.0, walkers=22.0,
        marking="town", surface=("asphalt", "asphalt-new", "cobbles"), paving=("paving", "cobbles", "asphalt"),
        land_uses={"flats": 4, "terraces": 3, "halls": 1.5, "park": 1, "houses": 1}, rare=12.0,
    ),
}  # fmt: skip


class LandUse(NamedTuple):
    """What stands along a stretch of road, on one side; (least, most) are ranges.

    building      that stands on the lots ("" = none);  width, depth: its size.
    setback       its distance from the sidewalk;  lot_gap: distance between lots.
    borders       of the lots towards the road, and their weights.
    street_trees  per 100 metres;  yard_plants: trees and bushes per 10 metres;  tree_density: per 100 m2.
    shrub_share   probability of a row of bushes;  lamp_spacing: distance between street lamps (0 = none).
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
    ground_cover: GroundCover = GroundCover()


LAND_USES: dict[str, LandUse] = {
    "houses": LandUse(
        building="house", width=(9, 14), depth=(8.5, 12), setback=(3, 9), lot_gap=(4, 12),
        borders={"hedge": 6, "picket": 1.5, "wall": 1, "wire": 1, "railing": 1, "none": 1.5},
        street_trees=2.5, yard_plants=7.5, tree_density=0.45, lamp_spacing=26, shrub_share=0.7,
        ground_cover=GroundCover(near="grass", far="grass"),
    ),
    "terraces": LandUse(
        building="terrace", width=(8, 11), depth=(9, 12), setback=(1.0, 6), lot_gap=(0.0, 3.0),
        borders={"none": 3, "railing": 1, "hedge": 4, "wall": 1},
        street_trees=3.0, yard_plants=2.5, tree_density=0.35, lamp_spacing=26, shrub_share=0.45,
        ground_cover=GroundCover(near="cobbles", far="grass"),
    ),
    "flats": LandUse(
        building="flats", width=(14, 26), depth=(10, 14), setback=(1.5, 10), lot_gap=(2.0, 16),
        borders={"none": 4, "hedge": 3, "railing": 1},
        street_trees=6.0, yard_plants=3.0, tree_density=0.3, lamp_spacing=26, shrub_share=0.6,
        ground_cover=GroundCover(near="cobbles", far="grass"),
    ),
    "halls": LandUse(
        building="hall", width=(20, 38), depth=(14, 24), setback=(8, 18), lot_gap=(8, 25),
        borders={"wire": 3, "none": 2, "hedge": 1},
        street_trees=3.0, yard_plants=4.0, tree_density=0.1, lamp_spacing=28, shrub_share=0.8,
        ground_cover=GroundCover(near="grass", far="gravel"),
    ),
    "gardens": LandUse(
        building="shed", width=(3, 5), depth=(3, 4), setback=(4, 12), lot_gap=(8, 18),
        borders={"hedge": 4, "wire": 3, "picket": 2},
        street_trees=2.5, yard_plants=7.0, tree_density=0.5, shrub_share=0.8, lamp_spacing=28,
    ),
    "park": LandUse(
        street_trees=6.0, yard_plants=10.0, tree_density=0.45, lamp_spacing=28, shrub_share=0.8,
        ground_cover=GroundCover(near="grass", far="grass"),
    ),
    "wood": LandUse(
        yard_plants=2.5, tree_density=1.6, shrub_share=1.0, ground_cover=GroundCover(near="meadow", far="soil")
    ),
    "field": LandUse(
        street_trees=2.0, yard_plants=4.0, shrub_share=0.85, ground_cover=GroundCover(near="meadow", far="field")
    ),
    "meadow": LandUse(
        street_trees=3.0, yard_plants=6.0, tree_density=0.12, shrub_share=0.9,
        ground_cover=GroundCover(near="meadow", far="meadow"),
    ),
    "noise": LandUse(
        borders={"noise": 1}, yard_plants=3.0, tree_density=0.4, shrub_share=0.9,
        ground_cover=GroundCover(near="meadow", far="meadow"),
    ),
}  # fmt: skip
