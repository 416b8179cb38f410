"""Cut-outs: alpha masks of leaves, wire and pickets, with period 1 in uv."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from lidar2pano.simulate.scene.random_streams import stream
from lidar2pano.simulate.scene.surfaces import MATERIALS

SIZE = 256  # pixels of a mask's side


def _grid() -> tuple[np.ndarray, np.ndarray]:
    v, u = np.meshgrid((np.arange(SIZE) + 0.5) / SIZE, (np.arange(SIZE) + 0.5) / SIZE, indexing="ij")
    return u, v


def _leaf(solid: np.ndarray, foot: np.ndarray, turn: float, length: float, width: float) -> None:
    """Draw one pointed leaf from its foot (u, v) towards `turn` (radians, 0 along u); lengths as shares of the side."""
    low = ((foot - length - width) * SIZE).astype(int).clip(0, SIZE)
    high = ((foot + length + width) * SIZE).astype(int).clip(0, SIZE)
    near = (slice(low[1], high[1]), slice(low[0], high[0]))
    v, u = (np.mgrid[near] + 0.5) / SIZE
    x, y = u - foot[0], v - foot[1]
    along = (x * np.cos(turn) + y * np.sin(turn)) / length
    across = np.abs(y * np.cos(turn) - x * np.sin(turn)) / width
    inside = (along > 0) & (along < 1)
    solid[near] |= inside & (across < np.sin(np.pi * np.clip(along, 0, 1) ** 0.75) / 2)


def _twigs(sides: int) -> list[tuple[np.ndarray, float, float]]:
    """Start, direction and length of the twigs of a spray that grows from (0.5, 0) upwards; the first is the stem."""
    twigs = [(np.array([0.5, 0.0]), np.pi / 2, 0.72)]
    for i, height in enumerate(np.linspace(0.06, 0.64, sides)):
        lean = (0.95 - 0.35 * height) * (1 if i % 2 else -1)
        twigs.append((np.array([0.5, height]), np.pi / 2 + lean, 0.44 * (1 - 0.72 * height)))
    return twigs


def _leaves() -> np.ndarray:
    """Broad leaves on side twigs of uneven length: single leaves at the rim, gaps between the twigs."""
    rng, solid = stream(0, "cutout", "leaves"), np.zeros((SIZE, SIZE), dtype=bool)
    for foot, turn, length in _twigs(8):
        way = np.array([np.cos(turn), np.sin(turn)])
        end = length * rng.uniform(0.65, 1.12)
        _leaf(solid, foot, turn, end, 0.012)
        for i, away in enumerate(np.arange(0.05, end, 0.033)):
            side = rng.uniform(0.4, 1.3) * (1 if i % 2 else -1)
            size = rng.uniform(0.095, 0.145)
            _leaf(solid, foot + away * way, turn + side, size, 0.6 * size)
        _leaf(solid, foot + 0.95 * end * way, turn + rng.normal(0, 0.2), 0.11, 0.06)
    return solid


def _needles() -> np.ndarray:
    """A spray of a conifer: twigs set with short, stiff needles."""
    rng, solid = stream(0, "cutout", "needles"), np.zeros((SIZE, SIZE), dtype=bool)
    for foot, turn, length in _twigs(11):
        way = np.array([np.cos(turn), np.sin(turn)])
        _leaf(solid, foot, turn, length, 0.03)
        for away in np.arange(0.0, length, 0.024):
            for side in (-1, 1):
                _leaf(solid, foot + away * way, turn + side * rng.uniform(0.5, 0.9), rng.uniform(0.08, 0.12), 0.018)
    return solid


def _wire() -> np.ndarray:
    u, v = _grid()
    return (np.abs((u * 12) % 1 - 0.5) > 0.44) | (np.abs((v * 5) % 1 - 0.5) > 0.47)


def _pickets() -> np.ndarray:
    u, _ = _grid()
    return (u * 8) % 1 < 0.66


def _railing() -> np.ndarray:
    u, v = _grid()
    return ((u * 8) % 1 < 0.16) | (v % 1 < 0.04) | (v % 1 > 0.96)


CUTOUTS: dict[str, Callable[[], np.ndarray]] = {
    "leaves": _leaves,
    "needles": _needles,
    "wire": _wire,
    "pickets": _pickets,
    "railing": _railing,
}


@cache
def masks() -> tuple[np.ndarray, np.ndarray]:
    """Masks (C, SIZE, SIZE) bool, True where solid, and the index of each material's mask (M,), -1 for none."""
    names = list(CUTOUTS)
    stack = np.stack([CUTOUTS[name]() for name in names])
    index = [names.index(material.cutout) if material.cutout else -1 for material in MATERIALS.values()]
    return stack, np.array(index, dtype=np.int64)


def solid_at(uv: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Whether cut-outs `mask` (N,) are solid at uv (N, 2): (N,) bool."""
    cell = ((uv % 1) * SIZE).astype(np.int64).clip(0, SIZE - 1)
    return masks()[0][mask, cell[:, 1], cell[:, 0]]
