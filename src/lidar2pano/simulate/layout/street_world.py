"""World: one drive through one town, built piece by piece as far as it can be seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidar2pano.simulate.layout import kerbside, lots
from lidar2pano.simulate.layout.drive import Drive, Speed
from lidar2pano.simulate.layout.ground import ground
from lidar2pano.simulate.layout.placement import Planner, Thing
from lidar2pano.simulate.layout.places import PLACES, QUARTERS
from lidar2pano.simulate.layout.road_markings import markings
from lidar2pano.simulate.layout.town import AHEAD, Town, town
from lidar2pano.simulate.layout.traffic import Delay, Traffic, traffic
from lidar2pano.simulate.scene.random_streams import stream, weighted_choice
from lidar2pano.simulate.scene.raycast import Scene, SceneObject

SIGHT = 125.0  # metres around the way within which the world is built
WINDOW = 40.0  # metres of the drive that share one piece of the world
NEAR, MIDDLE = 28.0, 60.0  # metres from the whole way: full detail, a third of it, a little


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class World:
    """A drive of `seconds`; a pure function of the seed, the seconds and the place.

    things   all that stands, in the order of their instance numbers where they have one.
    """

    seed: int
    seconds: float
    town: Town
    drive: Drive
    things: tuple[Thing, ...]
    traffic: Traffic

    def window(self, number: int) -> Scene:
        """The standing scene around the metres [number * WINDOW, (number + 1) * WINDOW) of the drive."""
        way = self._way(number * WINDOW, (number + 1) * WINDOW)
        low, high = (np.rint(edge) for edge in (way.min(axis=0) - SIGHT, way.max(axis=0) + SIGHT))
        parts = [SceneObject(mesh=self._ground(low, high)), SceneObject(mesh=markings(self.town, low, high))]
        whole = self._way(0.0, max(self.length, 1.0))
        instance = 0
        for thing in self.things:
            instance += thing.counted
            if _away(way, thing) < SIGHT:
                # Detail goes with the whole drive: nothing changes its shape on the way.
                away = _away(whole, thing)
                detail = 1.0 if away < NEAR else 0.33 if away < MIDDLE else 0.16
                parts.append(SceneObject(mesh=thing.mesh(self.seed, detail), instance=instance if thing.counted else 0))
        return Scene(parts)

    @property
    def length(self) -> float:
        """Metres of the drive."""
        return float(self.drive.speed.travelled(np.array(self.seconds)))

    def window_at(self, time: float) -> int:
        """The number of the window for a time in seconds."""
        return max(int(float(self.drive.speed.travelled(np.array(time))) / WINDOW), 0)

    def _way(self, first: float, last: float) -> np.ndarray:
        """Places (N, 2) of the drive's lane every two metres, `first` and `last` metres after its start."""
        s = AHEAD + np.linspace(first, last, int((last - first) / 2) + 2)
        return self.town.roads[0].at(s, self.drive.lane)[0]

    def _ground(self, low: np.ndarray, high: np.ndarray):  # noqa: ANN202 a Mesh
        lands = [quarter.land for quarter in QUARTERS.values()]
        return ground(self.town.roads, self.town.terrain, low, high, lands, self.town.quarters)

    def scene_at(self, standing: Scene, time: float, delay: Delay | None = None) -> Scene:
        """The window's scene with what moves where it is at a time in seconds, or `delay` later (Traffic.parts)."""
        near = self.drive.poses(np.array([time]))[0, :2, 3]
        return standing.with_moving(self.traffic.parts(time, near, delay))


def _away(way: np.ndarray, thing: Thing) -> float:
    return float(np.sqrt(((way - thing.at[:2]) ** 2).sum(1).min())) - thing.radius


def world(seed: int, seconds: float, place: str = "") -> World:
    """The world of a seed; `place` in PLACES, or drawn."""
    rng = stream(seed, "world")
    name = weighted_choice(rng, {name: row.share for name, row in PLACES.items()})
    name = place or name
    speed = Speed.drawn(stream(seed, "speed"), name)
    length = float(speed.travelled(np.array(seconds)))
    built = town(seed, max(length, 1.0), name)
    drive = Drive.drawn(built, speed)
    plan = Planner(town=built)
    for step in (
        lots.buildings, lots.borders, kerbside.parked, kerbside.lamps, kerbside.signs, kerbside.delineators,
        lots.street_trees, kerbside.driveways, kerbside.clutter, lots.shrubs, lots.yards, lots.horizon,
        lots.guard_rails,
    ):  # fmt: skip
        step(plan)
    counted = sum(thing.counted for thing in plan.things)
    return World(
        seed=seed,
        seconds=seconds,
        town=built,
        drive=drive,
        things=tuple(plan.things),
        traffic=traffic(drive, counted + 1),
    )
