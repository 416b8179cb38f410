"""The sky: its radiance in every direction, and the irradiance of surfaces under it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from lidar2pano.simulate.render.looks import Look
from lidar2pano.simulate.render.noise import SIZE, bilinear, spectral
from lidar2pano.simulate.scene.random_streams import stream

GROUND = (0.12, 0.118, 0.095)  # mean albedo of the land
DISC = 40.0  # radiance of the sun's disc over that of a white surface; images saturate either way
DOME = 2048  # directions that sample the sphere


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
        self._harmonics = self._irradiance(_dome())

    @property
    def airlight(self) -> np.ndarray:
        """Radiance (3, 1) of the air at infinite distance."""
        look = self._look
        return 0.9 * (
            (1 - 0.5 * look.cloud_cover) * _as_column(look.horizon)
            + 0.5 * look.cloud_cover * _as_column(look.cloud_radiance)
        )

    def radiance(self, direction: np.ndarray, *, disc: bool = True) -> np.ndarray:
        """Radiance (3, N) of the sky, and of the land below the horizon."""
        out = self._above(direction, disc)
        below = np.flatnonzero(direction[2] < 0)
        if len(below):
            depth = np.clip(-direction[2, below] * 12, 0, 1)  # the horizon is hazy
            out[:, below] += (self.ground - out[:, below]) * depth
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

    def _irradiance(self, direction: np.ndarray) -> np.ndarray:
        """Irradiance as nine spherical harmonics (3, 9) for `_basis` of a normal (Ramamoorthi 2001)."""
        radiance = self.radiance(direction, disc=False)
        share = np.repeat(np.array((1, 2 / 3, 1 / 4)), (1, 3, 5))
        return (4 * np.pi / direction.shape[1] * (radiance @ _basis(direction).T) * share).astype(np.float32)


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
