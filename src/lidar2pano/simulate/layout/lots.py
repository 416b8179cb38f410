"""Lots: buildings beside the roads, their borders, and trees and bushes."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from lidar2pano.simulate.assets import barriers, houses, large_buildings, plants
from lidar2pano.simulate.layout.placement import Maker, ObjectTemplate, Planner
from lidar2pano.simulate.layout.places import LandUse
from lidar2pano.simulate.layout.roads import Road, locate
from lidar2pano.simulate.layout.town import Stretch, clear_of_roads
from lidar2pano.simulate.scene.mesh import Mesh
from lidar2pano.simulate.scene.random_streams import weighted_choice

Rng = np.random.Generator


def _building_maker(make: str, wide: float, deep: float) -> Maker:
    """The maker of a building of `wide` x `deep` metres."""
    small = {"shed": houses.shed, "garage": houses.garage}
    large = {
        "house": houses.house,
        "terrace": houses.house,
        "flats": large_buildings.flats,
        "hall": large_buildings.hall,
    }
    if make in small:
        return lambda rng, _: small[make](rng)
    return lambda rng, _: large[make](rng, wide, deep)


def buildings(plan: Planner) -> None:
    """A building on every lot with room for it, a second row along the main road, garages beside some houses."""
    for number, (index, road, stretch, land_use) in enumerate(plan.stretches()):
        if land_use.building:
            rng = plan.rng("lots", index, number)
            _row(plan, rng, road, stretch, land_use, behind=0.0)
            if index == 0:
                _row(plan, rng, road, stretch, land_use, behind=rng.uniform(24, 34))


def _row(plan: Planner, rng: Rng, road: Road, stretch: Stretch, land_use: LandUse, behind: float) -> None:
    s = stretch.start + rng.uniform(0, 5)
    line = rng.uniform(*land_use.setback)  # neighbours share a building line
    while s < stretch.end:
        wide, deep = rng.uniform(*land_use.width), rng.uniform(*land_use.depth)
        off = np.clip(line + rng.normal(0, 0.7), land_use.setback[0], land_use.setback[1]) + behind
        if s + wide <= stretch.end + 4 and rng.uniform() < (0.93 if not behind else 0.6):
            _lot(plan, rng, road, stretch, land_use, (s + wide / 2, off, wide, deep))
        s += wide + rng.uniform(*land_use.lot_gap)


def _lot(
    plan: Planner, rng: Rng, road: Road, stretch: Stretch, land_use: LandUse, lot: tuple[float, float, float, float]
) -> None:
    s, off, wide, deep = lot
    yaw, xy = _facing(road, s, stretch.side, road.sidewalk + off + deep / 2)
    corners = _corners(xy, yaw, deep, wide)
    circles = plan.occupied.covering_circles(float(xy[0]), float(xy[1]), yaw, (deep, wide))
    free = all(plan.occupied.is_free(x, y, radius * 0.98) for x, y, radius in circles)
    if not free or not clear_of_roads(plan.town.roads, corners, 0.2).all():
        return
    for circle in circles:
        plan.occupied.occupy(*circle)
    plan.add(
        ObjectTemplate(_building_maker(land_use.building, wide, deep), land_use.building, max(wide, deep) / 1.6),
        xy,
        yaw,
    )
    if land_use.building == "house" and rng.uniform() < 0.45:
        beside, where = _facing(road, s + rng.choice([-1, 1]) * (wide / 2 + 2.2), stretch.side, road.sidewalk + off + 4)
        if clear_of_roads(plan.town.roads, _corners(where, beside, 6, 3.2), 0.2).all():
            plan.add_if_free(ObjectTemplate(_building_maker("garage", 3, 6), "garage", 2.0), where, beside)


def _facing(road: Road, s: float, side: int, away: float) -> tuple[float, np.ndarray]:
    """Yaw towards the road, and the point `away` metres beyond the kerb."""
    xy, heading = road.beside(s, side, away)
    return float(heading) - side * np.pi / 2, xy


def _corners(xy: np.ndarray, yaw: float, deep: float, wide: float) -> np.ndarray:
    """Corners and midpoints of the sides (8, 2) of a rectangle, `deep` along its yaw."""
    c, s = np.cos(yaw), np.sin(yaw)
    x, y = np.meshgrid([-deep / 2, 0, deep / 2], [-wide / 2, 0, wide / 2])
    away = np.stack([c * x - s * y, s * x + c * y], -1).reshape(-1, 2)
    return xy + np.delete(away, 4, axis=0)


def borders(plan: Planner) -> None:
    """Hedges, fences and walls along the sidewalks, with gaps for entrances."""
    for number, (index, road, stretch, land_use) in enumerate(plan.stretches()):
        if not land_use.borders:
            continue
        rng = plan.rng("borders", index, number)
        s = stretch.start
        while s < stretch.end - 3:
            barrier = weighted_choice(rng, land_use.borders)
            run = min(rng.uniform(9, 17) if barrier != "noise" else 1e3, stretch.end - s)
            if barrier != "none":
                _place_border(plan, rng, road, stretch.side, barrier, (s, s + run))
            s += run + rng.uniform(1.2, 4.5)


def _place_border(plan: Planner, rng: Rng, road: Road, side: int, barrier: str, span: tuple[float, float]) -> None:
    """Straight pieces along the road, left out where a road or building is in the way."""
    piece = 14.0
    off = 4.0 if barrier == "noise" else 0.35
    edges = np.arange(span[0], span[1], piece)
    height = rng.uniform(0.8, 1.9)
    for first in edges:
        last = min(first + piece, span[1])
        if last - first < 1.5:
            continue
        s = np.linspace(first, last, 5)
        xy, _ = road.beside(s, side, road.sidewalk + off)
        at = locate(plan.town.roads, xy)
        walk = np.array([part.sidewalk for part in plan.town.roads])[at.road]
        if not (at.kerb_distance > walk + 0.1).all() or not all(plan.occupied.is_free(x, y, 0.1) for x, y in xy):
            continue
        run = xy[-1] - xy[0]
        length, yaw = float(np.hypot(*run)), float(np.arctan2(run[1], run[0]))
        for x, y in xy:
            plan.occupied.occupy(float(x), float(y), 0.3)
        plan.add(
            ObjectTemplate(_barrier(plan, barrier, xy[0], yaw, length, height), f"border {barrier}", 0.0), xy[0], yaw
        )


def _barrier(plan: Planner, barrier: str, start: np.ndarray, yaw: float, length: float, height: float) -> Maker:
    """The maker of a barrier that follows the terrain from `start` along `yaw`."""
    way = np.array([np.cos(yaw), np.sin(yaw)])

    def land(x: np.ndarray) -> np.ndarray:
        return plan.town.terrain.height(start + np.asarray(x)[..., None] * way) - plan.town.terrain.height(start)

    if barrier == "hedge":

        def grown(rng: Rng, detail: float) -> Mesh:
            level = plants.hedge(rng, length, height, rng.uniform(0.6, 1.1), detail).placed((length / 2, 0, 0), 0.0)
            rise = np.zeros_like(level.vertices)
            rise[:, 2] = land(level.vertices[:, 0])
            return replace(level, vertices=level.vertices + rise)

        return grown
    makers = {
        "picket": barriers.picket_fence,
        "wire": barriers.wire_fence,
        "railing": barriers.railing,
        "wall": barriers.wall,
        "noise": barriers.noise_barrier,
        "guard": barriers.guard_rail,
    }
    return lambda rng, _: makers[barrier](rng, length, land)


def guard_rails(plan: Planner) -> None:
    """Guard rails along both sides of a motorway's median, and along some country roads."""
    road, place = plan.town.roads[0], plan.town.place
    rng = plan.rng("guard rails")
    lines = [(side, 1.0) for side in (-1, 1)] if road.median else []
    for side in (-1, 1):
        if place.marking in ("country", "motorway") and rng.uniform() < (0.7 if road.median else 0.3):
            lines.append((side, road.half_width + 0.9))
    for side, off in lines:
        for first in np.arange(0, road.length - 12, 12.0):
            xy, _ = road.at(np.array([first, first + 12]), side * off)
            # The beam is to the right of the direction from post to post, and faces the traffic.
            if (side < 0) == (off > road.half_width):
                xy = xy[::-1]
            run = xy[1] - xy[0]
            if off > road.half_width and locate(plan.town.roads, xy).other_road.min() < 3:
                continue
            yaw = float(np.arctan2(run[1], run[0]))
            rail = _barrier(plan, "guard", xy[0], yaw, float(np.hypot(*run)), 0.75)
            plan.add(ObjectTemplate(rail, "guard rail", 0.0), xy[0], yaw)


