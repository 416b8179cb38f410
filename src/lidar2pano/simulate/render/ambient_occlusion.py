"""Occlusion: how much of the sky's light reaches a place past what stands near it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidar2pano.simulate.render.noise import lottery
from lidar2pano.simulate.scene.raycast import Hits, Scene
from lidar2pano.simulate.scene.surfaces import column

GRAIN = 0.02  # metres: points nearer to each other than this share one ray
NEAR, FAR = 0.25, 15.0  # metres: what is nearer counts as in the way, what is farther does not; evenly in log between
LEAFY = np.float32(0.6)  # openness of leaves: their tints tell already how deep in the crown they are
_THIN = column("through") > 0
STRIDES = (1, 2, 4)  # pixels between the neighbours that are averaged


class Guide(NamedTuple):
    """A picture of surfaces: place and normal (3, h, w) float32, distance (h, w) metres (0 where there is only sky)."""

    place: np.ndarray
    normal: np.ndarray
    distance: np.ndarray

    def part(self, rows: slice, columns: slice) -> Guide:
        """Some of its pixels."""
        return Guide(self.place[:, rows, columns], self.normal[:, rows, columns], self.distance[rows, columns])


def openness(scene: Scene, hits: Hits, guide: Guide, wraps: bool) -> np.ndarray:
    """Share of the sky's light (H, W) float32, smooth on surfaces, of what a picture's rays met.

    One ray from every second pixel of every second row, spread by the cosine law, then averages that stop at edges.
    wraps: the last column meets the first.
    """
    shape = guide.distance.shape
    half = slice(None, None, 2)
    coarse = guide.part(half, half)
    chosen = np.arange(len(hits.face)).reshape(shape)[half, half].reshape(-1)
    rough = _cast(scene, hits, coarse, chosen).reshape(coarse.distance.shape)
    return _refined(smoothed(rough, coarse, wraps, STRIDES), guide, wraps)


def guide(hits: Hits, origin: np.ndarray, directions: np.ndarray) -> Guide:
    """What the rays of a picture (H, W, 3) from `origin` (3,) met."""
    rows, columns = directions.shape[:2]
    distance = np.where(hits.met, hits.distance, 0).reshape(rows, columns)
    place = np.ascontiguousarray(directions.transpose(2, 0, 1)) * distance
    place += np.asarray(origin, dtype=np.float32)[:, None, None]
    normal = np.ascontiguousarray(hits.normal.T).reshape(3, rows, columns)
    return Guide(place, normal, distance)


def _cast(scene: Scene, hits: Hits, guide: Guide, chosen: np.ndarray) -> np.ndarray:
    """One ray for each chosen hit: 1 where it gets away, 0 where it does not (N,) float32."""
    free = np.where(_THIN[hits.material[chosen]] & hits.met[chosen], LEAFY, np.float32(1))
    met = np.flatnonzero(hits.met[chosen] & (free == 1))
    place = guide.place.reshape(3, -1)[:, met]
    normal, facet = (
        guide.normal.reshape(3, -1)[:, met],
        np.ascontiguousarray(hits.facet[chosen[met]].T, dtype=np.float32),
    )
    height, turn = 2 * lottery(place, GRAIN, 11) - 1, np.float32(2 * np.pi) * lottery(place, GRAIN, 12)
    flat = np.sqrt(1 - height * height)
    way = normal + np.stack([flat * np.cos(turn), flat * np.sin(turn), height])  # a point on the sphere that it touches
    under = np.minimum((way * facet).sum(axis=0), 0)
    way -= 2 * under * facet
    way /= np.sqrt((way * way).sum(axis=0)) + 1e-6
    start = place + facet * (1e-3 + 3e-5 * hits.distance[chosen[met]])
    far = NEAR * (FAR / NEAR) ** lottery(place, GRAIN, 13)
    free[met] = scene.light(start.T, way.T, far)
    return free


def smoothed(value: np.ndarray, guide: Guide, wraps: bool, strides: tuple[int, ...]) -> np.ndarray:
    """Averages (H, W) that stop at edges, over growing strides, along rows and columns in turn (Dammertz 2010)."""
    for stride in strides:
        for axis in (1, 2):
            total, weight = value.copy(), np.ones_like(value)
            for step in (-stride, stride):
                there = Guide(*(_moved(part, step, axis - 3, wraps) for part in guide))
                alike = _alike(guide, there)
                total += alike * _moved(value, step, axis - 3, wraps)
                weight += alike
            value = total / weight
    return value


def _moved(field: np.ndarray, step: int, axis: int, wraps: bool) -> np.ndarray:
    """The field's neighbours `step` pixels on; at borders that do not wrap, the field itself."""
    moved = np.roll(field, -step, axis)
    if axis == -2 or not wraps:
        edge = [slice(None)] * field.ndim
        edge[axis] = slice(-step, None) if step > 0 else slice(None, -step)
        moved[tuple(edge)] = field[tuple(edge)]
    return moved


def _alike(here: Guide, there: Guide) -> np.ndarray:
    """Weights in [0, 1]: near to 1 where two pixels lie on one smooth surface."""
    off = there.place - here.place
    off = np.abs((off * here.normal).sum(axis=0))
    level = np.clip(1 - off / (0.03 + 0.01 * here.distance), 0, 1)
    bend = (here.normal * there.normal).sum(axis=0)
    return level * np.clip(2 * bend - 1, 0, 1)


def _refined(coarse: np.ndarray, guide: Guide, wraps: bool) -> np.ndarray:
    """From every second row and column to all: pixels take after the neighbours that they are like."""
    every, even, odd = slice(None), slice(None, None, 2), slice(1, None, 2)
    rows, columns = guide.distance.shape
    tall = np.empty((rows, coarse.shape[1]), dtype=np.float32)
    tall[0::2] = coarse
    tall[1::2] = _between(coarse, guide.part(even, even), guide.part(odd, even), 0, False)
    out = np.empty((rows, columns), dtype=np.float32)
    out[:, 0::2] = tall
    out[:, 1::2] = _between(tall, guide.part(every, even), guide.part(every, odd), 1, wraps)
    return out


def _between(value: np.ndarray, known: Guide, here: Guide, axis: int, wraps: bool) -> np.ndarray:
    """Values for the pixels that lie between neighbours along an axis."""
    rows, columns = (slice(0, length) for length in here.distance.shape)
    after = Guide(*(_moved(part, 1, axis - 2, wraps) for part in known)).part(rows, columns)
    nearer, farther = (_alike(here, side) + np.float32(1e-3) for side in (known.part(rows, columns), after))
    next_value = _moved(value, 1, axis - 2, wraps)[rows, columns]
    return (value[rows, columns] * nearer + next_value * farther) / (nearer + farther)
