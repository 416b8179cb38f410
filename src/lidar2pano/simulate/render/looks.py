"""Looks: hour, weather, season and the camera's setting. The same streets, other pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from lidar2pano.simulate.render.noise import SIZE, bilinear, lottery, spectral
from lidar2pano.simulate.scene.random_streams import stream
from lidar2pano.simulate.scene.surfaces import MATERIAL_IDS, MATERIALS

Colour = tuple[float, float, float]
"""Linear RGB. As a radiance: 1 is a white sheet that lies square to the noon sun."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """Light, air and film.

    sun         unit vector towards the sun;  sun_colour: radiance of a white sheet square to it;  sun_deg: its radius.
    zenith, horizon   radiance of the clear sky;  glow: of the bright air around the sun.
    cover       share of the sky under clouds, in [0, 1];  cloud: their radiance;  cloud_seed: which clouds.
    haze_m      metres after which a thing has lost 63 % of its contrast to the air.
    turned      share of the broad leaves that are yellow, orange or brown;  litter: share of the ground under them.
    exposure    light 1 times this is the film's white;  balance: gains of R, G, B;  saturation: 1 leaves colours alone.
    """

    name: str
    sun: Colour
    sun_colour: Colour
    sun_deg: float
    zenith: Colour
    horizon: Colour
    glow: Colour
    cover: float
    cloud: Colour
    cloud_seed: int = 0
    haze_m: float = 4000.0
    turned: float = 0.0
    litter: float = 0.0
    exposure: float = 2.0
    balance: Colour = (1.0, 1.0, 1.0)
    saturation: float = 0.8


def look(name: str, seed: int = 0) -> Look:
    """The look `name` of LOOKS as the seed varies it: the sun's place, clouds, exposure."""
    if name not in LOOKS:
        raise ValueError(f"a look is one of {', '.join(LOOKS)}, not {name!r}")
    return LOOKS[name](seed)


def _sun(elevation_deg: float, azimuth_deg: float) -> Colour:
    e, a = np.radians(elevation_deg), np.radians(azimuth_deg)
    return float(np.cos(e) * np.cos(a)), float(np.cos(e) * np.sin(a)), float(np.sin(e))


def _day(seed: int) -> Look:
    rng = stream(seed, "look", "day")
    white = rng.uniform()  # how hazy the air is: from a blue sky to a blown one
    return Look(
        name="day",
        sun=_sun(rng.uniform(35, 60), rng.uniform(-180, 180)),
        sun_colour=(1.0, 0.94, 0.84),
        sun_deg=0.25,
        zenith=(0.035 + 0.06 * white, 0.10 + 0.06 * white, 0.24 + 0.02 * white),
        horizon=(0.36 + 0.34 * white, 0.48 + 0.27 * white, 0.56 + 0.22 * white),
        glow=(0.7, 0.66, 0.57),
        cover=float(rng.choice((0.05, 0.2, 0.4, 0.6))),
        cloud=(0.56, 0.575, 0.59),
        cloud_seed=seed,
        haze_m=float(rng.uniform(2500, 8000)),
        exposure=float(1.85 * 2 ** rng.uniform(-0.45, 0.35)),
        balance=(1.0, 1.0, 0.96),
    )


def _overcast(seed: int) -> Look:
    rng = stream(seed, "look", "overcast")
    return Look(
        name="overcast",
        sun=_sun(55, rng.uniform(-180, 180)),
        sun_colour=(0.0, 0.0, 0.0),
        sun_deg=10.0,
        zenith=(0.50, 0.52, 0.54),
        horizon=(0.36, 0.38, 0.40),
        glow=(0.08, 0.08, 0.08),
        cover=1.0,
        cloud=(0.46, 0.475, 0.49),
        cloud_seed=seed,
        haze_m=float(rng.uniform(900, 3000)),
        exposure=float(2.3 * 2 ** rng.uniform(-0.25, 0.25)),
        balance=(0.99, 1.0, 0.97),
    )


def _evening(seed: int) -> Look:
    rng = stream(seed, "look", "evening")
    return Look(
        name="evening",
        sun=_sun(rng.uniform(7, 16), rng.uniform(-180, 180)),
        sun_colour=(0.78, 0.50, 0.26),
        sun_deg=0.3,
        zenith=(0.10, 0.14, 0.22),
        horizon=(0.46, 0.36, 0.28),
        glow=(0.9, 0.55, 0.25),
        cover=float(rng.uniform(0.1, 0.6)),
        cloud=(0.46, 0.37, 0.33),
        cloud_seed=seed,
        haze_m=float(rng.uniform(1200, 4000)),
        exposure=float(2.9 * 2 ** rng.uniform(-0.3, 0.3)),
        balance=(1.0, 1.0, 1.02),
        saturation=0.9,
    )


