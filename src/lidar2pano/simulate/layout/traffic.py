"""Moving objects: the recording car, and vehicles, cyclists and pedestrians, as functions of time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from lidar2pano.simulate.assets import motor_vehicles, people, two_wheelers
from lidar2pano.simulate.layout.placement import Maker, on_slope
from lidar2pano.simulate.layout.town import PLACES, ROAD_MARGIN, Town
from lidar2pano.simulate.scene.mesh import Mesh
from lidar2pano.simulate.scene.random_streams import stream, weighted_choice
from lidar2pano.simulate.scene.raycast import SceneObject

SENSOR_HEIGHT = 1.73  # metres above the road, as on KITTI's car
_MAKERS = {
    "car": motor_vehicles.car, "van": partial(motor_vehicles.car, body="van"), "truck": motor_vehicles.truck,
    "trailer": motor_vehicles.trailer, "bus": motor_vehicles.bus, "tram": motor_vehicles.tram,
    "motorcycle": two_wheelers.motorcycle, "bicycle": two_wheelers.bicycle, "motorcyclist": two_wheelers.motorcyclist,
    "bicyclist": two_wheelers.bicyclist,
}  # fmt: skip
VEHICLES: dict[str, Maker] = {name: lambda rng, _, make=make: make(rng) for name, make in _MAKERS.items()}
"""Makers of vehicles, with one level of detail."""
VIEW_RANGE = 110.0  # metres: farther actors are left out
Delay = Callable[[np.ndarray], float]
STRIDE = 1.45  # metres of a pedestrian's gait cycle, two steps
PHASES, NEAR = 8, 25.0  # poses of a gait cycle; beyond so many metres half of them serve
MIN_DISTANCE = 1.7  # metres: closer actors would be inside the recording car and are left out
LANE_CLEARANCE = 11.0  # metres in front of and behind the recording car in its lane
TRAFFIC_MIX: dict[str, dict[str, float]] = {
    "none": {"car": 20, "van": 2, "truck": 0.5, "motorcyclist": 0.5},
    "town": {"car": 20, "van": 2, "truck": 1.2, "bus": 1.0, "tram": 0.25, "motorcyclist": 0.7},
    "country": {"car": 20, "van": 2, "truck": 2.0, "bus": 0.4, "motorcyclist": 0.7},
    "motorway": {"car": 20, "van": 2.5, "truck": 6.0, "bus": 0.3},
}
HALF_LENGTH = {"truck": 8.0, "bus": 6.2, "tram": 16.0}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SpeedProfile:
    """Speed over time: a mean and two slow waves, never negative.

    mean    m/s;  waves (n, 3): amplitude as a share of the mean, period in seconds, phase.
    """

    mean: float
    waves: np.ndarray

    @classmethod
    def random(cls, rng: np.random.Generator, place: str) -> SpeedProfile:
        """A random speed profile for a place of PLACES; some are traffic jams."""
        mean = PLACES[place].speed * rng.uniform(0.55, 1.1)
        if rng.uniform() < (0.12 if PLACES[place].kerb else 0.0):
            mean = rng.uniform(0.0, 1.5)
        waves = np.stack([rng.uniform(0.02, 0.25, 2), rng.uniform(6, 22, 2), rng.uniform(0, 6.28, 2)], axis=1)
        return cls(mean=mean, waves=waves)

    def travelled(self, time: np.ndarray) -> np.ndarray:
        """Metres since time 0; (N,) seconds, possibly negative."""
        time = np.asarray(time, dtype=np.float64)
        share, number, phase = self.waves[:, 0], 2 * np.pi / self.waves[:, 1], self.waves[:, 2]
        swing = (share / number * (np.sin(number * time[..., None] + phase) - np.sin(phase))).sum(-1)
        return self.mean * (time + swing)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drive:
    """Trajectory of the recording car; `lane`: metres from the centreline of the main road, negative to the right."""

    town: Town
    speed: SpeedProfile
    lane: float
    sway: np.ndarray  # (3, 3): amplitude, period, phase of sideways metres, pitch and roll radians

    @classmethod
    def random(cls, town: Town, speed: SpeedProfile) -> Drive:
        """The drive of the town's seed."""
        rng = stream(town.seed, "drive")
        forward = [d for d, way in lanes(town) if way > 0]
        amplitude = [rng.uniform(0.02, 0.15), np.radians(rng.uniform(0.05, 0.25)), np.radians(rng.uniform(0.05, 0.3))]
        sway = np.stack([amplitude, rng.uniform([4, 0.8, 1.0], [12, 2.5, 3.0]), rng.uniform(0, 6.28, 3)], axis=1)
        return cls(town=town, speed=speed, lane=float(rng.choice(forward)), sway=sway)

    def along(self, time: np.ndarray) -> np.ndarray:
        """Metres (N,) along the main road."""
        return ROAD_MARGIN + self.speed.travelled(time)

    def poses(self, time: np.ndarray, height_m: float = SENSOR_HEIGHT) -> np.ndarray:
        """T_world_lidar (N, 4, 4) float64 at times (N,) seconds, of a sensor some metres above the road."""
        time = np.asarray(time, dtype=np.float64).reshape(-1)
        wave = self.sway[:, 0] * np.sin(2 * np.pi * time[:, None] / self.sway[:, 1] + self.sway[:, 2])
        xy, heading = self.town.roads[0].at(self.along(time), self.lane + wave[:, 0])
        up = self.town.terrain.normal(xy)
        ahead = np.stack([np.cos(heading), np.sin(heading), np.zeros_like(heading)], axis=1)
        left = np.cross(up, ahead)
        # Suspension: the body pitches and rolls a little against the road.
        up = up + ahead * wave[:, 1:2] + left * wave[:, 2:3]
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        ahead -= up * (ahead * up).sum(1, keepdims=True)
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        T = np.tile(np.eye(4), (len(time), 1, 1))
        T[:, :3, :3] = np.stack([ahead, np.cross(up, ahead), up], axis=2)
        T[:, :2, 3] = xy
        T[:, 2, 3] = self.town.terrain.height(xy)
        T[:, :3, 3] += height_m * up
        return T


