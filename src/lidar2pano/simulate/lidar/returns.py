"""What comes back of a LiDAR's pulses: how far it seems, how bright, and whether at all."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidar2pano.simulate.lidar.sensor_models import Sensor
from lidar2pano.simulate.scene.raycast import Hits
from lidar2pano.simulate.scene.surfaces import MATERIAL_IDS, MATERIALS, material_table

NO_EDGE = 0.15  # metres from one firing to the next that are no edge yet
BRIGHTEST = 0.99  # KITTI's remission is written in whole hundredths from 0 to 0.99
TABLE = 1 << 14
PATCH, PATCHY = 0.5, 0.3  # what is lost more often than PATCHY is lost by patches of so many metres (windows)
ANCHORS = ((0.12, 0.8), (1.3, 0.6))  # reflectance varies from place to place: cell in metres, weight
GRAZE = 0.02  # of a matt surface's power: what is still heard, for rough ground sends more back to a grazing pulse

# Metres of height (standard deviation) of what has no surface; real lawns: 16 mm of range at 5 m, 35 mm beyond 20 m.
ROUGH = {
    "grass": 0.005, "meadow": 0.008, "field": 0.008, "soil": 0.004, "gravel": 0.002,
    "leaves": 0.012, "needles": 0.012, "hedge": 0.012,
}  # fmt: skip
# Materials whose reflectance goes with their tint at 905 nm too; of dyes in cloth and plaster little is left there.
TINTED = ("paint",)
DYE = 0.6  # exponent of the tint: black paint is less black at 905 nm

_REMISSION, _SPREAD, _RETRO, _DROPOUT = (
    material_table(name) for name in ("remission", "variation", "retroreflection", "dropout")
)
_MIRROR = (material_table("roughness") < 0.2).astype(
    np.float32
)  # what looks like a mirror sends little back from the side
_ROUGH = np.array([ROUGH.get(name, 0.0) for name in MATERIALS], dtype=np.float32)
_TINTED = np.isin(np.arange(len(MATERIALS)), [MATERIAL_IDS[name] for name in TINTED])
_NORMAL = np.random.default_rng(905).standard_normal(TABLE).astype(np.float32)  # of hashed places
_EVEN = np.random.default_rng(906).random(TABLE).astype(np.float32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Echoes:
    """What N pulses met: hits, and start, way (N, 3) in the sensor's frame at time 0 (`frame`: to the world).

    ring    (N,) uint8;  facing (N,) float32 cosine of incidence.
    """

    hits: Hits
    start: np.ndarray
    direction: np.ndarray
    ring: np.ndarray
    facing: np.ndarray
    frame: np.ndarray

    def within(self, which: np.ndarray) -> Echoes:
        """The same with the others, (N,) bool, put a metre away: what is computed of those is thrown away."""
        near = np.where(which, self.hits.distance, np.float32(1))
        return replace(self, hits=replace(self.hits, distance=near))

    def subset(self, which: np.ndarray) -> Echoes:
        """Some of them, by index."""
        arrays = {name: getattr(self, name)[which] for name in ("start", "direction", "ring", "facing")}
        return Echoes(hits=self.hits.subset(which), frame=self.frame, **arrays)

    def places(self) -> np.ndarray:
        """Where they met it (N, 3): in the world, or on the surface of what moves, so that it keeps its own looks."""
        turn, place = as_float(self.frame[:3, :3].T), as_float(self.frame[:3, 3])
        where = (self.start + self.direction * self.hits.distance[:, None]) @ turn + place
        if self.hits.moving.any():
            own = np.concatenate([self.hits.uv, self.hits.uv[:, :1]], axis=1)
            where = np.where(self.hits.moving[:, None], own, where)
        return where


def as_float(values: np.ndarray) -> np.ndarray:
    """The same numbers in float32: the rays' own precision."""
    return values.astype(np.float32)


