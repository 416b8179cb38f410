"""Shells of buildings: four walls with a style, their windows and doors, and a plinth."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lidar2pano.simulate.facades import DEEP, PLAIN, Boards, Opening, Style, Tint, Wall, filled, pierced
from lidar2pano.simulate.mesh import Mesh
from lidar2pano.simulate.roofs import Roof

PLASTERS: tuple[Tint, ...] = (
    (1.14, 1.16, 1.24), (1.14, 1.16, 1.24), (1.1, 1.08, 1.02), (1.14, 1.04, 0.86), (1.12, 0.98, 0.66),
    (0.98, 0.78, 0.5), (1.08, 0.84, 0.7), (0.82, 0.84, 0.9), (0.86, 0.94, 0.78), (0.6, 0.6, 0.62), (0.9, 0.66, 0.52),
    (0.95, 0.92, 0.86),
)  # fmt: skip
SHUTTERS: tuple[Tint, ...] = (
    (0.3, 0.5, 0.3),
    (0.55, 0.3, 0.15),
    (0.7, 0.25, 0.2),
    (1.5, 1.5, 1.5),
    (0.35, 0.45, 0.6),
    (0.9, 0.85, 0.75),
)
DOORS: tuple[Tint, ...] = (
    PLAIN,
    (0.7, 0.45, 0.25),
    (1.9, 2.1, 2.5),
    (0.4, 0.6, 0.6),
    (0.9, 0.35, 0.3),
    (0.5, 0.55, 0.65),
)
COVERS: tuple[tuple[str, Tint], ...] = (
    ("tiles", PLAIN), ("tiles", (1.15, 1.1, 1.0)), ("tiles", (0.8, 0.8, 0.85)), ("tiles", (0.6, 0.75, 0.9)),
    ("slate", PLAIN), ("slate", (1.5, 1.4, 1.3)),
)  # fmt: skip


class Shell(NamedTuple):
    """The walls of a building and what is in them."""

    walls: dict[str, Wall]
    looks: tuple[str, Tint]
    style: Style
    base: float  # height of the ground floor
    storeys: int
    storey: float  # height of each
    dressed: tuple[str, ...] = ("front", "left", "back", "right")  # walls with borders around their windows

    @property
    def eaves(self) -> float:
        """Height of the walls."""
        return self.base + self.storeys * self.storey

    def sill(self, floor: int) -> float:
        """Height of the window sills of a floor."""
        return self.base + floor * self.storey + 0.9


def pick(rng: np.random.Generator, choices: tuple[Tint, ...]) -> Tint:
    """One of some tints."""
    return choices[int(rng.integers(len(choices)))]


def window_style(rng: np.random.Generator, shutters: str, wall: Tint) -> Style:
    """A style of windows; `shutters` as in Style, `wall` the tint of the plaster in the reveals."""
    dark = rng.uniform() < 0.2
    return Style(
        frame=(0.35, 0.22, 0.14) if dark else (0.35, 0.36, 0.38) if rng.uniform() < 0.15 else PLAIN,
        cross=bool(rng.uniform() < 0.25),
        shutters=shutters,
        shutter=pick(rng, SHUTTERS)
        if shutters == "swing"
        else (1.5, 1.5, 1.5)
        if rng.uniform() < 0.7
        else (0.9, 0.85, 0.75),
        surround=("stone", "plaster", "")[int(rng.choice(3, p=(0.15, 0.2, 0.65)))],
        surround_tint=(1.1, 0.85, 0.75) if rng.uniform() < 0.4 else (1.2, 1.2, 1.2),
        reveal=wall,
        sill=(0.9, 0.9, 0.9) if rng.uniform() < 0.6 else (1.5, 1.55, 1.6),
        door=pick(rng, DOORS),
    )


def window_columns(rng: np.random.Generator, length: float, every: float) -> list[float]:
    """Middles of windows along a wall."""
    count = max(round((length - 0.6) / every), 1)
    margin = length / count / 2
    middles = np.linspace(margin, length - margin, count) + rng.uniform(-0.06, 0.06, count) * length / count
    return [float(middle) for middle in middles]


def gabled(roof: Roof, name: str) -> bool:
    """Whether a wall ends in a gable; only for roofs that have gables at left and right (their ridge along y)."""
    return roof.form != "hip" and name in ("left", "right")


def shut(
    rng: np.random.Generator, boards: Boards, shell: Shell, holes: dict[str, list[Opening]], roof: Roof | None
) -> list[Mesh]:
    """The four walls around their openings, and what fills these."""
    parts = []
    for name, wall in shell.walls.items():
        if roof is not None and gabled(roof, name):
            top, bends = roof.gable(wall.length)
        else:
            top, bends = _level(shell.eaves + 0.04), []
        parts.append(pierced(wall, DEEP, top, bends, holes[name], *shell.looks))
        style = shell.style if name in shell.dressed else shell.style._replace(surround="")
        for hole in holes[name]:
            filled(boards, wall, hole, style, rng)
    return parts


def _level(height: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda along: np.full(len(along), height)


def plinth(boards: Boards, shell: Shell, holes: dict[str, list[Opening]], tint: Tint) -> None:
    """A plinth around the walls, up to the ground floor; it leaves out the doors."""
    for name, wall in shell.walls.items():
        edges = [-0.03, wall.length + 0.03]
        for hole in holes[name]:
            if hole.low < shell.base + 0.1:
                edges += [hole.along[0] - 0.02, hole.along[1] + 0.02]
        edges.sort()
        for span in zip(edges[::2], edges[1::2], strict=True):
            boards.add(wall, span, (0.0, 0.03), (DEEP, max(shell.base, 0.3)), "plaster", tint, "flrt")
