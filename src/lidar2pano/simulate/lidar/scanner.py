"""One turn of a spinning LiDAR in the street world: where its pulses go, and what comes back of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np

from lidar2pano.simulate.lidar.returns import Echoes, as_float, lost, measured, remission
from lidar2pano.simulate.lidar.sensor_models import FULL_TURN, SHADE, Sensor, hidden
from lidar2pano.simulate.scene.raycast import Hits, Scene
from lidar2pano.simulate.scene.surfaces import material_table

SECTORS = 8  # a turn's moments at which moving things are looked at
# Leaves are smaller than a card's and the beam wider than a ray: this share of the pulses goes a leaf deeper, at least
# so many metres behind the first.
DEEPER, BEHIND = 0.2, 0.04
_LEAFY = material_table("transmission") > 0

Pose = Callable[[np.ndarray], np.ndarray]
"""Times (K,) in seconds, 0 at the frame's -> T_world_lidar (K, 4, 4) float64."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sweep:
    """The N returns of one turn, in the order of the sensor's files.

    points    (N, 4) float32: x forward, y left, z up in metres, in the sensor's frame at time 0; remission in [0, 1].
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

    start, way  (N, 3) float32 in the sensor's frame at time 0.
    time        (K,) seconds, rising.
    live        (N,) bool: not hidden by the recording car.
    """

    start: np.ndarray
    direction: np.ndarray
    time: np.ndarray
    live: np.ndarray


def sweep(
    scene: Scene | Callable[[float], Scene],
    sensor: Sensor,
    pose: Pose,
    rng: np.random.Generator,
    *,
    sectors: int = SECTORS,
    clean: bool = False,
) -> Sweep:
    """One turn of `sensor`, centred on time 0 when it looks straight ahead; points are free of its own motion.

    scene    what stands, or a function of the time in seconds that gives the scene with moving things in their places:
             it is asked once for each of `sectors` parts of the turn.
    clean    every pulse that meets something in range comes back, exactly; the recording car hides nothing.
    """
    frame = pose(np.zeros(1))[0]
    rays = _rays(sensor, pose, rng, clean)
    echoes = _cast(scene, rays, frame, sectors, None if clean else rng)
    distance = echoes.hits.distance if clean else measured(sensor, echoes, rays.live, rng)
    here = echoes.hits.valid & (distance >= sensor.nearest) & (distance < sensor.farthest)
    if not clean:
        here &= ~lost(sensor, echoes, rng)
    bright = remission(sensor, echoes.within(here), None if clean else rng)
    kept = np.flatnonzero(here)
    points = np.empty((len(kept), 4), dtype=np.float32)
    points[:, :3] = echoes.start[kept] + echoes.direction[kept] * distance[kept, None]
    points[:, 3] = bright[kept]
    if sensor.order == "rings":
        order = _by_rings(points, echoes.ring[kept])
        kept, points = kept[order], points[order]
    return Sweep(
        points=points,
        raw=echoes.hits.raw[kept],
        instance=echoes.hits.instance[kept],
        ring=echoes.ring[kept],
        time=np.repeat(rays.time.astype(np.float32), len(sensor))[rays.live][kept],
    )


def passing(sensor: Sensor, T_world_lidar: np.ndarray, places: np.ndarray) -> np.ndarray:
    """When the turn around time 0 passes places (N, 3) of the world: (N,) seconds. T_world_lidar (4, 4): at time 0.

    With each moving thing where it is at its own moment, one scene does for the whole turn.
    """
    near = (places - T_world_lidar[:3, 3]) @ T_world_lidar[:3, :3]
    return sensor.turn * np.arctan2(near[:, 1], near[:, 0]) / (2 * np.pi * sensor.hz)


