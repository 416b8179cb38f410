"""Places: the kinds of street that a drive goes along, as numbers. Distances in metres, speeds in m/s."""

from __future__ import annotations

from typing import NamedTuple

from lidar2pano.simulate.layout.ground import Land
from lidar2pano.simulate.layout.roads import Marking


class Place(NamedTuple):
    """A road, what crosses it, what drives on it, and the quarters that it leads through.

    share      how often a drive is in such a place.
    half       half width of the carriageway;  walk: width of the pavement;  kerb: its height.
    bends      tightest radius of its bends;  steep: slope of the land.
    junctions  mean distance between side roads (0 = none);  lights: share of junctions with traffic lights.
    speed      of the traffic;  gap: mean distance between vehicles of one lane.
    parked     share of the kerb with parked cars;  bays: share of the road with bays for them.
    cyclists, walkers  per 100 metres of road.
    quarters   names in QUARTERS with their weights.
    """

    share: float
    half: float
    walk: float
    kerb: float
    bends: float
    steep: float
    junctions: float
    lights: float
    speed: float
    gap: float
    parked: float
    bays: float
    cyclists: float
    walkers: float
    marking: Marking
    surface: tuple[str, ...]
    paving: tuple[str, ...]
    quarters: dict[str, float]
    median: float = 0.0


PLACES: dict[str, Place] = {
    "residential": Place(
        0.40, 3.5, 1.8, 0.10, 90, 0.035, 75, 0.0, 8, 90, 0.35, 0.2, 0.3, 2.2, "none",
        ("asphalt", "asphalt", "asphalt-new", "cobbles"), ("paving", "paving", "asphalt"),
        {"houses": 5, "terraces": 2, "gardens": 1, "park": 0.6},
    ),
    "avenue": Place(
        0.22, 4.6, 3.0, 0.12, 200, 0.02, 95, 0.5, 11, 55, 0.3, 0.4, 0.8, 5.0, "town",
        ("asphalt", "asphalt-new"), ("paving", "cobbles", "asphalt"),
        {"flats": 4, "terraces": 2, "park": 1, "halls": 0.7, "houses": 0.6},
    ),
    "outskirts": Place(
        0.14, 3.6, 1.6, 0.10, 180, 0.03, 120, 0.15, 13, 70, 0.15, 0.2, 0.3, 1.0, "town",
        ("asphalt", "asphalt-new"), ("asphalt", "paving"),
        {"halls": 3, "houses": 2, "field": 1, "wood": 1, "gardens": 1},
    ),
    "country": Place(
        0.14, 3.3, 0.0, 0.0, 260, 0.05, 230, 0.0, 20, 80, 0.0, 0.0, 0.3, 0.1, "country",
        ("asphalt", "asphalt-new"), ("asphalt",), {"field": 3, "wood": 3, "meadow": 1.5, "houses": 1},
    ),
    "motorway": Place(
        0.10, 12.6, 0.0, 0.0, 900, 0.015, 0, 0.0, 29, 65, 0.0, 0.0, 0.0, 0.0, "motorway",
        ("asphalt", "asphalt-new"), ("asphalt",), {"field": 2, "wood": 3, "meadow": 2, "noise": 1}, median=1.9,
    ),
}  # fmt: skip


class Quarter(NamedTuple):
    """What stands along a stretch of road, on one side.

    building   thing that stands on the lots ("" = none);  wide, deep: its size;  setback: its distance from the
               pavement, all as (least, most);  gap: metres between lots;  fronts: borders of the lots and weights.
    trees      street trees per 100 metres;  yard: trees and bushes per lot;  dense: trees per 100 m2 of wood.
    shrubs     chance of a row of bushes;  lamps: distance between street lamps (0 = none).
    """

    building: str
    wide: tuple[float, float] = (8, 14)
    deep: tuple[float, float] = (8, 12)
    setback: tuple[float, float] = (2, 7)
    gap: tuple[float, float] = (2, 8)
    fronts: dict[str, float] = {}  # noqa: RUF012 never changed
    trees: float = 0.0
    yard: float = 0.0
    shrubs: float = 0.0
    dense: float = 0.0
    lamps: float = 0.0
    land: Land = Land()


QUARTERS: dict[str, Quarter] = {
    "houses": Quarter(
        "house", (9, 14), (8.5, 12), (3, 9), (4, 12),
        {"hedge": 6, "picket": 1.5, "wall": 1, "wire": 1, "railing": 1, "none": 1.5},
        trees=2.5, yard=7.5, dense=0.45, lamps=26, shrubs=0.7, land=Land(near="grass", far="grass"),
    ),
    "terraces": Quarter(
        "terrace", (8, 11), (9, 12), (1.0, 6), (0.0, 3.0), {"none": 3, "railing": 1, "hedge": 4, "wall": 1},
        trees=3.0, yard=2.5, dense=0.35, lamps=26, shrubs=0.45, land=Land(near="cobbles", far="grass"),
    ),
    "flats": Quarter(
        "flats", (14, 26), (10, 14), (1.5, 10), (2.0, 16), {"none": 4, "hedge": 3, "railing": 1},
        trees=6.0, yard=3.0, dense=0.3, lamps=26, shrubs=0.6, land=Land(near="cobbles", far="grass"),
    ),
    "halls": Quarter(
        "hall", (20, 38), (14, 24), (8, 18), (8, 25), {"wire": 3, "none": 2, "hedge": 1},
        trees=3.0, yard=4.0, dense=0.1, lamps=28, shrubs=0.8, land=Land(near="grass", far="gravel"),
    ),
    "gardens": Quarter(
        "shed", (3, 5), (3, 4), (4, 12), (8, 18), {"hedge": 4, "wire": 3, "picket": 2},
        trees=2.5, yard=7.0, dense=0.5, shrubs=0.8, lamps=28,
    ),
    "park": Quarter(
        "", gap=(6, 14), trees=6.0, yard=10.0, dense=0.45, lamps=28, shrubs=0.8, land=Land(near="grass", far="grass")
    ),
    "wood": Quarter("", gap=(8, 14), trees=0.0, yard=2.5, dense=1.6, shrubs=1.0, land=Land(near="meadow", far="soil")),
    "field": Quarter("", gap=(25, 60), trees=2.0, yard=4.0, shrubs=0.85, land=Land(near="meadow", far="field")),
    "meadow": Quarter(
        "", gap=(15, 40), trees=3.0, yard=6.0, dense=0.12, shrubs=0.9, land=Land(near="meadow", far="meadow")
    ),
    "noise": Quarter(
        "", gap=(15, 30), fronts={"noise": 1}, yard=3.0, dense=0.4, shrubs=0.9, land=Land(near="meadow", far="meadow")
    ),
}  # fmt: skip
