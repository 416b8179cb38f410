"""The sides of the roads: buildings and their borders, plants, parked vehicles, signs, street furniture and people."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lidar2pano.simulate.assets import barriers, buildings, people, plants, street_furniture, two_wheelers
from lidar2pano.simulate.layout.placement import Maker, Planner, Template
from lidar2pano.simulate.layout.roads import Road, locate
from lidar2pano.simulate.layout.town import LandUse, Stretch, clear_of_roads
from lidar2pano.simulate.layout.traffic import VEHICLES
from lidar2pano.simulate.scene.mesh import Mesh
from lidar2pano.simulate.scene.random_streams import weighted_choice

Rng = np.random.Generator
BUILDINGS: dict[str, Callable[..., Mesh]] = {
    "house": buildings.house, "terrace": buildings.house, "flats": buildings.flats, "hall": buildings.hall,
    "shed": lambda rng, *_: buildings.shed(rng), "garage": lambda rng, *_: buildings.garage(rng),
}  # fmt: skip
BARRIERS = {
    "picket": barriers.picket_fence, "wire": barriers.wire_fence, "railing": barriers.railing,
    "wall": barriers.wall, "noise": barriers.noise_barrier, "guard": barriers.guard_rail,
}  # fmt: skip
SPECIES = {
    "linden": 3.0, "maple": 3.0, "birch": 2.0, "oak": 2.0, "poplar": 0.6, "fruit": 1.6, "globe": 0.5, "spruce": 1.4,
    "pine": 0.9,
}  # fmt: skip
TREES: dict[str, Maker] = {name: lambda rng, detail, name=name: plants.tree(rng, name, detail) for name in SPECIES}
PARKED = {"car": 30.0, "van": 3.0, "truck": 0.5, "trailer": 0.4, "motorcycle": 0.6}
LENGTH = {"car": 4.4, "van": 5.2, "truck": 8.5, "trailer": 5.0, "motorcycle": 2.2}
LAMP = Template(lambda rng, _: street_furniture.street_lamp(rng), "lamp", 0.3)
WIRE_POLE = Template(lambda rng, _: street_furniture.pole(rng), "pole", 0.3)
DELINEATOR = Template(lambda rng, _: barriers.delineator(rng), "delineator", 0.1)
STREET_NAME = Template(lambda rng, _: street_furniture.sign(rng, "street name"), "sign", 0.2)
# Their x axis points at oncoming traffic; the others' at the road.
SIGN = Template(lambda rng, _: street_furniture.sign(rng), "sign", 0.2)
GIVE_WAY = Template(lambda rng, _: street_furniture.sign(rng, "give way"), "sign", 0.2)
LIGHT = Template(lambda rng, _: street_furniture.traffic_light(rng), "traffic light", 0.3)
FACING_TRAFFIC = (SIGN, GIVE_WAY, LIGHT, DELINEATOR)
BIN = Template(lambda rng, _: street_furniture.bin(rng), "bin", 0.5)


def _building_maker(make: str, wide: float, deep: float) -> Maker:
    """The maker of a building of `wide` x `deep` metres."""
    return lambda rng, _: BUILDINGS[make](rng, wide, deep)


def place_buildings(plan: Planner) -> None:
    """A building on every lot with room for it, a second row along the main road, garages beside some houses."""
    for rng, road, stretch, land_use in plan.stretches("lots"):
        if land_use.building:
            _row(plan, rng, road, stretch, land_use, behind=0.0)
            if road is plan.town.roads[0]:
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
    make = _building_maker(land_use.building, wide, deep)
    plan.add(Template(make, land_use.building, max(wide, deep) / 1.6), xy, yaw)
    if land_use.building == "house" and rng.uniform() < 0.45:
        turned, place = _facing(road, s + rng.choice([-1, 1]) * (wide / 2 + 2.2), stretch.side, road.sidewalk + off + 4)
        if clear_of_roads(plan.town.roads, _corners(place, turned, 6, 3.2), 0.2).all():
            plan.add_if_free(Template(_building_maker("garage", 3, 6), "garage", 2.0), place, turned)


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
    for rng, road, stretch, land_use in plan.stretches("borders"):
        if not land_use.borders:
            continue
        s = stretch.start
        while s < stretch.end - 3:
            barrier = weighted_choice(rng, land_use.borders)
            run = min(rng.uniform(9, 17) if barrier != "noise" else 1e3, stretch.end - s)
            if barrier != "none":
                _place_border(plan, rng, road, stretch.side, barrier, (s, s + run))
            s += run + rng.uniform(1.2, 4.5)


def _place_border(plan: Planner, rng: Rng, road: Road, side: int, barrier: str, span: tuple[float, float]) -> None:
    """Straight pieces along the road, left out where a road or building is in the way."""
    piece, off = 14.0, 4.0 if barrier == "noise" else 0.35
    height = rng.uniform(0.8, 1.9)
    for first in np.arange(span[0], span[1], piece):
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
        make = _barrier(plan, barrier, xy[0], yaw, length, height)
        plan.add(Template(make, f"border {barrier}", 0.0), xy[0], yaw)


def _barrier(plan: Planner, barrier: str, start: np.ndarray, yaw: float, length: float, height: float) -> Maker:
    """The maker of a barrier along the terrain, from `start` along `yaw`."""
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
    return lambda rng, _: BARRIERS[barrier](rng, length, land)


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
            plan.add(Template(rail, "guard rail", 0.0), xy[0], yaw)


def yards(plan: Planner) -> None:
    """Trees and bushes on the lots and behind them."""
    for rng, road, stretch, land_use in plan.stretches("yards"):
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
    for rng, road, stretch, land_use in plan.stretches("shrubs"):
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
    draw, turn = rng.uniform(size=len(xy)), rng.uniform(0, 6.28, len(xy))
    for place in np.flatnonzero(clear):
        plant = Template(plants.bush, "bush", 0.7) if draw[place] < bushes else Template(_tree(rng), "tree", 1.5)
        plan.add_if_free(plant, xy[place], float(turn[place]))


def _tree(rng: Rng, species: str = "") -> Maker:
    return TREES[species or weighted_choice(rng, SPECIES)]


def horizon(plan: Planner) -> None:
    """Distant trees and houses at the end of the view along the main road."""
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
                    plan.add_if_free(Template(_tree(rng), "far tree", 1.8), place, float(rng.uniform(0, 6.28)))
            elif plan.town.place.kerb:
                xy, heading = road.at(np.array(s + run / 2), side * away)
                if clear_of_roads(plan.town.roads, xy[None], 12.0)[0]:
                    house = Template(_building_maker("house", rng.uniform(9, 13), rng.uniform(9, 12)), "house", 7.0)
                    plan.add_if_free(house, xy, float(heading) - side * np.pi / 2)
            s += run + rng.uniform(0, 25)


def street_trees(plan: Planner) -> None:
    """Rows of trees of one species along the sidewalk, at even distances."""
    for rng, road, stretch, land_use in plan.stretches("street trees"):
        if not land_use.street_trees or rng.uniform() > min(land_use.street_trees / 4, 0.9):
            continue
        species, every = weighted_choice(rng, SPECIES), rng.uniform(8, 16)
        off = max(road.sidewalk - 0.7, 1.4) if rng.uniform() < 0.6 else road.sidewalk + 1.5
        s = np.arange(stretch.start + rng.uniform(0, every), stretch.end, every)
        xy, _ = road.beside(s, stretch.side, off)
        at = locate(plan.town.roads, xy)
        for place, other, outside in zip(xy, at.other_road, at.kerb_distance, strict=True):
            if other > 6 and outside > 0.6 and rng.uniform() < 0.93:
                plan.add_if_free(Template(_tree(rng, species), "tree", 0.5), place, float(rng.uniform(0, 6.28)))


def parked(plan: Planner) -> None:
    """Parked vehicles along the kerbs: in bays, or at the edge of the carriageway."""
    place = plan.town.place
    for index, road in enumerate(plan.town.roads):
        for side in (-1, 1):
            rng = plan.rng("parked", index, side)
            if road.sidewalk:
                _kerb_row(plan, rng, road, side, place.parked_share * rng.uniform(0.4, 1.4))


def _kerb_row(plan: Planner, rng: np.random.Generator, road: Road, side: int, share: float) -> None:
    s = rng.uniform(0, 8)
    occupied = rng.uniform() < share
    narrow = road.half_width < 2.6 and side > 0  # one side of narrow roads stays free
    while s < road.length - 8:
        if rng.uniform() < 0.12:  # rows of parked cars begin and end
            occupied = rng.uniform() < share
        name = weighted_choice(rng, plan.town.place.mix(PARKED))
        length = LENGTH[name]
        middle = s + length / 2
        edge = float(road.kerb_offset(np.array(middle), np.array(side)))
        in_bay = edge > road.half_width + 2
        free = plan.town.place.marking == "none" and not narrow
        if (occupied and (in_bay or free)) or (in_bay and rng.uniform() < 0.6):
            off = edge - (1.05 if in_bay else 1.0) + rng.normal(0, 0.07)
            xy, heading = road.at(np.array(middle), side * off)
            if locate(plan.town.roads, xy[None]).other_road[0] > 7:
                turn = float(heading) + (np.pi if (side > 0) != (rng.uniform() < 0.08) else 0.0)
                vehicle = _vehicle(name, length / 2 - 0.4)._replace(on_sidewalk=False)
                plan.add_if_free(vehicle, xy, turn + rng.normal(0, 0.015))
        s += length + max(rng.normal(1.1, 0.4), 0.5)


def _vehicle(name: str, radius: float) -> Template:
    return Template(VEHICLES[name], name, radius, follows_slope=True, has_instance=True)


def driveways(plan: Planner) -> None:
    """Cars, bicycles and bins in front of houses."""
    for rng, road, stretch, land_use in plan.stretches("driveways"):
        count = rng.poisson((stretch.end - stretch.start) / 22) if land_use.building else 0
        for s in rng.uniform(stretch.start, stretch.end, count):
            name = weighted_choice(rng, {"car": 5.0, "van": 0.7, "bicycle": 2.0, "bin": 3.0, "trailer": 0.2})
            deep = road.sidewalk + {"bicycle": 0.9, "bin": 0.6}.get(name, 3.4)
            xy, heading = road.beside(s, stretch.side, deep)
            if locate(plan.town.roads, xy[None]).kerb_distance[0] < road.sidewalk:
                continue
            yaw = float(heading) - stretch.side * np.pi / 2 + rng.normal(0, 0.08)
            plan.add_if_free(BIN if name == "bin" else _vehicle(name, 1.0 if name == "bicycle" else 2.3), xy, yaw)


def lamps(plan: Planner) -> None:
    """Street lamps at even distances on one side; utility poles along country roads."""
    for rng, road, stretch, land_use in plan.stretches("lamps"):
        if stretch.side != (1 if plan.town.roads.index(road) % 2 else -1):
            continue
        every = land_use.lamp_spacing or (45.0 if rng.uniform() < 0.25 else 0.0)
        if not every:
            continue
        post = LAMP if land_use.lamp_spacing else WIRE_POLE
        for s in np.arange(stretch.start + rng.uniform(0, 12), stretch.end, every):
            off = road.sidewalk - 0.45 if road.sidewalk and rng.uniform() < 0.7 else 0.5
            _beside(plan, road, float(s), stretch.side, off, post)


def delineators(plan: Planner) -> None:
    """Delineators along both edges of roads without sidewalks."""
    for road in plan.town.roads:
        if road.sidewalk:
            continue
        for side in (-1, 1):
            for s in np.arange(5.0, road.length, 25.0):
                _beside(plan, road, float(s), side, 0.6, DELINEATOR)


def _beside(plan: Planner, road: Road, s: float, side: int, off: float, post: Template) -> None:
    """Place a post `off` metres beyond the kerb, unless another road is there."""
    xy, heading = road.beside(s, side, off)
    if locate(plan.town.roads, xy[None]).kerb_distance[0] > 0.2:
        turn = (np.pi if side < 0 else 0.0) if post in FACING_TRAFFIC else -side * np.pi / 2
        plan.add_if_free(post, xy, float(heading) + turn)


def signs(plan: Planner) -> None:
    """Traffic signs: by rule at junctions, at random along the roads."""
    for index, road in enumerate(plan.town.roads):
        rng = plan.rng("signs", index)
        for side in (-1, 1):
            for s in np.cumsum(rng.uniform(8, 26, int(road.length / 8))):
                if s < road.length - 3:
                    _beside(plan, road, float(s), side, 0.45, SIGN)
    main = plan.town.roads[0]
    rng = plan.rng("junction signs")
    for number, (s, side) in enumerate(plan.town.junctions):
        road = plan.town.roads[number + 1]
        if rng.uniform() < plan.town.place.light_share:
            for way in (-1, 1):  # traffic on the right (-1) stops before the junction, on the left behind it
                _beside(plan, main, s + way * (road.half_width + 3.0), way, 0.6, LIGHT)
        elif rng.uniform() < 0.7:
            _beside(plan, road, main.half_width + main.sidewalk + 1.5, 1, 0.5, GIVE_WAY)
            _beside(plan, main, s + side * (road.half_width + 3), side, 0.5, STREET_NAME)


def clutter(plan: Planner) -> None:
    """Bins, cabinets, benches, bicycles, bus stops and standing people."""
    makers: dict[str, tuple[Maker, float, float]] = {
        "bin": (lambda rng, _: street_furniture.bin(rng), 0.5, 1.0),
        "junction box": (lambda rng, _: street_furniture.junction_box(rng), 0.5, 0.6),
        "bench": (lambda rng, _: street_furniture.bench(rng), 0.9, 0.4),
        "bollard": (lambda rng, _: street_furniture.bollard(rng), 0.2, 1.0),
        "bicycle": (lambda rng, _: two_wheelers.bicycle(rng), 0.7, 1.6),
        "motorcycle": (lambda rng, _: two_wheelers.motorcycle(rng), 0.9, 0.35),
        "bus stop": (lambda rng, _: street_furniture.bus_stop(rng), 2.2, 0.12),
        "column": (lambda rng, _: street_furniture.advertising_column(rng), 0.9, 0.12),
        "person": (lambda rng, _: people.person(rng), 0.4, 1.2),
    }
    for rng, road, stretch, _ in plan.stretches("clutter"):
        if not road.sidewalk:
            continue
        for s in rng.uniform(stretch.start, stretch.end, rng.poisson((stretch.end - stretch.start) / 18)):
            name = weighted_choice(rng, plan.town.place.mix({key: row[2] for key, row in makers.items()}))
            make, radius, _ = makers[name]
            xy, heading = road.beside(s, stretch.side, max(road.sidewalk - 0.5, 0.6))
            if locate(plan.town.roads, xy[None]).kerb_distance[0] < 0.4:
                continue
            yaw = float(heading) + (rng.uniform(0, 6.28) if name == "person" else -stretch.side * np.pi / 2)
            if name in ("bicycle", "motorcycle"):
                yaw += np.pi / 2
            counted = name in ("bicycle", "motorcycle", "person")
            plan.add_if_free(Template(make, name, radius, has_instance=counted), xy, yaw)


STEPS: tuple[Callable[[Planner], None], ...] = (
    place_buildings, borders, parked, lamps, signs, delineators, street_trees, driveways, clutter, shrubs, yards,
    horizon, guard_rails,
)  # fmt: skip
"""The steps of a plan, in their order: where a footprint is occupied, later ones leave their objects out."""
