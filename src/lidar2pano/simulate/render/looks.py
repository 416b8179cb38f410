"""Looks: time of day, weather, season and exposure, and their sky. They never change the geometry."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np

from lidar2pano.simulate.render.textures import SIZE, bilinear, spatial_hash, spectral
from lidar2pano.simulate.scene.random_streams import stream
from lidar2pano.simulate.scene.surfaces import MATERIAL_IDS, MATERIALS

Colour = tuple[float, float, float]
"""Linear RGB. Radiance 1 is that of a white matt surface square to the noon sun."""
SEASON_M = 0.7  # metres: pixel size of the map of the season's stages
GROUND = (0.12, 0.118, 0.095)  # mean albedo of the land
DISC = 40.0  # radiance of the sun's disc over that of a white surface; images saturate either way
DOME = 2048  # samples of the sphere


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """Lighting, atmosphere, season and exposure.

    sun_direction    unit vector towards the sun;  sun_colour: radiance of a white surface square to it.
    sun_radius_deg   angular radius of the sun's disc.
    zenith, horizon  radiance of the clear sky;  glow: of the air around the sun.
    cloud_cover      share of the sky under clouds;  cloud_radiance: theirs;  cloud_seed: chooses them.
    haze_m           metres after which an object has lost 63 % of its contrast to the air.
    autumn_foliage   share of yellow, orange or brown leaves;  leaf_litter: share of the ground
                     under fallen leaves.
    exposure         factor from radiance to pixel values, where 1 is white;  white_balance: gains of R, G, B.
    saturation       1 leaves colours unchanged.
    """

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


SAMPLED = ("elevation", "azimuth", "cloud_cover", "haze_m", "autumn_foliage", "leaf_litter", "stops")
LOOKS: dict[str, dict[str, Any]] = {  # of SAMPLED values a pair is a range, more are alternatives; degrees
    "day": {
        "elevation": (35, 60), "sun_colour": (1.0, 0.94, 0.84), "sun_radius_deg": 0.25, "glow": (0.7, 0.66, 0.57),
        "cloud_cover": (0.05, 0.2, 0.4, 0.6), "cloud_radiance": (0.56, 0.575, 0.59), "haze_m": (2500, 8000),
        "exposure": 1.85, "stops": (-0.45, 0.35), "white_balance": (1.0, 1.0, 0.96),
    },
    "overcast": {
        "elevation": 55, "sun_colour": (0.0, 0.0, 0.0), "sun_radius_deg": 10.0, "zenith": (0.50, 0.52, 0.54),
        "horizon": (0.36, 0.38, 0.40), "glow": (0.08, 0.08, 0.08), "cloud_cover": 1.0,
        "cloud_radiance": (0.46, 0.475, 0.49), "haze_m": (900, 3000), "exposure": 2.3, "stops": (-0.25, 0.25),
        "white_balance": (0.99, 1.0, 0.97),
    },
    "evening": {
        "elevation": (7, 16), "sun_colour": (0.78, 0.50, 0.26), "sun_radius_deg": 0.3, "zenith": (0.10, 0.14, 0.22),
        "horizon": (0.46, 0.36, 0.28), "glow": (0.9, 0.55, 0.25), "cloud_cover": (0.1, 0.6),
        "cloud_radiance": (0.46, 0.37, 0.33), "haze_m": (1200, 4000), "exposure": 2.9, "stops": (-0.3, 0.3),
        "white_balance": (1.0, 1.0, 1.02), "saturation": 0.9,
    },
    "autumn": {
        "elevation": (22, 38), "sun_colour": (0.74, 0.64, 0.50), "sun_radius_deg": 0.35, "zenith": (0.17, 0.21, 0.27),
        "horizon": (0.45, 0.46, 0.46), "glow": (0.6, 0.52, 0.4), "cloud_cover": (0.3, 0.8),
        "cloud_radiance": (0.58, 0.57, 0.56), "haze_m": (500, 1800), "autumn_foliage": (0.6, 0.95),
        "leaf_litter": (0.3, 0.8), "exposure": 2.0, "stops": (-0.25, 0.25), "saturation": 0.9,
    },
}  # fmt: skip


def look(name: str, seed: int = 0) -> Look:
    """The look `name` of LOOKS with the sun, clouds and exposure of the seed."""
    rng = stream(seed, "look", name)
    values: dict[str, Any] = {"azimuth": (-180, 180)} | LOOKS[name]
    if name == "day":
        white = rng.uniform()  # haze: from a blue to a white sky
        values["zenith"] = (0.035 + 0.06 * white, 0.10 + 0.06 * white, 0.24 + 0.02 * white)
        values["horizon"] = (0.36 + 0.34 * white, 0.48 + 0.27 * white, 0.56 + 0.22 * white)
    for key in SAMPLED:
        if isinstance(choices := values.get(key), tuple):
            values[key] = float(rng.uniform(*choices) if len(choices) == 2 else rng.choice(choices))
    values["exposure"] *= 2 ** values.pop("stops")
    e, a = np.radians(values.pop("elevation")), np.radians(values.pop("azimuth"))
    sun = float(np.cos(e) * np.cos(a)), float(np.cos(e) * np.sin(a)), float(np.sin(e))
    return Look(sun_direction=sun, cloud_seed=seed, **values)


# Autumn colours of broad leaves, linear RGB albedo: dull green, yellow, orange, red-brown, brown.
_AUTUMN = np.array(
    ((0.09, 0.09, 0.03), (0.24, 0.17, 0.03), (0.22, 0.11, 0.03), (0.14, 0.055, 0.025), (0.11, 0.07, 0.035))
)
_STAGES = (0.15, 0.40, 0.65, 0.82, 0.95)
_GREEN = np.array(MATERIALS["leaves"].albedo, dtype=np.float32)[:, None]
FALLEN = np.array((0.18, 0.10, 0.04), dtype=np.float32)  # albedo of leaves on the ground

_WILTING = np.zeros(len(MATERIALS), dtype=np.float32)  # share of a plant in autumn colours
LITTERED = np.isin(  # materials under fallen leaves
    list(MATERIALS),
    ("grass", "meadow", "asphalt", "asphalt-new", "cobbles", "paving", "kerb", "gravel", "soil", "paint-white"),
)
for _name, _share in {"leaves": 1.0, "hedge": 0.3, "grass": 0.12, "meadow": 0.25}.items():
    _WILTING[MATERIAL_IDS[_name]] = _share


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


class Sky:
    """The sky of one look. Directions (3, N) float32 unit vectors, z up; radiances (3, N) linear RGB."""

    def __init__(self, look: Look) -> None:
        self._look = look
        self._sun = _as_column(look.sun_direction)
        self._shift = stream(look.cloud_seed, "clouds").uniform(0, SIZE, 4).astype(np.float32)
        self._puffs = spectral("puffs", 1.45, 1, 200)
        # The land reflects the light of the sun and of the sky; its own light on the sky is neglected.
        upwards = self._above(_dome()[:, _dome()[2] > 0], disc=False)
        mean = 2 * (upwards * _dome()[2, _dome()[2] > 0]).mean(axis=1, keepdims=True)
        self.ground = _as_column(GROUND) * (mean + 0.7 * _as_column(look.sun_colour) * max(look.sun_direction[2], 0.0))
        # Irradiance as nine spherical harmonics for `_basis` of a normal (Ramamoorthi 2001).
        share = np.repeat(np.array((1, 2 / 3, 1 / 4)), (1, 3, 5))
        light = self.radiance(_dome(), disc=False) @ _basis(_dome()).T
        self._harmonics = (4 * np.pi / DOME * light * share).astype(np.float32)  # (3, 9)

    @property
    def airlight(self) -> np.ndarray:
        """Radiance (3, 1) of the air at infinite distance."""
        look, clouds = self._look, 0.5 * self._look.cloud_cover
        return 0.9 * ((1 - clouds) * _as_column(look.horizon) + clouds * _as_column(look.cloud_radiance))

    def radiance(self, direction: np.ndarray, *, disc: bool = True) -> np.ndarray:
        """Radiance (3, N) of the sky, and of the land below the horizon."""
        out = self._above(direction, disc)
        land = np.flatnonzero(direction[2] < 0)
        if len(land):
            depth = np.clip(-direction[2, land] * 12, 0, 1)  # the horizon is hazy
            out[:, land] += (self.ground - out[:, land]) * depth
        return out

    def ambient(self, normal: np.ndarray) -> np.ndarray:
        """Radiance (3, N) of a white matt surface with these normals, lit by sky and land without the sun's disc."""
        return np.maximum(self._harmonics @ _basis(normal), 0)

    def _above(self, direction: np.ndarray, disc: bool) -> np.ndarray:
        look = self._look
        height = np.maximum(direction[2], 0)
        haze = np.exp(-6 * height)
        out = _as_column(look.zenith) + (_as_column(look.horizon) - _as_column(look.zenith)) * haze
        cosine = (direction * self._sun).sum(axis=0)
        shine = np.maximum(cosine, 0)
        shine = 0.22 * shine**6 + 0.35 * shine**60 + 0.8 * shine**900
        out += _as_column(look.glow) * shine
        if look.cloud_cover:
            opacity, brightness = self._clouds(direction, height)
            cloud = _as_column(look.cloud_radiance) * brightness + _as_column(look.glow) * (0.5 * shine)
            out += (cloud - out) * opacity
        if disc and any(look.sun_colour):
            blaze = (cosine > np.cos(np.radians(max(look.sun_radius_deg, 0.3)))).astype(np.float32)
            out += _as_column(look.sun_colour) * (DISC * (1 - look.cloud_cover * 0.5) * blaze)
        return out

    def _clouds(self, direction: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Opacity (0..1) of the clouds in each direction, and their brightness (about 1)."""
        away = np.float32(60) / (height + np.float32(0.11))  # a flat layer, curved down at the horizon
        x, y = direction[0] * away, direction[1] * away
        big = bilinear(self._puffs, x + self._shift[0], y + self._shift[1])
        small = bilinear(self._puffs, 3.7 * y + self._shift[2], 3.7 * x + self._shift[3])
        puff = big + 0.25 * small
        edge = np.float32(1.5 - 3.2 * self._look.cloud_cover)
        opacity = np.clip((puff - edge) * 0.9, 0, 1)
        opacity = opacity * opacity * (3 - 2 * opacity)
        brightness = 1.08 - 0.17 * np.clip(puff - edge - 0.4, -0.6, 2) + 0.04 * small
        return opacity * np.clip(height * 9 + 0.25, 0, 1), brightness


@lru_cache(maxsize=8)
def sky(look: Look) -> Sky:
    """The sky of a look, cached."""
    return Sky(look)


def _as_column(colour: tuple[float, float, float]) -> np.ndarray:
    return np.array(colour, dtype=np.float32)[:, None]


@lru_cache(maxsize=1)
def _dome() -> np.ndarray:
    """Directions (3, DOME) evenly over the sphere (Fibonacci spiral)."""
    z = 1 - (2 * np.arange(DOME) + 1) / DOME
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(DOME)
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z]).astype(np.float32)


def _basis(n: np.ndarray) -> np.ndarray:
    """Real spherical harmonics up to degree 2, (9, N)."""
    x, y, z = n
    return np.stack(
        [
            np.full_like(x, 0.282095),
            *(np.float32(0.488603) * axis for axis in (y, z, x)),
            *(np.float32(1.092548) * pair for pair in (x * y, y * z, x * z)),
            np.float32(0.315392) * (3 * z * z - 1),
            np.float32(0.546274) * (x * x - y * y),
        ]
    )
