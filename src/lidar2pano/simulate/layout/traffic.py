"""Traffic: vehicles, cyclists and walkers that move, as functions of time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from lidar2pano.simulate.assets import cars, large_vehicles, people, two_wheelers
from lidar2pano.simulate.layout.drive import Drive, lanes
from lidar2pano.simulate.layout.placement import Maker, set_on
from lidar2pano.simulate.layout.town import Town
from lidar2pano.simulate.scene.mesh import Mesh
from lidar2pano.simulate.scene.random_streams import stream, weighted_choice
from lidar2pano.simulate.scene.raycast import SceneObject

_MAKERS = {
    "car": cars.car,
    "van": partial(cars.car, body="van"),
    "truck": large_vehicles.truck,
    "trailer": large_vehicles.trailer,
    "bus": large_vehicles.bus,
    "tram": large_vehicles.tram,
    "motorcycle": two_wheelers.motorcycle,
    "bicycle": two_wheelers.bicycle,
    "motorcyclist": two_wheelers.motorcyclist,
    "bicyclist": two_wheelers.bicyclist,
}


def _made(rng: np.random.Generator, _: float, name: str) -> Mesh:
    return _MAKERS[name](rng)


VEHICLES: dict[str, Maker] = {name: partial(_made, name=name) for name in _MAKERS}
"""Makers of vehicles, which have one detail and no gait."""


SIGHT = 110.0  # metres: farther actors are left out
Delay = Callable[[np.ndarray], float]
STRIDE = 1.45  # metres that a walker's two steps take
PHASES, CLOSE = 8, 25.0  # pictures of one stride; farther away than so many metres half of them do
TOUCH = 1.7  # metres: an actor that close would be inside the recording car, and is left out
CLEAR = 11.0  # metres before and behind the recording car in its own lane

MIX: dict[str, dict[str, float]] = {
    "none": {"car": 20, "van": 2, "truck": 0.5, "motorcyclist": 0.5},
    "town": {"car": 20, "van": 2, "truck": 1.2, "bus": 1.0, "tram": 0.25, "motorcyclist": 0.7},
    "country": {"car": 20, "van": 2, "truck": 2.0, "bus": 0.4, "motorcyclist": 0.7},
    "motorway": {"car": 20, "van": 2.5, "truck": 6.0, "bus": 0.3},
}
HALF_LENGTH = {"truck": 8.0, "bus": 6.2, "tram": 16.0}


@dataclass(slots=True, eq=False)
class Actor:
    """Something that moves along the main road.

    make    (rng, phase of the gait) -> mesh;  name, number: of its random stream;  half: half its length, metres.
    start   metres along the road at time 0;  travelled: metres since then, of times (N,);  way +1 or -1.
    aside   metres from the centreline;  raised: on the pavement;  gait: metres of one stride (0 = none).
    """

    make: Callable[[np.random.Generator, float], Mesh]
    name: str
    number: int
    start: float
    travelled: Callable[[np.ndarray], np.ndarray]
    way: int
    aside: float
    half: float = 2.5
    raised: bool = False
    gait: float = 0.0
    shapes: dict[int, Mesh] = field(default_factory=dict[int, Mesh])

    def along(self, time: float, length: float) -> float:
        """Metres along the road; who leaves at one end comes in at the other."""
        return (self.start + self.way * float(self.travelled(np.array(time)))) % length

    def mesh(self, seed: int, time: float, away: float) -> Mesh:
        """The mesh at a time, at its own origin, as it is seen from `away` metres."""
        far = float(self.travelled(np.array(time)))
        step = int(far / self.gait * PHASES) % PHASES if self.gait else 0
        step -= step % (1 if away < CLOSE else 2)
        if step not in self.shapes:
            self.shapes[step] = self.make(stream(seed, "actor", self.name, self.number), step / PHASES)
        return self.shapes[step]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Traffic:
    """All actors of a drive; instance numbers count on from `first`."""

    town: Town
    actors: tuple[Actor, ...]
    first: int

    def parts(self, time: float, near: np.ndarray, delay: Delay | None = None) -> list[SceneObject]:
        """Actors within SIGHT of the place `near` (2,), in place, at a time in seconds.

        delay  how much later each one is seen, by its place (3,): a LiDAR does not look everywhere at once.
        """
        if not self.actors:
            return []
        out, road = [], self.town.roads[0]
        along = np.array([actor.along(time, road.length) for actor in self.actors])
        xy, _ = road.at(along, np.array([actor.aside for actor in self.actors]))
        away = np.hypot(*(xy - near).T)
        seen = (away <= SIGHT + np.array([actor.half for actor in self.actors])) & (away >= TOUCH)
        for number in np.flatnonzero(seen).tolist():
            actor = self.actors[number]
            then = time + (delay(np.array(self._place(actor, time)[0])) if delay else 0.0)
            at, yaw = self._place(actor, then)
            normal = tuple(self.town.terrain.normal(np.array(at[:2])).tolist())
            mesh = set_on(actor.mesh(self.town.seed, then, float(away[number])), at, yaw, normal)
            out.append(SceneObject(mesh=mesh, instance=self.first + number, moving=True))
        return out

    def _place(self, actor: Actor, time: float) -> tuple[tuple[float, float, float], float]:
        """Where an actor stands, metres, and its yaw."""
        road = self.town.roads[0]
        xy, heading = road.at(np.array(actor.along(time, road.length)), actor.aside)
        z = float(self.town.height(xy, raised=actor.raised))
        return (float(xy[0]), float(xy[1]), z), float(heading) + (0.0 if actor.way > 0 else np.pi)


def traffic(drive: Drive, first: int) -> Traffic:
    """The traffic that goes with a drive."""
    town = drive.town
    actors = [*_vehicles(drive), *_cyclists(town), *_walkers(town)]
    return Traffic(town=town, actors=tuple(actors), first=first)


def _vehicles(drive: Drive) -> Iterator[Actor]:
    town, road = drive.town, drive.town.roads[0]
    for lane, (aside, way) in enumerate(lanes(town)):
        rng = stream(town.seed, "traffic", lane)
        mine = abs(aside - drive.lane) < 0.01
        pace = 1.0 if mine else rng.uniform(0.85, 1.2)
        # Traffic that stands or crawls has shorter gaps.
        gap = town.place.gap * (0.35 if drive.speed.mean < 2 and mine else 1.0)
        s, number = rng.exponential(gap), 0
        while s < road.length - 25:
            name = weighted_choice(rng, MIX[road.marking])
            half = HALF_LENGTH.get(name, 2.5)
            s += half
            own = drive.along(np.zeros(1))[0]
            if not (mine and abs(s - own) < CLEAR + half):
                travelled = _paced(drive, pace) if mine or way > 0 else _steady(town.place.speed * pace)
                yield Actor(
                    VEHICLES[name], f"{name} {lane}", number, s, travelled, way, aside + rng.normal(0, 0.1), half
                )
            number += 1
            s += half + 5.0 + rng.exponential(gap)


def _paced(drive: Drive, pace: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda time: drive.speed.travelled(time) * pace


def _steady(speed: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda time: speed * np.asarray(time)


def _cyclists(town: Town) -> Iterator[Actor]:
    road, rng = town.roads[0], stream(town.seed, "cyclists")
    aside = road.half_width - 0.7 if road.marking != "none" else 1.5
    for number in range(rng.poisson(town.place.cyclists * road.length / 100)):
        way = int(rng.choice([-1, 1]))
        speed, s = rng.uniform(3.2, 6.5), rng.uniform(0, road.length)
        yield Actor(VEHICLES["bicyclist"], "bicyclist", number, s, _steady(speed), way, -way * aside, 1.0)


def _walkers(town: Town) -> Iterator[Actor]:
    road, rng = town.roads[0], stream(town.seed, "walkers")
    for number in range(rng.poisson(town.place.walkers * road.length / 100)):
        side, way = int(rng.choice([-1, 1])), int(rng.choice([-1, 1]))
        s, speed = rng.uniform(0, road.length), rng.uniform(0.9, 1.7)
        aside = side * (road.half_width + 2.2 * bool(road.bays) + max(road.sidewalk, 1.0) * rng.uniform(0.3, 0.75))
        yield Actor(people.person, "walker", number, s, _steady(speed), way, aside, 0.4, raised=True, gait=STRIDE)