def lanes(town: Town) -> list[tuple[float, int]]:
    """Lanes of the main road: offset from the centreline (metres, left positive), direction of travel (+1 along s)."""
    road = town.roads[0]
    if road.marking == "motorway":
        inner = road.median + 2.5
        return [(-inner, 1), (-inner - 3.75, 1), (inner, -1), (inner + 3.75, -1)]
    aside = road.half_width / 2 if road.marking != "none" else 0.95
    return [(-aside, 1), (aside, -1)]


@dataclass(slots=True, eq=False)
class Actor:
    """A moving object on the main road. Metres, seconds.

    make       (random generator, phase of the gait) -> mesh;  name, number: of its random stream.
    start      along the road at time 0;  travelled: distance since then, at times (N,);  direction: +1 or -1.
    offset     from the centreline;  stride: length of a gait cycle (0 = none).
    """

    make: Callable[[np.random.Generator, float], Mesh]
    name: str
    number: int
    start: float
    travelled: Callable[[np.ndarray], np.ndarray]
    direction: int
    offset: float
    half_length: float = 2.5
    on_sidewalk: bool = False
    stride: float = 0.0
    meshes: dict[int, Mesh] = field(default_factory=dict[int, Mesh])

    def along(self, time: float, length: float) -> float:
        """Metres along the road; actors leave at one end and return at the other."""
        return (self.start + self.direction * float(self.travelled(np.array(time)))) % length

    def mesh(self, seed: int, time: float, away: float) -> Mesh:
        """The mesh in the object frame at a time, for a viewer at `away` metres."""
        far = float(self.travelled(np.array(time)))
        step = int(far / self.stride * PHASES) % PHASES if self.stride else 0
        step -= step % (1 if away < NEAR else 2)
        if step not in self.meshes:
            self.meshes[step] = self.make(stream(seed, "actor", self.name, self.number), step / PHASES)
        return self.meshes[step]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Traffic:
    """All actors of a drive; their instance numbers start at `first`."""

    town: Town
    actors: tuple[Actor, ...]
    first: int

    def objects(self, time: float, near: np.ndarray, delay: Delay | None = None) -> list[SceneObject]:
        """Actors within VIEW_RANGE of a point `near` (2,), at a time in seconds.

        delay  function from position (3,) to seconds: a LiDAR passes each actor at another time.
        """
        out, road = [], self.town.roads[0]
        along = np.array([actor.along(time, road.length) for actor in self.actors])
        xy, _ = road.at(along, np.array([actor.offset for actor in self.actors]))
        away = np.hypot(*(xy - near).T)
        visible = (away <= VIEW_RANGE + np.array([actor.half_length for actor in self.actors])) & (away >= MIN_DISTANCE)
        for number in np.flatnonzero(visible).tolist():
            actor = self.actors[number]
            then = time + (delay(np.array(self._place(actor, time)[0])) if delay else 0.0)
            position, yaw = self._place(actor, then)
            normal = tuple(self.town.terrain.normal(np.array(position[:2])).tolist())
            mesh = on_slope(actor.mesh(self.town.seed, then, float(away[number])), position, yaw, normal)
            out.append(SceneObject(mesh=mesh, instance=self.first + number, moving=True))
        return out

    def _place(self, actor: Actor, time: float) -> tuple[tuple[float, float, float], float]:
        """Position of an actor, metres, and its yaw."""
        road = self.town.roads[0]
        xy, heading = road.at(np.array(actor.along(time, road.length)), actor.offset)
        z = float(self.town.height(xy, on_sidewalk=actor.on_sidewalk))
        return (float(xy[0]), float(xy[1]), z), float(heading) + (0.0 if actor.direction > 0 else np.pi)


