"""The simulated scanner: the pulses of one turn of a spinning LiDAR, and the points that they return."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np

from lidar2pano.simulate.lidar.returns import Echoes, as_float, lost, noisy_range, remission
from lidar2pano.simulate.lidar.sensor_models import BLIND_CELL, FULL_TURN, SensorModel, blind_table
from lidar2pano.simulate.scene.raycast import Hits, Scene
from lidar2pano.simulate.scene.surfaces import material_table

SECTORS = 8  # parts of a turn, each with moving objects at one time
# Real leaves are smaller than cards and a beam is wider than a ray: this share of the pulses passes the first leaf and
# hits another, at least so many metres behind it.
DEEPER, BEHIND = 0.2, 0.04
_LEAFY = material_table("transmission") > 0

Pose = Callable[[np.ndarray], np.ndarray]
"""Times (K,) in seconds after the frame's -> T_world_lidar (K, 4, 4) float64."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sweep:
    """The N returns of one turn, in the order of the sensor's files.

    points    (N, 4) float32: x forward, y left, z up in metres, in the sensor frame at time 0; remission in [0, 1].
    raw       (N,) uint16 SemanticKITTI's raw class;  instance (N,) uint16, 0 for none.
    ring      (N,) uint8, the top beam is 0;  time (N,) float32, seconds after the frame's.
    """

    points: np.ndarray
    raw: np.ndarray
    instance: np.ndarray
    ring: np.ndarray
    time: np.ndarray

    def __len__(self) -> int:
        """Number of returns."""
        return len(self.points)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Rays:
    """All pulses of a turn, firing by firing: N = K x B.

    start, direction  (N, 3) float32 in the sensor frame at time 0.
    time  (K,) seconds, ascending.
    live  (N,) bool: not occluded by the recording car.
    """

    start: np.ndarray
    direction: np.ndarray
    time: np.ndarray
    live: np.ndarray


def sweep(
    scene: Scene | Callable[[float], Scene],
    sensor: SensorModel,
    pose: Pose,
    rng: np.random.Generator,
    *,
    sectors: int = SECTORS,
    clean: bool = False,
) -> Sweep:
    """One turn of `sensor` around time 0, at which it points straight ahead; points are compensated for its motion.

    scene    the scene, or a function that gives it at a time in seconds, called for each of `sectors` parts of a turn.
    clean    without noise, lost returns and occlusion by the recording car.
    """
    frame = pose(np.zeros(1))[0]
    rays = _rays(sensor, pose, rng, clean)
    echoes = _cast(scene, rays, frame, sectors, None if clean else rng)
    distance = echoes.hits.distance if clean else noisy_range(sensor, echoes, rays.live, rng)
    here = echoes.hits.valid & (distance >= sensor.min_range) & (distance < sensor.max_range)
    if not clean:
        here &= ~lost(sensor, echoes, rng)
    bright = remission(sensor, echoes.within(here), None if clean else rng)
    kept = np.flatnonzero(here)
    points = np.empty((len(kept), 4), dtype=np.float32)
    points[:, :3] = echoes.start[kept] + echoes.direction[kept] * distance[kept, None]
    points[:, 3] = bright[kept]
    if sensor.point_order == "rings":
        order = _kitti_order(points, echoes.ring[kept])
        kept, points = kept[order], points[order]
    return Sweep(
        points=points,
        raw=echoes.hits.raw[kept],
        instance=echoes.hits.instance[kept],
        ring=echoes.ring[kept],
        time=np.repeat(rays.time.astype(np.float32), len(sensor))[rays.live][kept],
    )


