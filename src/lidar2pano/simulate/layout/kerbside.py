"""Kerbside: parked vehicles, lamps, signs, traffic lights, street furniture and standing people."""

from __future__ import annotations

import numpy as np

from lidar2pano.simulate.assets import barriers, furniture, people, traffic_signs, two_wheelers
from lidar2pano.simulate.layout.placement import Maker, ObjectTemplate, Planner
from lidar2pano.simulate.layout.roads import Road, locate
from lidar2pano.simulate.layout.traffic import VEHICLES
from lidar2pano.simulate.scene.random_streams import weighted_choice

PARKED = {"car": 30.0, "van": 3.0, "truck": 0.5, "trailer": 0.4, "motorcycle": 0.6}
LENGTH = {"car": 4.4, "van": 5.2, "truck": 8.5, "trailer": 5.0, "motorcycle": 2.2}

LAMP = ObjectTemplate(lambda rng, _: furniture.street_lamp(rng), "lamp", 0.3)
WIRE_POLE = ObjectTemplate(lambda rng, _: furniture.pole(rng), "pole", 0.3)
DELINEATOR = ObjectTemplate(lambda rng, _: barriers.delineator(rng), "delineator", 0.1)
STREET_NAME = ObjectTemplate(lambda rng, _: traffic_signs.sign(rng, "street name"), "sign", 0.2)
# Their x axis points at oncoming traffic; that of the others at the road.
SIGN = ObjectTemplate(lambda rng, _: traffic_signs.sign(rng), "sign", 0.2)
GIVE_WAY = ObjectTemplate(lambda rng, _: traffic_signs.sign(rng, "give way"), "sign", 0.2)
LIGHT = ObjectTemplate(lambda rng, _: furniture.traffic_light(rng), "traffic light", 0.3)
FACING_TRAFFIC = (SIGN, GIVE_WAY, LIGHT, DELINEATOR)
BIN = ObjectTemplate(lambda rng, _: furniture.bin(rng), "bin", 0.5)


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
            at = locate(plan.town.roads, xy[None])
            if at.other_road[0] > 7:
                turn = float(heading) + (np.pi if (side > 0) != (rng.uniform() < 0.08) else 0.0)
                yaw = turn + rng.normal(0, 0.015)
                plan.add_if_free(
                    ObjectTemplate(
                        VEHICLES[name], name, length / 2 - 0.4, on_sidewalk=False, follows_slope=True, has_instance=True
                    ),
                    xy,
                    yaw,
                )
        s += length + max(rng.normal(1.1, 0.4), 0.5)


def driveways(plan: Planner) -> None:
    """Cars, bicycles and bins in front of houses."""
    for number, (index, road, stretch, land_use) in enumerate(plan.stretches()):
        rng = plan.rng("driveways", index, number)
        count = rng.poisson((stretch.end - stretch.start) / 22) if land_use.building else 0
        for s in rng.uniform(stretch.start, stretch.end, count):
            name = weighted_choice(rng, {"car": 5.0, "van": 0.7, "bicycle": 2.0, "bin": 3.0, "trailer": 0.2})
            deep = road.sidewalk + {"bicycle": 0.9, "bin": 0.6}.get(name, 3.4)
            xy, heading = road.beside(s, stretch.side, deep)
            if locate(plan.town.roads, xy[None]).kerb_distance[0] < road.sidewalk:
                continue
            yaw = float(heading) - stretch.side * np.pi / 2 + rng.normal(0, 0.08)
            if name == "bin":
                plan.add_if_free(BIN, xy, yaw)
            else:
                radius = 1.0 if name == "bicycle" else 2.3
                plan.add_if_free(
                    ObjectTemplate(VEHICLES[name], name, radius, follows_slope=True, has_instance=True), xy, yaw
                )


def lamps(plan: Planner) -> None:
    """Street lamps at even distances on one side; utility poles along country roads."""
    for number, (index, road, stretch, land_use) in enumerate(plan.stretches()):
        if stretch.side != (1 if index % 2 else -1):
            continue
        rng = plan.rng("lamps", index, number)
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


def _beside(plan: Planner, road: Road, s: float, side: int, off: float, post: ObjectTemplate) -> None:
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
            _lights(plan, main, s, road.half_width)
        elif rng.uniform() < 0.7:
            away = main.half_width + main.sidewalk + 1.5
            _beside(plan, road, away, 1, 0.5, GIVE_WAY)
            ahead = s + side * (road.half_width + 3)
            _beside(plan, main, ahead, side, 0.5, STREET_NAME)


def _lights(plan: Planner, main: Road, s: float, half: float) -> None:
    for side in (-1, 1):
        # Traffic on the right (-1) stops before the junction; on the left it comes the other way.
        at = s + side * (half + 3.0)
        _beside(plan, main, at, side, 0.6, LIGHT)


def clutter(plan: Planner) -> None:
    """Bins, cabinets, benches, bicycles, bus stops and standing people."""
    makers: dict[str, tuple[Maker, float, float]] = {
        "bin": (lambda rng, _: furniture.bin(rng), 0.5, 1.0),
        "junction box": (lambda rng, _: furniture.junction_box(rng), 0.5, 0.6),
        "bench": (lambda rng, _: furniture.bench(rng), 0.9, 0.4),
        "bollard": (lambda rng, _: furniture.bollard(rng), 0.2, 1.0),
        "bicycle": (lambda rng, _: two_wheelers.bicycle(rng), 0.7, 1.6),
        "motorcycle": (lambda rng, _: two_wheelers.motorcycle(rng), 0.9, 0.35),
        "bus stop": (lambda rng, _: furniture.bus_stop(rng), 2.2, 0.12),
        "column": (lambda rng, _: furniture.advertising_column(rng), 0.9, 0.12),
        "person": (lambda rng, _: people.person(rng), 0.4, 1.2),
    }
    for number, (index, road, stretch, _) in enumerate(plan.stretches()):
        if not road.sidewalk:
            continue
        rng = plan.rng("clutter", index, number)
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
            plan.add_if_free(ObjectTemplate(make, name, radius, has_instance=counted), xy, yaw)
