"""The simulated scanner: the pulses of one turn of a spinning LiDAR, and their returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np

from lidar2pano.simulate.scene.raycast import Hits, Scene
from lidar2pano.simulate.scene.surfaces import MATERIAL_IDS, MATERIALS, material_table
from lidar2pano.simulate.sensor_models import BLIND_CELL, FULL_TURN, SensorModel, blind_table

NO_EDGE = 0.15  # metres: smaller steps between firings are no edges
BRIGHTEST = 0.99  # KITTI's remission has steps of 0.01 from 0 to 0.99
TABLE = 1 << 14
PATCH, PATCHY = 0.5, 0.3  # materials with more dropout than PATCHY (windows) lose patches of PATCH metres
ANCHORS = ((0.12, 0.8), (1.3, 0.6))  # spatial variation of reflectance: cell in metres, weight
GRAZE = 0.02  # share of a matt surface's power, still detected: rough ground reflects more at grazing angles

# Roughness of surfaces: standard deviation of height in metres. Real lawns: 16 mm of range at 5 m, 35 mm beyond 20 m.
ROUGH = {
    "grass": 0.005, "meadow": 0.008, "field": 0.008, "soil": 0.004, "gravel": 0.002,
    "leaves": 0.012, "needles": 0.012, "hedge": 0.012,
}  # fmt: skip
# Materials whose tint changes the reflectance at 905 nm too; dyes of cloth and plaster hardly do.
TINTED = ("paint",)
DYE = 0.6  # exponent of the tint: black paint is less black at 905 nm

_REMISSION, _SPREAD, _RETRO, _DROPOUT = (
    material_table(name) for name in ("remission", "variation", "retroreflection", "dropout")
)
_MIRROR = (material_table("roughness") < 0.2).astype(np.float32)  # smooth surfaces reflect little at grazing angles
_ROUGH = np.array([ROUGH.get(name, 0.0) for name in MATERIALS], dtype=np.float32)
_TINTED = np.isin(np.arange(len(MATERIALS)), [MATERIAL_IDS[name] for name in TINTED])
_NORMAL = np.random.default_rng(905).standard_normal(TABLE).astype(np.float32)  # of hashed places
_EVEN = np.random.default_rng(906).random(TABLE).astype(np.float32)
# Real leaves are smaller than cards and a beam is wider than a ray: this share of the pulses passes the first leaf and
# hits another, at least so many metres behind it.
DEEPER, BEHIND = 0.2, 0.04
_LEAFY = material_table("transmission") > 0
Pose = Callable[[np.ndarray], np.ndarray]
"""Times (K,) in seconds after the frame's -> T_world_lidar (K, 4, 4) float64."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Echoes:
    """Echoes of the N pulses of a turn that the recording car does not occlude, firing by firing.

    live    (firings x beams,) bool: which of all pulses these are.
    hits    in the world frame;  start, direction: (N, 3) in the sensor frame at time 0;  frame: T_world_lidar then.
    ring    (N,) uint8;  time: (N,) seconds, ascending;  facing: (N,) float32 cosine of the angle of incidence.
    """

    live: np.ndarray
    hits: Hits
    start: np.ndarray
    direction: np.ndarray
    ring: np.ndarray
    time: np.ndarray
    facing: np.ndarray
    frame: np.ndarray

    def positions(self, of: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Positions of the hits (N, 3), or `of` some: in the world frame, on moving objects on their own surface."""
        turn, position = as_float(self.frame[:3, :3].T), as_float(self.frame[:3, 3])
        where = (self.start[of] + self.direction[of] * self.hits.distance[of, None]) @ turn + position
        uv = self.hits.uv[of]
        return np.where(self.hits.moving[of, None], np.concatenate([uv, uv[:, :1]], axis=1), where)


def as_float(values: np.ndarray) -> np.ndarray:
    """The values in float32, the precision of the rays."""
    return values.astype(np.float32)


def noisy_range(sensor: SensorModel, echoes: Echoes, rng: np.random.Generator) -> np.ndarray:
    """Ranges (N,) with noise of the shot, bias of the beam, roughness of the surface, and mixed returns at edges."""
    true = _mixed_returns(echoes.hits.distance, len(sensor), echoes.live, rng)
    noise = rng.standard_normal(len(true), dtype=np.float32)
    # Weak echoes are noisier: 1.3 times at 25 m and 1.9 times at 40 m in real scans.
    sigma = sensor.range_noise * np.sqrt(1 + (np.minimum(true, sensor.max_range) / 30) ** 3)
    rough = _ROUGH[echoes.hits.material] / np.maximum(echoes.facing, 0.14)
    bias = as_float(sensor.per_beam("range_bias"))[echoes.ring]
    distance = true + bias + noise * np.sqrt(sigma * sigma + rough * rough)
    return np.round(distance / np.float32(sensor.range_step)) * np.float32(sensor.range_step)


def _mixed_returns(distance: np.ndarray, beams: int, live: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Ranges with mixed returns: some pulses at an edge return a range between its two sides.

    In real scans 1-4 % of the edges of 3 m and more have such a point, and some 10 % more of those of half a metre.
    """
    grid = np.full(len(live), np.inf, dtype=np.float32)
    grid[live] = distance
    grid = grid.reshape(-1, beams)
    ahead = np.roll(grid, -1, axis=0)
    with np.errstate(invalid="ignore"):
        jump = np.abs(ahead - grid)
    edge = np.flatnonzero((jump > NO_EDGE) & (jump < np.inf))
    depth = jump.ravel()[edge]
    edge = edge[rng.random(len(edge), dtype=np.float32) < 0.02 + 0.11 * np.exp(-depth)]
    share = rng.random(len(edge), dtype=np.float32)
    out = grid.ravel()
    out[edge] += share * (ahead.ravel()[edge] - out[edge])
    return out[live]


def lost(sensor: SensorModel, echoes: Echoes, rng: np.random.Generator) -> np.ndarray:
    """Pulses (N,) bool without a return: at random, by the material's dropout, or too weak."""
    material, facing = echoes.hits.material, echoes.facing
    kept = 1 - as_float(sensor.per_beam("dropout"))[echoes.ring]
    kept *= 1 - _DROPOUT[material] ** np.sqrt(facing)
    # Power falls with the square of the range; the threshold is soft: a factor e changes a quarter of all pulses.
    distance = np.minimum(echoes.hits.distance, 1e4)
    power = np.maximum(_REMISSION[material] * facing, _RETRO[material]) / 0.1 * (sensor.half_loss_range / distance) ** 2
    kept *= np.clip(0.5 + 0.25 * np.log(np.maximum(power, 1e-9) / GRAZE), 0, 1)
    draw = rng.random(len(kept), dtype=np.float32)
    patchy = np.flatnonzero(_DROPOUT[material] > PATCHY)
    draw[patchy] = _EVEN[_spatial_hash(echoes.positions(patchy), PATCH)]
    return draw >= kept


def remission(sensor: SensorModel, echoes: Echoes, rng: np.random.Generator) -> np.ndarray:
    """Remission (N,) of returns."""
    hits, material = echoes.hits, echoes.hits.material
    bright = _REMISSION[material] * echoes.facing ** _MIRROR[material]
    tinted = np.flatnonzero(_TINTED[material])
    bright[tinted] *= np.clip(hits.tint[tinted].mean(axis=1), 0.01, 1.6) ** DYE
    positions, varied = echoes.positions(), np.zeros(len(bright), dtype=np.float32)
    for cell, weight in ANCHORS:
        varied += np.float32(weight) * _NORMAL[_spatial_hash(positions, cell)]
    bright *= np.maximum(1 + _SPREAD[material] * varied, 0.05)
    start, rate = sensor.remission_fade
    if rate:
        # In real scans ground and walls fade alike: the range counts, not the angle of incidence.
        bright -= np.float32(2 * rate) * np.log(np.maximum(hits.distance / np.float32(start), 1))
        dark, shine = (as_float(sensor.per_beam(name))[echoes.ring] for name in ("dark_offset", "bright_offset"))
        bright += shine + (dark - shine) * np.clip((0.36 - bright) / 0.14, 0, 2)
    bright += sensor.remission_noise / sensor.remission_scale * rng.standard_normal(len(bright), dtype=np.float32)
    bright = np.where(bright < sensor.remission_floor, 0, bright * np.float32(sensor.remission_scale))
    retro = _RETRO[material] * as_float(rng.uniform(0.9, 1.06, len(bright)))
    return (np.floor(np.clip(np.maximum(bright, retro), 0, BRIGHTEST) * 100 + 0.5) / 100).astype(np.float32)


def _spatial_hash(position: np.ndarray, cell: float) -> np.ndarray:
    """Spatial hash: integers (N,) in [0, TABLE), constant within cubes of `cell` metres."""
    key = np.floor(position * np.float32(1 / cell)).astype(np.int32)
    mixed = key[:, 0] * np.int32(73856093) ^ key[:, 1] * np.int32(19349663) ^ key[:, 2] * np.int32(83492791)
    mixed = (mixed ^ (mixed >> 15)) * np.int32(0x2C1B3C6D)
    return (mixed ^ (mixed >> 12)) & (TABLE - 1)


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


def sweep(scene: Scene, sensor: SensorModel, pose: Pose, rng: np.random.Generator) -> Sweep:
    """One turn of `sensor` around time 0, when it points straight ahead; points are compensated for its motion.

    The moving objects of `scene` are where the turn passes them (`passing_time`).
    """
    echoes = _echoes(scene, sensor, pose, rng)
    distance = noisy_range(sensor, echoes, rng)
    valid = echoes.hits.valid & (distance >= sensor.min_range) & (distance < sensor.max_range)
    valid &= ~lost(sensor, echoes, rng)
    # The values of the others are not used: at one metre they are finite.
    near = replace(echoes.hits, distance=np.where(valid, echoes.hits.distance, np.float32(1)))
    bright = remission(sensor, replace(echoes, hits=near), rng)
    kept = np.flatnonzero(valid)
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
        time=as_float(echoes.time[kept]),
    )