def yards(plan: Planner) -> None:
    """Trees and bushes on the lots and behind them."""
    for number, (index, road, stretch, land_use) in enumerate(plan.stretches()):
        rng = plan.rng("yards", index, number)
        run = stretch.end - stretch.start
        count = rng.poisson(land_use.yard_plants * run / 10)
        s, off = rng.uniform(stretch.start, stretch.end, count), 1.2 + rng.gamma(1.6, 6.0, count)
        _plant(plan, rng, road, stretch.side, s, off, bushes=0.6)
        deep = 55.0
        count = rng.poisson(land_use.tree_density * run * deep / 100)
        s, off = rng.uniform(stretch.start, stretch.end, count), 4 + deep * rng.beta(1.0, 1.3, count)
        _plant(plan, rng, road, stretch.side, s, off, bushes=0.25)


def shrubs(plan: Planner) -> None:
    """Rows of bushes, and undergrowth at the edge of woods: most vegetation in LiDAR scans is low."""
    for number, (index, road, stretch, land_use) in enumerate(plan.stretches()):
        rng = plan.rng("shrubs", index, number)
        for depth in range(3 if land_use.tree_density > 1 else 1):
            if rng.uniform() >= land_use.shrub_share:
                continue
            first, last = np.sort(rng.uniform(stretch.start - 10, stretch.end + 10, 2))
            s = np.arange(max(first, stretch.start), min(last, stretch.end), rng.uniform(1.0, 1.8))
            off = rng.uniform(1.0, 7.0) + 2.5 * depth + rng.normal(0, 0.3, len(s))
            _plant(plan, rng, road, stretch.side, s, off, bushes=0.97)


