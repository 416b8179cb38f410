"""Looks: time of day, weather, season and exposure. They change the images of a street, never its geometry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from lidar2pano.simulate.render.noise import SIZE, bilinear, spatial_hash, spectral
from lidar2pano.simulate.scene.random_streams import stream
from lidar2pano.simulate.scene.surfaces import MATERIAL_IDS, MATERIALS

Colour = tuple[float, float, float]
"""Linear RGB. Radiance 1 is that of a white matt surface square to the noon sun."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """Lighting, atmosphere, season and exposure.

    sun_direction    unit vector towards the sun;  sun_colour: radiance of a white surface square to it.
    sun_radius_deg   angular radius of the sun's disc.
    zenith, horizon  radiance of the clear sky;  glow: of the air around the sun.
    cloud_cover      share of the sky under clouds;  cloud_radiance: theirs;  cloud_seed: chooses them.
    haze_m           metres after which an object has lost 63 % of its contrast to the air.
    autumn_foliage   share of the broad leaves that are yellow, orange or brown;  leaf_litter: share of the ground
                     under fallen leaves.
    exposure         factor from radiance to pixel values, where 1 is white;  white_balance: gains of R, G, B.
    saturation       1 leaves colours unchanged.
    """

    name: str
    sun_direction: Colour
    sun_colour: Colour
    sun_radius_deg: float
    zenith: Colour
    horizon: Colour
    glow: Colour
    cloud_cover: float
    cloud_radiance: Colour
    cloud_seed: int = 0
    haze_m: float = 4000.0
    autumn_foliage: float = 0.0
    leaf_litter: float = 0.0
    exposure: float = 2.0
    white_balance: Colour = (1.0, 1.0, 1.0)
    saturation: float = 0.8


def look(name: str, seed: int = 0) -> Look:
    """The look `name` of LOOKS with the sun, clouds and exposure of the seed; ValueError for another name."""
    if name not in LOOKS:
        raise ValueError(f"a look is one of {', '.join(LOOKS)}, not {name!r}")
    return LOOKS[name](seed)


def _sun(elevation_deg: float, azimuth_deg: float) -> Colour:
    e, a = np.radians(elevation_deg), np.radians(azimuth_deg)
    return float(np.cos(e) * np.cos(a)), float(np.cos(e) * np.sin(a)), float(np.sin(e))


def _day(seed: int) -> Look:
    rng = stream(seed, "look", "day")
    white = rng.uniform()  # haze: from a blue to a white sky
    return Look(
        name="day",
        sun_direction=_sun(rng.uniform(35, 60), rng.uniform(-180, 180)),
        sun_colour=(1.0, 0.94, 0.84),
        sun_radius_deg=0.25,
        zenith=(0.035 + 0.06 * white, 0.10 + 0.06 * white, 0.24 + 0.02 * white),
        horizon=(0.36 + 0.34 * white, 0.48 + 0.27 * white, 0.56 + 0.22 * white),
        glow=(0.7, 0.66, 0.57),
        cloud_cover=float(rng.choice((0.05, 0.2, 0.4, 0.6))),
        cloud_radiance=(0.56, 0.575, 0.59),
        cloud_seed=seed,
        haze_m=float(rng.uniform(2500, 8000)),
        exposure=float(1.85 * 2 ** rng.uniform(-0.45, 0.35)),
        white_balance=(1.0, 1.0, 0.96),
    )


def _overcast(seed: int) -> Look:
    rng = stream(seed, "look", "overcast")
    return Look(
        name="overcast",
        sun_direction=_sun(55, rng.uniform(-180, 180)),
        sun_colour=(0.0, 0.0, 0.0),
        sun_radius_deg=10.0,
        zenith=(0.50, 0.52, 0.54),
        horizon=(0.36, 0.38, 0.40),
        glow=(0.08, 0.08, 0.08),
        cloud_cover=1.0,
        cloud_radiance=(0.46, 0.475, 0.49),
        cloud_seed=seed,
        haze_m=float(rng.uniform(900, 3000)),
        exposure=float(2.3 * 2 ** rng.uniform(-0.25, 0.25)),
        white_balance=(0.99, 1.0, 0.97),
    )


def _evening(seed: int) -> Look:
    rng = stream(seed, "look", "evening")
    return Look(
        name="evening",
        sun_direction=_sun(rng.uniform(7, 16), rng.uniform(-180, 180)),
        sun_colour=(0.78, 0.50, 0.26),
        sun_radius_deg=0.3,
        zenith=(0.10, 0.14, 0.22),
        horizon=(0.46, 0.36, 0.28),
        glow=(0.9, 0.55, 0.25),
        cloud_cover=float(rng.uniform(0.1, 0.6)),
        cloud_radiance=(0.46, 0.37, 0.33),
        cloud_seed=seed,
        haze_m=float(rng.uniform(1200, 4000)),
        exposure=float(2.9 * 2 ** rng.uniform(-0.3, 0.3)),
        white_balance=(1.0, 1.0, 1.02),
        saturation=0.9,
    )


def _autumn(seed: int) -> Look:
    rng = stream(seed, "look", "autumn")
    return Look(
        name="autumn",
        sun_direction=_sun(rng.uniform(22, 38), rng.uniform(-180, 180)),
        sun_colour=(0.74, 0.64, 0.50),
        sun_radius_deg=0.35,
        zenith=(0.17, 0.21, 0.27),
        horizon=(0.45, 0.46, 0.46),
        glow=(0.6, 0.52, 0.4),
        cloud_cover=float(rng.uniform(0.3, 0.8)),
        cloud_radiance=(0.58, 0.57, 0.56),
        cloud_seed=seed,
        haze_m=float(rng.uniform(500, 1800)),
        autumn_foliage=float(rng.uniform(0.6, 0.95)),
        leaf_litter=float(rng.uniform(0.3, 0.8)),
        exposure=float(2.0 * 2 ** rng.uniform(-0.25, 0.25)),
        saturation=0.9,
    )


LOOKS: dict[str, Callable[[int], Look]] = {"day": _day, "overcast": _overcast, "evening": _evening, "autumn": _autumn}

# Autumn colours of broad leaves, linear RGB albedo: dull green, yellow, orange, red-brown, brown.
_AUTUMN = np.array(
    ((0.09, 0.09, 0.03), (0.24, 0.17, 0.03), (0.22, 0.11, 0.03), (0.14, 0.055, 0.025), (0.11, 0.07, 0.035))
)
_STAGES = (0.15, 0.40, 0.65, 0.82, 0.95)
_GREEN = np.array(MATERIALS["leaves"].albedo, dtype=np.float32)[:, None]
SEASON_M = 0.7  # metres: pixel size of the map of the season's stages
FALLEN = np.array((0.18, 0.10, 0.04), dtype=np.float32)  # albedo of leaves on the ground

_WILTING = np.zeros(len(MATERIALS), dtype=np.float32)  # share of a plant that takes autumn colours
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


def litter_share(look: Look, material: np.ndarray) -> np.ndarray:
    """Share (N,) float32 of a surface that fallen leaves may cover; 0 in other seasons."""
    return _LITTERED[material] * np.float32(look.leaf_litter)


def seasonal_albedo(
    look: Look, albedo: np.ndarray, material: np.ndarray, tint: np.ndarray, place: np.ndarray
) -> np.ndarray:
    """Albedo (3, N) in autumn: neighbouring leaves have similar colours, varied by the hash of their tint (3, N)."""
    plant = np.flatnonzero(_WILTING[material]) if look.autumn_foliage else np.zeros(0, dtype=np.int64)
    if not len(plant):
        return albedo
    x, y, z = place[:, plant] / np.float32(SEASON_M)
    stage = bilinear(_stages(), x + 0.2 * z + look.cloud_seed % SIZE, y - 0.2 * z)
    stage += 0.12 * (spatial_hash(tint[:, plant], 0.005, 5) - 0.5)
    turned = np.stack([np.interp(stage, _STAGES, colour) for colour in _AUTUMN.T]).astype(np.float32)
    share = np.float32(look.autumn_foliage) * _WILTING[material[plant]]
    out = albedo.copy()
    out[:, plant] *= 1 + share * (turned / _GREEN - 1)
    return out


@cache
def _stages() -> np.ndarray:
    """Map of the season's progress, uniform over 0..1, with structures of about 20 m."""
    field = spectral("season", 0.8, 8, 30)
    order = np.empty(field.size, dtype=np.float32)
    order[np.argsort(field, axis=None, kind="stable")] = np.linspace(0, 1, field.size, dtype=np.float32)
    return order.reshape(field.shape)
