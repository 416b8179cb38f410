"""Drive: the trajectory of the recording car."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidar2pano.simulate.layout.places import PLACES
from lidar2pano.simulate.layout.town import ROAD_MARGIN, Town
from lidar2pano.simulate.scene.random_streams import stream

SENSOR_HEIGHT = 1.73  # metres above the road, as on KITTI's car


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
        """Metres since time 0; (N,) seconds, which may be negative."""
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

    def poses(self, time: np.ndarray) -> np.ndarray:
        """T_world_lidar (N, 4, 4) float64 at times (N,) seconds."""
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
        T[:, :3, 3] += SENSOR_HEIGHT * up
        return T


def lanes(town: Town) -> list[tuple[float, int]]:
    """Lanes of the main road: offset from the centreline (metres, left positive), direction of travel (+1 along s)."""
    road = town.roads[0]
    if road.marking == "motorway":
        inner = road.median + 2.5
        return [(-inner, 1), (-inner - 3.75, 1), (inner, -1), (inner + 3.75, -1)]
    aside = road.half_width / 2 if road.marking != "none" else 0.95
    return [(-aside, 1), (aside, -1)]