def passing_time(sensor: SensorModel, T_world_lidar: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Times (N,) in seconds at which the turn around time 0 passes points (N, 3) of the world frame.

    With each moving object at its own time, one scene serves for the whole turn. T_world_lidar (4, 4): at time 0.
    """
    near = (positions - T_world_lidar[:3, 3]) @ T_world_lidar[:3, :3]
    return sensor.rotation * np.arctan2(near[:, 1], near[:, 0]) / (2 * np.pi * sensor.hz)


def _rays(sensor: SensorModel, pose: Pose, rng: np.random.Generator, clean: bool) -> _Rays:
    """Origins and directions of the pulses."""
    turn = (np.arange(sensor.firings) + rng.random()) / sensor.firings - 0.5  # share of a turn after pointing ahead
    azimuth = sensor.rotation * FULL_TURN * turn
    if sensor.encoder_step:
        azimuth = np.round(azimuth / sensor.encoder_step) * sensor.encoder_step
    time = turn / sensor.hz
    T_now_firing = np.linalg.inv(pose(np.zeros(1))[0]) @ pose(time)  # (K, 4, 4)
    c, s, zero = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth)), np.zeros(sensor.firings)
    head = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1], axis=1).reshape(-1, 3, 3)
    turned = T_now_firing[:, :3, :3] @ head
    elevation, aside = np.radians(sensor.elevation), np.radians(sensor.per_beam("azimuth"))
    beam = np.stack([np.cos(elevation) * np.cos(aside), np.cos(elevation) * np.sin(aside), np.sin(elevation)])
    origin = np.stack([np.zeros(len(sensor)), sensor.per_beam("origin_left"), sensor.per_beam("origin_up")])
    direction = (turned @ beam).transpose(0, 2, 1).reshape(-1, 3)
    start = (turned @ origin + T_now_firing[:, :3, 3:]).transpose(0, 2, 1).reshape(-1, 3)
    cell = (((azimuth % FULL_TURN) / BLIND_CELL).astype(np.int64)) % round(FULL_TURN / BLIND_CELL)
    shade = blind_table(sensor).T[cell].reshape(-1)
    return _Rays(
        start=start.astype(np.float32),
        direction=direction.astype(np.float32),
        time=time,
        live=np.ones_like(shade) if clean else ~shade,
    )


def _first_hits(scene: Scene, origin: np.ndarray, direction: np.ndarray, rng: np.random.Generator | None) -> Hits:
    """Hits of N pulses; some pass the first leaf.

    Otherwise crowns and hedges are closed surfaces, which a network trained on real scans labels as walls.
    """
    hits = scene.cast(origin, direction, flat=True)
    if rng is None:
        return hits
    leafy = np.flatnonzero(_LEAFY[hits.material] & hits.valid)
    leafy = leafy[rng.random(len(leafy), dtype=np.float32) < DEEPER]
    gone = hits.distance[leafy] + np.float32(BEHIND)
    behind = scene.cast(origin[leafy] + direction[leafy] * gone[:, None], direction[leafy], flat=True)
    met = np.flatnonzero(behind.valid)  # without a second hit the first one stays
    for part in fields(Hits):
        getattr(hits, part.name)[leafy[met]] = getattr(behind, part.name)[met]
    hits.distance[leafy[met]] += gone[met]
    return hits


def _cast(
    scene: Scene | Callable[[float], Scene],
    rays: _Rays,
    frame: np.ndarray,
    sectors: int,
    rng: np.random.Generator | None,
) -> Echoes:
    """Hits of the live pulses, each in the scene of its own part of the turn."""
    turn, place = as_float(frame[:3, :3].T), as_float(frame[:3, 3])
    beams = len(rays.live) // len(rays.time)
    start, direction = rays.start[rays.live], rays.direction[rays.live]
    origin, toward = start @ turn + place, direction @ turn
    firings = np.array_split(np.arange(len(rays.time)), 1 if isinstance(scene, Scene) else sectors)
    edge = np.concatenate([[0], np.cumsum([rays.live[f[0] * beams : (f[-1] + 1) * beams].sum() for f in firings])])
    parts: list[Hits] = []
    for number, sector in enumerate(firings):
        scene_then = scene if isinstance(scene, Scene) else scene(float(rays.time[sector].mean()))
        pulses = slice(edge[number], edge[number + 1])
        parts.append(_first_hits(scene_then, origin[pulses], toward[pulses], rng))
    hits = parts[0] if len(parts) == 1 else _joined(parts)
    ring = np.tile(np.arange(beams, dtype=np.uint8), len(rays.time))[rays.live]
    facing = np.abs(np.einsum("ij,ij->i", hits.face_normal, toward))
    return Echoes(hits=hits, start=start, direction=direction, ring=ring, facing=facing, frame=frame)


def _joined(parts: list[Hits]) -> Hits:
    return Hits(**{field.name: np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Hits)})


def _kitti_order(xyz: np.ndarray, ring: np.ndarray) -> np.ndarray:
    """Order (N,) of KITTI's files: beam by beam from the top, each from straight ahead to the left."""
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0]) * np.float32((1 << 23) / np.pi)
    return np.argsort((ring.astype(np.int32) << 24) | (azimuth.astype(np.int32) & 0xFFFFFF), kind="stable")