def _autumn(seed: int) -> Look:
    rng = stream(seed, "look", "autumn")
    return Look(
        name="autumn",
        sun=_sun(rng.uniform(22, 38), rng.uniform(-180, 180)),
        sun_colour=(0.74, 0.64, 0.50),
        sun_deg=0.35,
        zenith=(0.17, 0.21, 0.27),
        horizon=(0.45, 0.46, 0.46),
        glow=(0.6, 0.52, 0.4),
        cover=float(rng.uniform(0.3, 0.8)),
        cloud=(0.58, 0.57, 0.56),
        cloud_seed=seed,
        haze_m=float(rng.uniform(500, 1800)),
        turned=float(rng.uniform(0.6, 0.95)),
        litter=float(rng.uniform(0.3, 0.8)),
        exposure=float(2.0 * 2 ** rng.uniform(-0.25, 0.25)),
        saturation=0.9,
    )


LOOKS: dict[str, Callable[[int], Look]] = {
    "day": _day,
    "overcast": _overcast,
    "evening": _evening,
    "autumn": _autumn,
}

# What broad leaves turn to, as linear RGB albedo: dull green, yellow, orange, red-brown, brown.
_TURNED = np.array(
    ((0.09, 0.09, 0.03), (0.24, 0.17, 0.03), (0.22, 0.11, 0.03), (0.14, 0.055, 0.025), (0.11, 0.07, 0.035))
)
_STAGES = (0.15, 0.40, 0.65, 0.82, 0.95)
_GREEN = np.array(MATERIALS["leaves"].colour, dtype=np.float32)[:, None]
SEASON_M = 0.7  # metres of a pixel in the picture of the season's stages
FALLEN = np.array((0.18, 0.10, 0.04), dtype=np.float32)  # albedo of leaves on the ground

_WILTING = np.zeros(len(MATERIALS), dtype=np.float32)  # how readily a plant turns
_LITTERED = np.zeros(len(MATERIALS), dtype=bool)
for _name, _share in {"leaves": 1.0, "hedge": 0.3, "grass": 0.12, "meadow": 0.25}.items():
    _WILTING[MATERIAL_IDS[_name]] = _share
for _name in (
    "grass",
    "meadow",
    "asphalt",
    "asphalt-new",
    "cobbles",
    "paving",
    "kerb",
    "gravel",
    "soil",
    "paint-white",
):
    _LITTERED[MATERIAL_IDS[_name]] = True


def littered(look: Look, material: np.ndarray) -> np.ndarray:
    """(N,) float32: the share of a surface that fallen leaves may cover; 0 in other seasons."""
    return _LITTERED[material] * np.float32(look.litter)


def seasoned(look: Look, albedo: np.ndarray, material: np.ndarray, tint: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Albedo (3, N) as the season colours it: neighbouring leaves turn alike, each a little as its tint (3, N) says."""
    plant = np.flatnonzero(_WILTING[material]) if look.turned else np.zeros(0, dtype=np.int64)
    if not len(plant):
        return albedo
    x, y, z = place[:, plant] / np.float32(SEASON_M)
    stage = bilinear(_stages(), x + 0.2 * z + look.cloud_seed % SIZE, y - 0.2 * z)
    stage += 0.12 * (lottery(tint[:, plant], 0.005, 5) - 0.5)
    turned = np.stack([np.interp(stage, _STAGES, colour) for colour in _TURNED.T]).astype(np.float32)
    share = np.float32(look.turned) * _WILTING[material[plant]]
    out = albedo.copy()
    out[:, plant] *= 1 + share * (turned / _GREEN - 1)
    return out


@cache
def _stages() -> np.ndarray:
    """How far the season has come, evenly spread over 0..1, in places some 20 m apart."""
    field = spectral("season", 0.8, 8, 30)
    order = np.empty(field.size, dtype=np.float32)
    order[np.argsort(field, axis=None, kind="stable")] = np.linspace(0, 1, field.size, dtype=np.float32)
    return order.reshape(field.shape)
