"""Species of trees."""

from __future__ import annotations

from typing import NamedTuple


class Species(NamedTuple):
    """What a kind of tree looks like; ranges are drawn from evenly.

    height   metres.
    spread   the crown's radius, in parts of the height.
    clear    where the crown begins, in parts of the height.
    profile  the crown's radius at even steps from its foot to its top, in parts of its widest.
    girth    radius of the trunk's foot, metres for each metre of height.
    bark, foliage  materials.
    tint     of the foliage.
    clumps   heaps of leaves in the crown;  clump: their radius in parts of the crown's radius.
    cards    number of cards at detail 1 (for whorls: a rough number);  card: their side, metres.
    droop    how far twigs hang: 0 outwards, 1 down.
    whorls   branches stand in storeys around a trunk that goes to the top.
    """

    height: tuple[float, float]
    spread: tuple[float, float]
    clear: tuple[float, float]
    profile: tuple[float, ...]
    girth: float
    tint: tuple[float, float, float]
    clumps: int
    clump: float
    cards: int
    card: float
    droop: float = 0.3
    bark: str = "bark"
    foliage: str = "leaves"
    whorls: bool = False


ROUND = (0.35, 0.8, 1.0, 0.97, 0.75, 0.3)
SPECIES: dict[str, Species] = {
    "linden": Species((9, 15), (0.29, 0.38), (0.14, 0.22), ROUND, 0.017, (0.95, 1.0, 0.8), 50, 0.36, 2400, 0.6),
    "maple": Species((7, 12), (0.34, 0.44), (0.18, 0.27), ROUND, 0.017, (0.85, 0.9, 0.75), 40, 0.38, 2200, 0.56),
    "oak": Species(
        (10, 16), (0.36, 0.45), (0.15, 0.24), (0.5, 0.9, 1.0, 0.92, 0.7, 0.3), 0.026, (0.8, 0.8, 0.7), 60, 0.32,
        3000, 0.82,
    ),
    "birch": Species(
        (9, 15), (0.2, 0.26), (0.2, 0.3), (0.6, 1.0, 0.95, 0.7, 0.45, 0.15), 0.011, (1.25, 1.2, 0.9), 44, 0.34, 1500,
        0.5, 0.85, "bark-birch",
    ),
    "poplar": Species(
        (14, 22), (0.09, 0.12), (0.06, 0.12), (0.5, 0.85, 1.0, 0.95, 0.7, 0.2), 0.016, (0.95, 1.0, 0.85), 54, 0.6, 2200,
        0.55, -0.5,
    ),
    "fruit": Species((3.2, 5.5), (0.36, 0.48), (0.28, 0.36), ROUND, 0.024, (1.0, 1.0, 0.9), 20, 0.45, 1000, 0.42),
    "globe": Species(
        (4, 6.5), (0.26, 0.32), (0.42, 0.5), (0.55, 0.92, 1.0, 0.92, 0.6), 0.018, (0.9, 1.0, 0.8), 22, 0.5, 1100, 0.42
    ),
    "spruce": Species(
        (10, 20), (0.16, 0.22), (0.04, 0.1), (1.0, 0.86, 0.66, 0.45, 0.24, 0.03), 0.014, (1.0, 1.0, 1.0), 0, 0, 1800,
        0.85, 0.35, "bark", "needles", whorls=True,
    ),
    "pine": Species(
        (10, 17), (0.2, 0.27), (0.5, 0.62), (0.55, 1.0, 0.95, 0.8, 0.5), 0.015, (1.35, 1.2, 1.2), 22, 0.42, 1500, 0.6,
        -0.3, "bark", "needles",
    ),
}  # fmt: skip
STREET = ("linden", "maple", "birch", "globe", "linden", "maple", "oak")  # drawn where no species is asked for