def build_traffic(drive: Drive, first: int) -> Traffic:
    """The traffic around a drive."""
    actors = (*_vehicles(drive), *_cyclists(drive.town), *_walkers(drive.town))
    return Traffic(town=drive.town, actors=actors, first=first)


def _vehicles(drive: Drive) -> Iterator[Actor]:
    town, road = drive.town, drive.town.roads[0]
    for lane, (offset, direction) in enumerate(lanes(town)):
        rng = stream(town.seed, "traffic", lane)
        own_lane = abs(offset - drive.lane) < 0.01
        factor = 1.0 if own_lane else rng.uniform(0.85, 1.2)
        # Slow traffic has shorter gaps.
        gap = town.place.vehicle_gap * (0.35 if drive.speed.mean < 2 and own_lane else 1.0)
        s, number = rng.exponential(gap), 0
        while s < road.length - 25:
            name = weighted_choice(rng, town.place.mix(TRAFFIC_MIX[road.marking]))
            half = HALF_LENGTH.get(name, 2.5)
            s += half
            start = drive.along(np.zeros(1))[0]
            if not (own_lane and abs(s - start) < LANE_CLEARANCE + half):
                like_drive = own_lane or direction > 0
                travelled = _like_drive(drive, factor) if like_drive else _steady(town.place.speed * factor)
                aside = offset + rng.normal(0, 0.1)
                yield Actor(VEHICLES[name], f"{name} {lane}", number, s, travelled, direction, aside, half)
            number += 1
            s += half + 5.0 + rng.exponential(gap)


def _like_drive(drive: Drive, factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda time: drive.speed.travelled(time) * factor


def _steady(speed: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda time: speed * np.asarray(time)


def _cyclists(town: Town) -> Iterator[Actor]:
    road, rng = town.roads[0], stream(town.seed, "cyclists")
    offset = road.half_width - 0.7 if road.marking != "none" else 1.5
    for number in range(rng.poisson(town.place.cyclists * road.length / 100)):
        direction = int(rng.choice([-1, 1]))
        speed, s = rng.uniform(3.2, 6.5), rng.uniform(0, road.length)
        yield Actor(VEHICLES["bicyclist"], "bicyclist", number, s, _steady(speed), direction, -direction * offset, 1.0)


def _walkers(town: Town) -> Iterator[Actor]:
    road, rng = town.roads[0], stream(town.seed, "walkers")
    for number in range(rng.poisson(town.place.walkers * road.length / 100)):
        side, direction = int(rng.choice([-1, 1])), int(rng.choice([-1, 1]))
        s, speed = rng.uniform(0, road.length), rng.uniform(0.9, 1.7)
        offset = side * (road.half_width + 2.2 * bool(road.bays) + max(road.sidewalk, 1.0) * rng.uniform(0.3, 0.75))
        yield Actor(
            people.person, "walker", number, s, _steady(speed), direction, offset, 0.4, on_sidewalk=True, stride=STRIDE
        )
