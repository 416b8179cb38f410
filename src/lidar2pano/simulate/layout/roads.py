"""Roads: centrelines with cross sections, and the positions of points relative to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

STEP = 1.0  # metres between the samples of a centreline
COARSE = 4  # stride of the first search over a centreline
CORNER = 5.0  # metres: radius of the kerb between two roads

Marking = Literal["none", "town", "country", "motorway"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bay:
    """A parking bay beside the carriageway from `start` to `end` metres, on `side` +1 left or -1 right."""

    start: float
    end: float
    side: int
    width: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Road:
    """A road in the world frame; (s, d) are metres along its centreline and to the left of it.

    xy          (n, 2) float64 samples of the centreline, STEP apart;  heading (n,) radians.
    half_width  of the carriageway;  sidewalk: width of each sidewalk (0 = none).
    kerb        height of the sidewalk above the carriageway.
    bays        for parking;  median: half width of the strip between two carriageways (0 = none).
    surface, paving  materials of carriageway and sidewalk.
    """

    xy: np.ndarray
    heading: np.ndarray
    half_width: float
    sidewalk: float
    kerb: float
    marking: Marking
    surface: str
    paving: str
    bays: tuple[Bay, ...] = ()
    median: float = 0.0

    @property
    def length(self) -> float:
        """Metres."""
        return (len(self.xy) - 1) * STEP

    def at(self, s: np.ndarray, d: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Points (N, 2) and headings (N,) at (s, d); beyond its ends the road is extended straight."""
        s = np.asarray(s, dtype=np.float64)
        inner = np.clip(s, 0, self.length)
        i = np.minimum((inner / STEP).astype(np.int64), len(self.xy) - 2)
        part = inner / STEP - i
        heading = self.heading[i] * (1 - part) + self.heading[i + 1] * part
        along = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        left = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
        xy = self.xy[i] * (1 - part)[..., None] + self.xy[i + 1] * part[..., None]
        return xy + along * (s - inner)[..., None] + left * np.asarray(d)[..., None], heading

    def beside(self, s: np.ndarray | float, side: int, away: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """Points (N, 2) `away` metres beyond the kerb of a side (+1 left, -1 right), and the road's headings (N,)."""
        s = np.asarray(s, dtype=np.float64)
        return self.at(s, side * (self.kerb_offset(s, np.full(s.shape, side)) + away))

    def kerb_offset(self, s: np.ndarray, side: np.ndarray) -> np.ndarray:
        """Distance (N,) of the kerb from the centreline: half the carriageway and a bay where there is one."""
        out = np.full(np.shape(s), self.half_width)
        for bay in self.bays:
            inside = np.clip(np.minimum(s - bay.start, bay.end - s) / 1.2, 0, 1)  # bevelled ends
            out = out + np.where(side == bay.side, inside * bay.width, 0.0)
        return out


def winding_centreline(
    rng: np.random.Generator, start: Sequence[float], heading: float, length: float, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """A random curve: samples (n, 2) STEP apart and headings (n,); its radius is `radius` metres at least.

    A spring towards its first heading keeps it from meeting itself.
    """
    count = int(length / STEP) + 1
    knots = np.arange(0, count + 240, 60)
    curvature = rng.uniform(-1, 1, len(knots)) * (rng.uniform(size=len(knots)) < 0.6) / radius
    bend = np.interp(np.arange(count), knots, curvature)
    headings = np.empty(count)
    turned = 0.0
    for i in range(count):
        headings[i] = heading + turned
        turned += STEP * np.clip(bend[i] - turned * 0.004, -1 / radius, 1 / radius)
    steps = STEP * np.stack([np.cos(headings), np.sin(headings)], axis=1)
    xy = np.asarray(start) + np.concatenate([np.zeros((1, 2)), np.cumsum(steps[:-1], axis=0)])
    return xy, headings


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Position:
    """Positions of N points relative to the nearest road.

    kerb_distance  (N,) metres beyond the kerb, negative on the carriageway; corners between roads are rounded.
    road           (N,) index of the road;  s, d: (N,) along and to the left of it.
    other_road     (N,) metres beyond the kerb of the second nearest road, inf: none near; small at junctions.
    """

    kerb_distance: np.ndarray
    road: np.ndarray
    s: np.ndarray
    d: np.ndarray
    other_road: np.ndarray


def locate(roads: Sequence[Road], xy: np.ndarray, reach: float = 80.0) -> Position:
    """Positions of points (N, 2) relative to the roads within `reach` metres."""
    xy = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
    count = len(xy)
    best, second = np.full(count, reach), np.full(count, np.inf)
    owner, s, d = np.zeros(count, np.int64), np.zeros(count), np.full(count, reach)
    rounded = np.full(count, reach)
    for index, road in enumerate(roads):
        low, high = road.xy.min(axis=0) - reach, road.xy.max(axis=0) + reach
        near = np.flatnonzero(((xy >= low) & (xy <= high)).all(axis=1))
        if not len(near):
            continue
        along, aside, beyond = _frenet(road, xy[near])
        flank = np.abs(aside) - road.kerb_offset(along, np.where(aside > 0, 1, -1))
        gap = np.where(beyond > 0, np.hypot(np.maximum(flank, 0), beyond), flank)
        # Signed distance to the union of two areas with a rounded inner corner.
        inner = np.hypot(np.maximum(CORNER - rounded[near], 0), np.maximum(CORNER - gap, 0))
        rounded[near] = np.maximum(CORNER, np.minimum(rounded[near], gap)) - inner
        closer = gap < best[near]
        second[near] = np.minimum(second[near], np.where(closer, best[near], gap))
        won = near[closer]
        best[won], owner[won], s[won], d[won] = gap[closer], index, along[closer], aside[closer]
    return Position(kerb_distance=rounded, road=owner, s=s, d=d, other_road=second)


def _frenet(road: Road, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """s, d and metres beyond an end of the road, each (N,)."""
    coarse, points = road.xy[::COARSE].astype(np.float32), xy.astype(np.float32)
    parts = np.split(points, range(16384, len(points), 16384))
    nearest = np.concatenate([((coarse**2).sum(1) - 2 * part @ coarse.T).argmin(axis=1) for part in parts])
    i = np.minimum(nearest * COARSE, len(road.xy) - 1)
    for _ in range(3):
        away = xy - road.xy[i]
        ahead = np.cos(road.heading[i]) * away[:, 0] + np.sin(road.heading[i]) * away[:, 1]
        i = np.clip(i + np.rint(ahead / STEP).astype(np.int64), 0, len(road.xy) - 1)
    away = xy - road.xy[i]
    c, s = np.cos(road.heading[i]), np.sin(road.heading[i])
    ahead, aside = c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]
    along = i * STEP + ahead
    beyond = np.maximum(np.maximum(-along, along - road.length), 0)
    return np.clip(along, 0, road.length), aside, beyond


@dataclass(frozen=True, slots=True, eq=False)
class Terrain:
    """Height as a sum of waves: (n, 4) rows of wave numbers x and y (1/m), phase, amplitude (m)."""

    waves: np.ndarray

    @classmethod
    def random(cls, rng: np.random.Generator, slope: float) -> Terrain:
        """Seven waves of 90 to 700 metres whose slopes add up to about `slope`."""
        length, way = np.geomspace(90, 700, 7), rng.uniform(0, 2 * np.pi, 7)
        number = 2 * np.pi / length
        slopes = slope * rng.uniform(0.15, 0.55, 7)
        return cls(np.stack([number * np.cos(way), number * np.sin(way), rng.uniform(0, 6.28, 7), slopes / number], 1))

    def height(self, xy: np.ndarray) -> np.ndarray:
        """Heights (...) in metres at points (..., 2)."""
        x, y = np.asarray(xy)[..., 0, None], np.asarray(xy)[..., 1, None]
        return (self.waves[:, 3] * np.sin(x * self.waves[:, 0] + y * self.waves[:, 1] + self.waves[:, 2])).sum(-1)

    def normal(self, xy: np.ndarray) -> np.ndarray:
        """Unit normals (..., 3) at points (..., 2)."""
        x, y = np.asarray(xy)[..., 0, None], np.asarray(xy)[..., 1, None]
        wave = self.waves[:, 3] * np.cos(x * self.waves[:, 0] + y * self.waves[:, 1] + self.waves[:, 2])
        slope = np.stack([(wave * self.waves[:, 0]).sum(-1), (wave * self.waves[:, 1]).sum(-1)], axis=-1)
        normal = np.concatenate([-slope, np.ones((*slope.shape[:-1], 1))], axis=-1)
        return normal / np.linalg.norm(normal, axis=-1, keepdims=True)
