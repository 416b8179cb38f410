"""Ambient occlusion: the share of the sky's light that reaches a surface past the objects around it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidar2pano.simulate.render.noise import spatial_hash
from lidar2pano.simulate.scene.raycast import Hits, Scene
from lidar2pano.simulate.scene.surfaces import material_table

CELL = 0.02  # metres: points within one cell share one ray
NEAR, FAR = 0.25, 15.0  # metres: the rays' lengths, log-uniform
LEAFY = np.float32(0.6)  # of leaves: their tints contain the shade inside the crown
_THIN = material_table("transmission") > 0
STRIDES = (1, 2, 4)  # pixels, of the a-trous filter


class GBuffer(NamedTuple):
    """Visible surfaces: position and normal (3, h, w) float32, distance (h, w) metres (0 where there is sky)."""

    position: np.ndarray
    normal: np.ndarray
    distance: np.ndarray

    def part(self, rows: slice, columns: slice) -> GBuffer:
        """The buffer of some pixels."""
        return GBuffer(self.position[:, rows, columns], self.normal[:, rows, columns], self.distance[rows, columns])


def sky_visibility(scene: Scene, hits: Hits, gbuffer: GBuffer, circular: bool) -> np.ndarray:
    """Share (H, W) float32 of the sky's light that reaches the hits of an image's rays.

    One cosine-distributed ray for every second pixel of every second row, then an edge-aware filter.
    circular: the last column adjoins the first.
    """
    shape = gbuffer.distance.shape
    half = slice(None, None, 2)
    coarse = gbuffer.part(half, half)
    weighted_choice = np.arange(len(hits.face)).reshape(shape)[half, half].reshape(-1)
    rough = _cast(scene, hits, coarse, weighted_choice).reshape(coarse.distance.shape)
    return _upsampled(edge_aware_mean(rough, coarse, circular, STRIDES), gbuffer, circular)


def gbuffer(hits: Hits, origin: np.ndarray, directions: np.ndarray) -> GBuffer:
    """The G-buffer of rays (H, W, 3) from `origin` (3,)."""
    rows, columns = directions.shape[:2]
    distance = np.where(hits.valid, hits.distance, 0).reshape(rows, columns)
    position = np.ascontiguousarray(directions.transpose(2, 0, 1)) * distance
    position += np.asarray(origin, dtype=np.float32)[:, None, None]
    normal = np.ascontiguousarray(hits.normal.T).reshape(3, rows, columns)
    return GBuffer(position, normal, distance)


def _cast(scene: Scene, hits: Hits, gbuffer: GBuffer, weighted_choice: np.ndarray) -> np.ndarray:
    """One ray from each chosen hit (N,) float32: 1 where it hits nothing, else 0."""
    free = np.where(_THIN[hits.material[weighted_choice]] & hits.valid[weighted_choice], LEAFY, np.float32(1))
    met = np.flatnonzero(hits.valid[weighted_choice] & (free == 1))
    position = gbuffer.position.reshape(3, -1)[:, met]
    normal, face_normal = (
        gbuffer.normal.reshape(3, -1)[:, met],
        np.ascontiguousarray(hits.face_normal[weighted_choice[met]].T, dtype=np.float32),
    )
    height, turn = 2 * spatial_hash(position, CELL, 11) - 1, np.float32(2 * np.pi) * spatial_hash(position, CELL, 12)
    flat = np.sqrt(1 - height * height)
    direction = normal + np.stack(
        [flat * np.cos(turn), flat * np.sin(turn), height]
    )  # the cosine distribution: normal + a point on the unit sphere
    under = np.minimum((direction * face_normal).sum(axis=0), 0)
    direction -= 2 * under * face_normal
    direction /= np.sqrt((direction * direction).sum(axis=0)) + 1e-6
    start = position + face_normal * (1e-3 + 3e-5 * hits.distance[weighted_choice[met]])
    far = NEAR * (FAR / NEAR) ** spatial_hash(position, CELL, 13)
    free[met] = scene.unoccluded(start.T, direction.T, far)
    return free


def edge_aware_mean(value: np.ndarray, gbuffer: GBuffer, circular: bool, strides: tuple[int, ...]) -> np.ndarray:
    """Edge-avoiding a-trous filter of (H, W) along rows and columns in turn (Dammertz 2010)."""
    for stride in strides:
        for axis in (1, 2):
            total, weight = value.copy(), np.ones_like(value)
            for step in (-stride, stride):
                there = GBuffer(*(_shifted(part, step, axis - 3, circular) for part in gbuffer))
                alike = _similarity(gbuffer, there)
                total += alike * _shifted(value, step, axis - 3, circular)
                weight += alike
            value = total / weight
    return value


def _shifted(field: np.ndarray, step: int, axis: int, circular: bool) -> np.ndarray:
    """The field shifted by `step` pixels; at borders that are not circular, the field itself."""
    moved = np.roll(field, -step, axis)
    if axis == -2 or not circular:
        edge = [slice(None)] * field.ndim
        edge[axis] = slice(-step, None) if step > 0 else slice(None, -step)
        moved[tuple(edge)] = field[tuple(edge)]
    return moved


def _similarity(here: GBuffer, there: GBuffer) -> np.ndarray:
    """Weights in [0, 1]: close to 1 where two pixels lie on one smooth surface."""
    off = there.position - here.position
    off = np.abs((off * here.normal).sum(axis=0))
    level = np.clip(1 - off / (0.03 + 0.01 * here.distance), 0, 1)
    bend = (here.normal * there.normal).sum(axis=0)
    return level * np.clip(2 * bend - 1, 0, 1)


def _upsampled(coarse: np.ndarray, gbuffer: GBuffer, circular: bool) -> np.ndarray:
    """Joint bilateral upsampling from every second row and column to all pixels."""
    every, even, odd = slice(None), slice(None, None, 2), slice(1, None, 2)
    rows, columns = gbuffer.distance.shape
    tall = np.empty((rows, coarse.shape[1]), dtype=np.float32)
    tall[0::2] = coarse
    tall[1::2] = _interpolated(coarse, gbuffer.part(even, even), gbuffer.part(odd, even), 0, False)
    out = np.empty((rows, columns), dtype=np.float32)
    out[:, 0::2] = tall
    out[:, 1::2] = _interpolated(tall, gbuffer.part(every, even), gbuffer.part(every, odd), 1, circular)
    return out


def _interpolated(value: np.ndarray, known: GBuffer, here: GBuffer, axis: int, circular: bool) -> np.ndarray:
    """Values of the pixels between two neighbours along an axis."""
    rows, columns = (slice(0, length) for length in here.distance.shape)
    after = GBuffer(*(_shifted(part, 1, axis - 2, circular) for part in known)).part(rows, columns)
    nearer, farther = (_similarity(here, side) + np.float32(1e-3) for side in (known.part(rows, columns), after))
    next_value = _shifted(value, 1, axis - 2, circular)[rows, columns]
    return (value[rows, columns] * nearer + next_value * farther) / (nearer + farther)