def measured(sensor: Sensor, echoes: Echoes, live: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Distances (N,) with noise: of the shot, of the beam, of rough ground, and between the two sides of edges."""
    true = _smeared(echoes.hits.distance, len(sensor), live, rng)
    noise = rng.standard_normal(len(true), dtype=np.float32)
    # Weak echoes time worse: the real scans' noise is 1.3 times as great at 25 m, 1.9 times at 40 m.
    sigma = sensor.noise * np.sqrt(1 + (np.minimum(true, sensor.farthest) / 30) ** 3)
    rough = _ROUGH[echoes.hits.material] / np.maximum(echoes.facing, 0.14)
    bias = as_float(sensor.per_beam("bias"))[echoes.ring]
    distance = true + bias + noise * np.sqrt(sigma * sigma + rough * rough)
    return np.round(distance / np.float32(sensor.grain)) * np.float32(sensor.grain)


def _smeared(distance: np.ndarray, beams: int, live: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Distances where some pulses that strike an edge come back from between its two sides.

    Of the real scans' edges of 3 m and more 1-4 in 100 have such a point, of those of half a metre some 10 more.
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


def lost(sensor: Sensor, echoes: Echoes, rng: np.random.Generator) -> np.ndarray:
    """Pulses (N,) of which nothing comes back: by chance, through or off the material, or too weak."""
    material, facing = echoes.hits.material, echoes.facing
    stays = 1 - as_float(sensor.per_beam("drop"))[echoes.ring]
    stays *= 1 - _DROPOUT[material] ** np.sqrt(facing)
    # Power falls with the square of the distance; the threshold is soft: a factor e is a quarter of all pulses.
    distance = np.minimum(echoes.hits.distance, 1e4)
    power = np.maximum(_REMISSION[material] * facing, _RETRO[material]) / 0.1 * (sensor.reach / distance) ** 2
    stays *= np.clip(0.5 + 0.25 * np.log(np.maximum(power, 1e-9) / GRAZE), 0, 1)
    draw = rng.random(len(stays), dtype=np.float32)
    patchy = np.flatnonzero(_DROPOUT[material] > PATCHY)
    draw[patchy] = _EVEN[_hashed(echoes.subset(patchy).places(), PATCH)]
    return draw >= stays


def remission(sensor: Sensor, echoes: Echoes, rng: np.random.Generator | None) -> np.ndarray:
    """Remission (N,) of returns; without `rng` as a perfect sensor reports it."""
    hits, material = echoes.hits, echoes.hits.material
    bright = _REMISSION[material] * echoes.facing ** _MIRROR[material]
    tinted = np.flatnonzero(_TINTED[material])
    bright[tinted] *= np.clip(hits.tint[tinted].mean(axis=1), 0.01, 1.6) ** DYE
    if rng is None:
        return np.clip(np.maximum(bright, _RETRO[material]) * sensor.scale, 0, 1)
    places, varied = echoes.places(), np.zeros(len(bright), dtype=np.float32)
    for cell, weight in ANCHORS:
        varied += np.float32(weight) * _NORMAL[_hashed(places, cell)]
    bright *= np.maximum(1 + _SPREAD[material] * varied, 0.05)
    start, rate = sensor.fade
    if rate:
        # In the real scans grounds and walls fade alike: what counts is how far they are.
        bright -= np.float32(2 * rate) * np.log(np.maximum(hits.distance / np.float32(start), 1))
        dark, shine = (as_float(sensor.per_beam(name))[echoes.ring] for name in ("dark", "bright"))
        bright += shine + (dark - shine) * np.clip((0.36 - bright) / 0.14, 0, 2)
    bright += sensor.flicker / sensor.scale * rng.standard_normal(len(bright), dtype=np.float32)
    bright = np.where(bright < sensor.floor, 0, bright * np.float32(sensor.scale))
    retro = _RETRO[material] * as_float(rng.uniform(0.9, 1.06, len(bright)))
    return (np.floor(np.clip(np.maximum(bright, retro), 0, BRIGHTEST) * 100 + 0.5) / 100).astype(np.float32)


def _hashed(place: np.ndarray, cell: float) -> np.ndarray:
    """Numbers (N,) in [0, TABLE) that are the same throughout a cube of `cell` metres."""
    key = np.floor(place * np.float32(1 / cell)).astype(np.int32)
    mixed = key[:, 0] * np.int32(73856093) ^ key[:, 1] * np.int32(19349663) ^ key[:, 2] * np.int32(83492791)
    mixed = (mixed ^ (mixed >> 15)) * np.int32(0x2C1B3C6D)
    return (mixed ^ (mixed >> 12)) & (TABLE - 1)
