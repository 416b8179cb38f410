"""The world: one drive through one town, built window by window within the range of view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidar2pano.simulate.layout.ground import ground, markings
from lidar2pano.simulate.layout.placement import PlacedObject, Planner
from lidar2pano.simulate.layout.roadside import STEPS
from lidar2pano.simulate.layout.town import PLACES, ROAD_MARGIN, Town, build_town
from lidar2pano.simulate.layout.traffic import Delay, Drive, SpeedProfile, Traffic, build_traffic
from lidar2pano.simulate.scene.random_streams import stream, weighted_choice
from lidar2pano.simulate.scene.raycast import Scene, SceneObject

VIEW_RANGE = 125.0  # metres around the drive within which the world is built
WINDOW = 40.0  # metres of the drive with one static scene
NEAR, MIDDLE = 28.0, 60.0  # metres from the drive: full detail, a third of it, and less beyond


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class World:
    """A drive of `seconds`, a pure function of the seed, the seconds and the place.

    objects  static ones, in the order of their instance numbers.
    """

    seed: int
    seconds: float
    town: Town
    drive: Drive
    objects: tuple[PlacedObject, ...]
    traffic: Traffic

    def window(self, number: int) -> Scene:
        """The static scene around the metres [number * WINDOW, (number + 1) * WINDOW) of the drive."""
        points = self._lane_points(number * WINDOW, (number + 1) * WINDOW)
        low, high = (np.rint(edge) for edge in (points.min(axis=0) - VIEW_RANGE, points.max(axis=0) + VIEW_RANGE))
        objects = [SceneObject(mesh=make(self.town, low, high)) for make in (ground, markings)]
        whole = self._lane_points(0.0, max(self.length, 1.0))
        instance = 0
        for placed in self.objects:
            instance += placed.template.has_instance
            if _distance(points, placed) < VIEW_RANGE:
                # Detail depends on the whole drive: no object changes its shape between windows.
                distance = _distance(whole, placed)
                mesh = placed.mesh(self.seed, 1.0 if distance < NEAR else 0.33 if distance < MIDDLE else 0.16)
                objects.append(SceneObject(mesh=mesh, instance=instance if placed.template.has_instance else 0))
        return Scene(objects)

    @property
    def length(self) -> float:
        """Metres of the drive."""
        return float(self.drive.speed.travelled(np.array(self.seconds)))

    def window_at(self, time: float) -> int:
        """The number of the window for a time in seconds."""
        return max(int(float(self.drive.speed.travelled(np.array(time))) / WINDOW), 0)

    def _lane_points(self, first: float, last: float) -> np.ndarray:
        """Points (N, 2) of the drive's lane every two metres, from `first` to `last` metres after its start."""
        s = ROAD_MARGIN + np.linspace(first, last, int((last - first) / 2) + 2)
        return self.town.roads[0].at(s, self.drive.lane)[0]

    def scene_at(self, static: Scene, time: float, delay: Delay | None = None) -> Scene:
        """The static scene with the moving objects at a time in seconds, or `delay` later (Traffic.objects)."""
        near = self.drive.poses(np.array([time]))[0, :2, 3]
        return static.with_moving(self.traffic.objects(time, near, delay))


def _distance(points: np.ndarray, placed: PlacedObject) -> float:
    return float(np.sqrt(((points - placed.position[:2]) ** 2).sum(1).min())) - placed.template.radius


def build_world(seed: int, seconds: float, place: str = "") -> World:
    """The world of a seed; `place` in PLACES, "" = random."""
    rng = stream(seed, "world")
    name = weighted_choice(rng, {name: row.share for name, row in PLACES.items()})
    name = place or name
    speed = SpeedProfile.random(stream(seed, "speed"), name)
    length = float(speed.travelled(np.array(seconds)))
    town = build_town(seed, max(length, 1.0), name)
    drive = Drive.random(town, speed)
    plan = Planner(town=town)
    for step in STEPS:
        step(plan)
    return World(
        seed=seed,
        seconds=seconds,
        town=town,
        drive=drive,
        objects=tuple(plan.objects),
        traffic=build_traffic(drive, sum(placed.template.has_instance for placed in plan.objects) + 1),
    )
