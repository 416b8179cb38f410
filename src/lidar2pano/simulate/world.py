"""World: one drive through one town, built piece by piece as far as it can be seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidar2pano.simulate import kerbside, lots
from lidar2pano.simulate.draws import stream
from lidar2pano.simulate.drive import Drive, Speed
from lidar2pano.simulate.ground import ground
from lidar2pano.simulate.markings import markings
from lidar2pano.simulate.places import PLACES, QUARTERS, chosen
from lidar2pano.simulate.planner import Planner
from lidar2pano.simulate.raycast import Part, Scene
from lidar2pano.simulate.things import Thing
from lidar2pano.simulate.town import Town, town
from lidar2pano.simulate.traffic import Traffic, traffic

SIGHT = 125.0  # metres around the way within which the world is built
WINDOW = 2.0  # seconds that share one piece of the world
NEAR, MIDDLE = 28.0, 60.0  # metres from the way: full detail, half of it, a little


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
        """The standing scene around the times [number * WINDOW, (number + 1) * WINDOW)."""
        way = self.drive.poses(np.linspace(number, number + 1, 21) * WINDOW)[:, :2, 3]
        low, high = (np.rint(edge) for edge in (way.min(axis=0) - SIGHT, way.max(axis=0) + SIGHT))
        parts = [Part(mesh=self._ground(low, high)), Part(mesh=markings(self.town, low, high))]
        instance = 0
        for thing in self.things:
            instance += thing.counted
            away = float(np.hypot(*(way - thing.at[:2]).T).min()) - thing.radius
            if away < SIGHT:
                detail = 1.0 if away < NEAR else 0.45 if away < MIDDLE else 0.16
                parts.append(Part(mesh=thing.mesh(self.seed, detail), instance=instance if thing.counted else 0))
        return Scene(parts)

    def _ground(self, low: np.ndarray, high: np.ndarray):  # noqa: ANN202 a Mesh
        lands = [quarter.land for quarter in QUARTERS.values()]
        return ground(self.town.roads, self.town.terrain, low, high, lands, self.town.quarters)

    def scene_at(self, standing: Scene, time: float) -> Scene:
        """The window's scene with what moves where it is at a time in seconds."""
        near = self.drive.poses(np.array([time]))[0, :2, 3]
        return standing.with_moving(self.traffic.parts(time, near))


def world(seed: int, seconds: float, place: str = "") -> World:
    """The world of a seed; `place` in PLACES, or drawn."""
    rng = stream(seed, "world")
    name = chosen(rng, {name: row.share for name, row in PLACES.items()})
    name = place or name
    speed = Speed.drawn(stream(seed, "speed"), name)
    length = float(speed.travelled(np.array(seconds)))
    built = town(seed, max(length, 1.0), name)
    drive = Drive.drawn(built, speed)
    plan = Planner(town=built)
    for step in (
        lots.buildings, lots.borders, kerbside.parked, kerbside.lamps, kerbside.signs, lots.street_trees,
        kerbside.driveways, kerbside.clutter, lots.yards, lots.horizon, lots.guard_rails,
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