def _rays(sensor: Sensor, pose: Pose, rng: np.random.Generator, clean: bool) -> _Rays:
    """Where the pulses start and go."""
    turn = (np.arange(sensor.steps) + rng.random()) / sensor.steps - 0.5  # parts of a turn after looking ahead
    azimuth = sensor.turn * FULL_TURN * turn
    if sensor.encoder:
        azimuth = np.round(azimuth / sensor.encoder) * sensor.encoder
    time = turn / sensor.hz
    own = np.linalg.inv(pose(np.zeros(1))[0]) @ pose(time)  # (K, 4, 4): from the sensor when it fires to time 0
    c, s, zero = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth)), np.zeros(sensor.steps)
    head = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1], axis=1).reshape(-1, 3, 3)
    turned = own[:, :3, :3] @ head
    elevation, aside = np.radians(sensor.elevation), np.radians(sensor.per_beam("azimuth"))
    beam = np.stack([np.cos(elevation) * np.cos(aside), np.cos(elevation) * np.sin(aside), np.sin(elevation)])
    origin = np.stack([np.zeros(len(sensor)), sensor.per_beam("aside"), sensor.per_beam("rise")])
    direction = (turned @ beam).transpose(0, 2, 1).reshape(-1, 3)
    start = (turned @ origin + own[:, :3, 3:]).transpose(0, 2, 1).reshape(-1, 3)
    cell = (((azimuth % FULL_TURN) / SHADE).astype(np.int64)) % round(FULL_TURN / SHADE)
    shade = hidden(sensor).T[cell].reshape(-1)
    return _Rays(
        start=start.astype(np.float32),
        direction=direction.astype(np.float32),
        time=time,
        live=np.ones_like(shade) if clean else ~shade,
    )


def _echoing(scene: Scene, origin: np.ndarray, direction: np.ndarray, rng: np.random.Generator | None) -> Hits:
    """What pulses (N) meet that is dense enough to answer: some go a leaf deeper than a ray would.

    Without that crowns and hedges have a skin, and a network trained on real scans takes them for walls.
    """
    hits = scene.cast(origin, direction, flat=True)
    if rng is None:
        return hits
    leafy = np.flatnonzero(_LEAFY[hits.material] & hits.valid)
    leafy = leafy[rng.random(len(leafy), dtype=np.float32) < DEEPER]
    gone = hits.distance[leafy] + np.float32(BEHIND)
    behind = scene.cast(origin[leafy] + direction[leafy] * gone[:, None], direction[leafy], flat=True)
    met = np.flatnonzero(behind.valid)  # where nothing follows, the leaf it was
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
    """What the live pulses meet, each in the scene of its own part of the turn."""
    turn, place = as_float(frame[:3, :3].T), as_float(frame[:3, 3])
    beams = len(rays.live) // len(rays.time)
    start, direction = rays.start[rays.live], rays.direction[rays.live]
    origin, toward = start @ turn + place, direction @ turn
    firings = np.array_split(np.arange(len(rays.time)), 1 if isinstance(scene, Scene) else sectors)
    edge = np.concatenate([[0], np.cumsum([rays.live[f[0] * beams : (f[-1] + 1) * beams].sum() for f in firings])])
    parts: list[Hits] = []
    for number, sector in enumerate(firings):
        seen = scene if isinstance(scene, Scene) else scene(float(rays.time[sector].mean()))
        pulses = slice(edge[number], edge[number + 1])
        parts.append(_echoing(seen, origin[pulses], toward[pulses], rng))
    hits = parts[0] if len(parts) == 1 else _joined(parts)
    ring = np.tile(np.arange(beams, dtype=np.uint8), len(rays.time))[rays.live]
    facing = np.abs(np.einsum("ij,ij->i", hits.face_normal, toward))
    return Echoes(hits=hits, start=start, direction=direction, ring=ring, facing=facing, frame=frame)


def _joined(parts: list[Hits]) -> Hits:
    return Hits(**{field.name: np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Hits)})


def _by_rings(xyz: np.ndarray, ring: np.ndarray) -> np.ndarray:
    """The order (N,) of KITTI's files: beam by beam from the top, each from straight ahead to the left."""
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0]) * np.float32((1 << 23) / np.pi)
    return np.argsort((ring.astype(np.int32) << 24) | (azimuth.astype(np.int32) & 0xFFFFFF), kind="stable")