def _plant(plan: Planner, rng: Rng, road: Road, side: int, s: np.ndarray, off: np.ndarray, bushes: float) -> None:
    if not len(s):
        return
    xy, _ = road.beside(s, side, road.sidewalk + off)
    clear = clear_of_roads(plan.town.roads, xy, 0.8)
    for place, bush, turn in zip(
        xy[clear], rng.uniform(size=len(xy))[clear], rng.uniform(0, 6.28, len(xy))[clear], strict=True
    ):
        if bush < bushes:
            plan.add_if_free(ObjectTemplate(plants.bush, "bush", 0.7), place, float(turn))
        else:
            plan.add_if_free(ObjectTemplate(_tree(rng), "tree", 1.5), place, float(turn))


SPECIES = {
    "linden": 3.0, "maple": 3.0, "birch": 2.0, "oak": 2.0, "poplar": 0.6, "fruit": 1.6, "globe": 0.5, "spruce": 1.4,
    "pine": 0.9,
}  # fmt: skip


def _tree(rng: Rng, species: str = "") -> Maker:
    return TREES[species or weighted_choice(rng, SPECIES)]


def _grown(rng: Rng, detail: float, species: str) -> Mesh:
    return plants.tree(rng, species, detail)


TREES: dict[str, Maker] = {species: partial(_grown, species=species) for species in SPECIES}


def horizon(plan: Planner) -> None:
    """Distant trees and houses that close the view along the main road."""
    road, rng = plan.town.roads[0], plan.rng("horizon")
    for side in (-1, 1):
        s = 0.0
        while s < road.length:
            run, away = rng.uniform(25, 80), rng.uniform(70, 115)
            if rng.uniform() < 0.7:
                count = int(run / 4.5)
                at = rng.uniform(s, s + run, count)
                xy, _ = road.at(at, side * (away + rng.uniform(0, 14, count)))
                for place in xy[clear_of_roads(plan.town.roads, xy, 3.0)]:
                    plan.add_if_free(ObjectTemplate(_tree(rng), "far tree", 1.8), place, float(rng.uniform(0, 6.28)))
            elif plan.town.place.kerb:
                xy, heading = road.at(np.array(s + run / 2), side * away)
                if clear_of_roads(plan.town.roads, xy[None], 12.0)[0]:
                    size = rng.uniform(9, 13), rng.uniform(9, 12)
                    plan.add_if_free(
                        ObjectTemplate(_building_maker("house", *size), "house", 7.0),
                        xy,
                        float(heading) - side * np.pi / 2,
                    )
            s += run + rng.uniform(0, 25)


def street_trees(plan: Planner) -> None:
    """Rows of trees of one species along the sidewalk, at even distances."""
    for number, (index, road, stretch, land_use) in enumerate(plan.stretches()):
        rng = plan.rng("street trees", index, number)
        if not land_use.street_trees or rng.uniform() > min(land_use.street_trees / 4, 0.9):
            continue
        species, every = weighted_choice(rng, SPECIES), rng.uniform(8, 16)
        off = max(road.sidewalk - 0.7, 1.4) if rng.uniform() < 0.6 else road.sidewalk + 1.5
        s = np.arange(stretch.start + rng.uniform(0, every), stretch.end, every)
        xy, _ = road.beside(s, stretch.side, off)
        at = locate(plan.town.roads, xy)
        for place, other, outside in zip(xy, at.other_road, at.kerb_distance, strict=True):
            if other > 6 and outside > 0.6 and rng.uniform() < 0.93:
                plan.add_if_free(ObjectTemplate(_tree(rng, species), "tree", 0.5), place, float(rng.uniform(0, 6.28)))