def passing_time(sensor: SensorModel, T_world_lidar: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Times (N,) in seconds at which the turn around time 0 passes points (N, 3) of the world frame.

    With each moving object at its own time, one scene serves for the whole turn. T_world_lidar (4, 4): at time 0.
    """
    near = (positions - T_world_lidar[:3, 3]) @ T_world_lidar[:3, :3]
    return sensor.rotation * np.arctan2(near[:, 1], near[:, 0]) / (2 * np.pi * sensor.hz)


def _echoes(scene: Scene, sensor: SensorModel, pose: Pose, rng: np.random.Generator) -> Echoes:
    """Hits of the pulses of a turn."""
    turn = (np.arange(sensor.firings) + rng.random()) / sensor.firings - 0.5  # share of a turn after pointing ahead
    azimuth = sensor.rotation * FULL_TURN * turn
    if sensor.encoder_step:
        azimuth = np.round(azimuth / sensor.encoder_step) * sensor.encoder_step
    time, frame = turn / sensor.hz, pose(np.zeros(1))[0]
    T_now_firing = np.linalg.inv(frame) @ pose(time)  # (firings, 4, 4)
    c, s, zero = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth)), np.zeros(sensor.firings)
    head = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1], axis=1).reshape(-1, 3, 3)
    turned = T_now_firing[:, :3, :3] @ head
    elevation, aside = np.radians(sensor.elevation), np.radians(sensor.per_beam("azimuth"))
    beam = np.stack([np.cos(elevation) * np.cos(aside), np.cos(elevation) * np.sin(aside), np.sin(elevation)])
    origin = np.stack([np.zeros(len(sensor)), sensor.per_beam("origin_left"), sensor.per_beam("origin_up")])
    cell = (((azimuth % FULL_TURN) / BLIND_CELL).astype(np.int64)) % round(FULL_TURN / BLIND_CELL)
    live = ~blind_table(sensor).T[cell].reshape(-1)
    direction = as_float((turned @ beam).transpose(0, 2, 1).reshape(-1, 3))[live]
    start = as_float((turned @ origin + T_now_firing[:, :3, 3:]).transpose(0, 2, 1).reshape(-1, 3))[live]
    toward = direction @ as_float(frame[:3, :3].T)
    hits = _first_hits(scene, start @ as_float(frame[:3, :3].T) + as_float(frame[:3, 3]), toward, rng)
    return Echoes(
        live=live,
        hits=hits,
        start=start,
        direction=direction,
        ring=np.tile(np.arange(len(sensor), dtype=np.uint8), len(time))[live],
        time=np.repeat(time, len(sensor))[live],
        facing=np.abs(np.einsum("ij,ij->i", hits.face_normal, toward)),
        frame=frame,
    )


def _first_hits(scene: Scene, origin: np.ndarray, direction: np.ndarray, rng: np.random.Generator) -> Hits:
    """Hits of N pulses; some pass the first leaf.

    Otherwise crowns and hedges are closed surfaces, walls to a network trained on real scans.
    """
    hits = scene.cast(origin, direction, flat=True)
    leafy = np.flatnonzero(_LEAFY[hits.material] & hits.valid)
    leafy = leafy[rng.random(len(leafy), dtype=np.float32) < DEEPER]
    gone = hits.distance[leafy] + np.float32(BEHIND)
    behind = scene.cast(origin[leafy] + direction[leafy] * gone[:, None], direction[leafy], flat=True)
    met = np.flatnonzero(behind.valid)  # without a second hit the first one stays
    for part in fields(Hits):
        getattr(hits, part.name)[leafy[met]] = getattr(behind, part.name)[met]
    hits.distance[leafy[met]] += gone[met]
    return hits


def _kitti_order(xyz: np.ndarray, ring: np.ndarray) -> np.ndarray:
    """Order (N,) of KITTI's files: beam by beam from the top, each from straight ahead to the left."""
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0]) * np.float32((1 << 23) / np.pi)
    return np.argsort((ring.astype(np.int32) << 24) | (azimuth.astype(np.int32) & 0xFFFFFF), kind="stable")
