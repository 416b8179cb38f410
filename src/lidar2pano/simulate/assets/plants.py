"""Trees, bushes and hedges: wood as tubes, foliage as cards with a cut-out mask."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidar2pano.simulate.scene.mesh import Mesh, box, merged, quadrilaterals, tube


class Species(NamedTuple):
    """The shape of a species of tree; ranges are sampled uniformly.

    height   metres.
    spread   the crown's radius as a share of the height.
    clear    where the crown begins, as a share of the height.
    profile  the crown's radius at even steps from its foot to its top, relative to its widest.
    girth    radius of the trunk's foot, metres for each metre of height.
    bark, foliage  materials.
    tint     of the foliage.
    clumps   of leaves in the crown;  clump: their radius as a share of the crown's.
    cards    number of cards at detail 1 (for whorls: a rough number);  card: their side, metres.
    droop    how far twigs hang: 0 outwards, 1 down.
    whorls   branches stand in storeys around a trunk up to the top.
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


# Corners of a card, in halves of its size. Sprays of leaves grow from their foot into a kite, and the empty corners are
# left out: outside it are holes only.
KITE = np.array([(0, -1), (1.15, -0.1), (0, 1), (-1.15, -0.1)])


class _Cards(NamedTuple):
    """N cards: centre, direction of the tip, direction of the face, normal for shading, all (N, 3).

    size (N, 2) metres across and along;  tint (N, 3).
    """

    middle: np.ndarray
    tip: np.ndarray
    facing: np.ndarray
    lit: np.ndarray
    size: np.ndarray
    tint: np.ndarray


def tree(rng: np.random.Generator, name: str, detail: float = 1.0) -> Mesh:
    """A tree of one of SPECIES, 3 to 22 m high; `detail` scales the number of cards at constant density."""
    species = SPECIES[name]
    height = rng.uniform(*species.height)
    radius, foot = height * rng.uniform(*species.spread), height * rng.uniform(*species.clear)
    tint = np.array(species.tint) * rng.normal(1.0, (0.1, 0.05, 0.1)) * rng.uniform(0.8, 1.15)
    trunk = _trunk(rng, species, height)
    if species.whorls:
        cards, limbs = _whorls(rng, species, (height, foot, radius), detail), []
    else:
        clumps, radii = _clumps(rng, species, (height, foot, radius))
        cards = _crown(rng, species, clumps, radii, (foot, height, radius), detail)
        limbs = _limbs(rng, species, trunk, clumps, detail)
    wood = tube(trunk[:, :3], trunk[:, 3].tolist(), species.bark, sides=10 if detail > 0.5 else 6, closed=False)
    return merged(
        [merged([wood], "trunk"), *limbs, _leafed(cards._replace(tint=cards.tint * tint), species.foliage)],
        "vegetation",
    )


def bush(rng: np.random.Generator, detail: float = 1.0) -> Mesh:
    """A bush, 0.8 to 2.5 m high."""
    height = rng.uniform(0.8, 2.5)
    radius = height * rng.uniform(0.4, 0.65)
    tint = rng.normal(1.0, (0.15, 0.08, 0.15)) * rng.uniform(0.65, 1.2)
    species = SPECIES["fruit"]._replace(
        profile=(0.9, 1.0, 0.95, 0.8, 0.4),
        clumps=12,
        clump=0.5,
        cards=int(420 * height),
        card=0.27 + 0.05 * height,
        droop=-0.3,
    )
    clumps, radii = _clumps(rng, species, (height, 0.0, radius))
    species = species._replace(height=(height, height), spread=(radius / height, radius / height))
    cards = _crown(rng, species, clumps, radii, (0.0, height, radius), detail)
    stems = [
        tube([(0, 0, -0.1), 0.4 * clump + (0, 0, 0.1), clump], (0.03, 0.02, 0.01), "bark", sides=4, closed=False)
        for clump in clumps[:4]
    ]
    return merged([*stems, _leafed(cards._replace(tint=cards.tint * tint), "leaves")], "vegetation")


def hedge(rng: np.random.Generator, length: float, height: float, depth: float, detail: float = 1.0) -> Mesh:
    """A clipped hedge along x, its middle at the origin: a dark core under a skin of cards; metres."""
    core = box((0, 0, height / 2 - 0.2), (length - 0.24, depth - 0.24, height + 0.2), "hedge-core")
    half = np.array([length, depth, height]) / 2
    sides = np.array([(0, 1, 0), (0, -1, 0), (0, 0, 1), (1, 0, 0), (-1, 0, 0)], dtype=float)
    area = np.array([length * height, length * height, length * depth, depth * height, depth * height])
    side = 0.36 / np.sqrt(min(detail, 1.0)) ** 0.8
    count = max(int(area.sum() * 4.2 / side**2), 8)
    facing = sides[rng.choice(5, count, p=area / area.sum())]
    middle = rng.uniform(-1, 1, (count, 3))
    middle = np.where(facing != 0, facing, middle) * (half - 0.1) + rng.normal(0, 0.025, (count, 3)) + (0, 0, half[2])
    middle[:, 2] = np.maximum(middle[:, 2], 0.35 * side)
    rounder = _unit(facing + 0.35 * (middle - (0, 0, half[2])) / half)
    cards = _Cards(
        middle=middle,
        tip=_unit(rng.normal(0, 0.6, (count, 3)) + (0, 0, 0.7)),
        facing=_unit(facing + rng.normal(0, 0.4, (count, 3))),
        lit=_unit(rounder + rng.normal(0, 0.2, (count, 3))),
        size=np.repeat(side * rng.uniform(0.75, 1.2, (count, 1)), 2, axis=1),
        tint=_shades(rng, count, 0.16),
    )
    tint = rng.normal(1.0, (0.12, 0.06, 0.1)) * rng.uniform(0.8, 1.3)
    return merged([core, _leafed(cards._replace(tint=cards.tint * tint), "hedge")], "vegetation")


def _unit(way: np.ndarray) -> np.ndarray:
    return way / np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-9)


def _shades(rng: np.random.Generator, count: int, spread: float) -> np.ndarray:
    """Tints (count, 3) around 1: bright and dark, and a little towards yellow or blue."""
    light = np.clip(rng.normal(1.0, spread, (count, 1)), 0.4, 1.7)
    return light * np.clip(rng.normal(1.0, spread / 3, (count, 3)), 0.7, 1.3)


def _leafed(cards: _Cards, material: str) -> Mesh:
    """The cards as a mesh of outline KITE; v runs to the tip, u to the right."""
    count = len(cards.middle)
    across = _unit(np.cross(cards.tip, cards.facing)) * cards.size[:, :1] / 2
    along = _unit(np.cross(cards.facing, across)) * cards.size[:, 1:] / 2
    points = cards.middle[:, None] + KITE[:, :1] * across[:, None] + KITE[:, 1:] * along[:, None]
    uv = np.tile((0.998 * KITE + 1) / 2, (count, 1))
    # Towards its corners a card is lit as if it were bent, so that it does not look like a board.
    spread = (points - cards.middle[:, None]) / np.maximum(cards.size.max(axis=1)[:, None, None] / 2, 1e-9)
    normals = _unit(cards.lit[:, None] + 0.35 * spread).reshape(-1, 3)
    leaves = quadrilaterals(points.reshape(-1, 3), material, normals=normals, uv=uv)
    leaves.tint[:] = np.repeat(cards.tint, 2, axis=0)
    return leaves


def _trunk(rng: np.random.Generator, species: Species, height: float) -> np.ndarray:
    """Course and radius (8, 4) of the trunk, from just under the ground into the crown."""
    part = np.array([0, 0.05, 0.15, 0.3, 0.45, 0.6, 0.75, 0.97 if species.whorls else 0.85])
    bend = np.cumsum(rng.normal(0, 0.006, (8, 2)), axis=0) * height * (0.2 if species.whorls else 1.0)
    girth = species.girth * height * rng.uniform(0.6, 0.95) * (1 - 0.93 * part) * np.array([1.5, 1.1, 1, 1, 1, 1, 1, 1])
    course = np.column_stack([bend - bend[0], part * height, girth])
    course[0, 2] = -0.25
    return course


def _clumps(
    rng: np.random.Generator, species: Species, size: tuple[float, float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Centres (C, 3) and radii (C,) of the clumps of leaves; size: height, foot and radius of the crown."""
    height, foot, radius = size
    level = (np.arange(species.clumps) + rng.uniform(0, 1, species.clumps)) / species.clumps
    # As many clumps at a height as the crown is wide there.
    fine = np.linspace(0, 1, 60)
    wide = np.interp(fine, np.linspace(0, 1, len(species.profile)), species.profile)
    high = np.interp(level, np.cumsum(wide) / wide.sum(), fine)
    turn = 2.39996 * np.arange(species.clumps) + rng.normal(0, 0.5, species.clumps)
    lobes = 1 + 0.14 * np.cos(2 * (turn - rng.uniform(0, 6))) + 0.1 * np.cos(3 * (turn - rng.uniform(0, 6)))
    own = species.clump * radius * rng.uniform(0.7, 1.25, species.clumps)
    edge = np.interp(high, fine, wide) * radius * lobes
    inner = rng.uniform(0, 1, species.clumps) < 0.25
    away = np.maximum(edge - 0.8 * own, 0.1) * np.where(
        inner, rng.uniform(0.1, 0.6, species.clumps), rng.uniform(0.8, 1.08, species.clumps)
    )
    up = foot + 0.5 * own + high * np.maximum(height - foot - own, 0.2)
    return np.column_stack([away * np.cos(turn), away * np.sin(turn), up]), own


def _crown(  # noqa: PLR0913 the parts of a crown
    rng: np.random.Generator,
    species: Species,
    clumps: np.ndarray,
    radii: np.ndarray,
    size: tuple[float, float, float],
    detail: float,
) -> _Cards:
    """Cards on the shells of the clumps, shaded as one smooth body; size: foot, height, radius."""
    foot, height, radius = size
    # A crown wider than is common for its species has more and larger cards.
    grown = radius / (np.mean(species.height) * np.mean(species.spread))
    count = max(int(species.cards * detail * grown), 24)
    owner = rng.choice(len(clumps), count, p=radii**2 / (radii**2).sum())
    out = _unit(rng.normal(0, 1, (count, 3)) + (0, 0, 0.25))
    place = clumps[owner] + out * (radii[owner] * rng.uniform(0.55, 1.0, count))[:, None] * (1, 1, 0.8)
    place[:, 2] = np.maximum(place[:, 2], foot + 0.15 * species.card)
    heart = np.array([0, 0, foot + 0.4 * (height - foot)])
    reach = (place - heart) / (radius, radius, 0.6 * (height - foot))
    outwards = _unit(reach / (radius, radius, 0.6 * (height - foot)))
    facing = _unit(0.55 * outwards + 0.35 * out + rng.normal(0, 0.45, (count, 3)) + (0, 0, 0.15))
    facing *= np.where((facing * outwards).sum(1, keepdims=True) < 0, -1, 1)
    # Deep in the crown, and under each clump, it is darker.
    deep = np.clip(np.linalg.norm(reach, axis=1), 0, 1.1)
    shade = (0.35 + 0.65 * deep**1.5) * (0.86 + 0.18 * out[:, 2]) * (0.92 + 0.12 * np.clip(reach[:, 2], -1, 1))
    own = _shades(rng, len(clumps), 0.13)[owner] * _shades(rng, count, 0.07)
    side = species.card * np.sqrt(grown) / np.sqrt(min(detail, 1.0)) ** 0.85 * rng.uniform(0.75, 1.2, (count, 1))
    return _Cards(
        middle=place,
        tip=_unit(0.6 * outwards + 0.5 * rng.normal(0, 1, (count, 3)) - (0, 0, 1.6 * species.droop)),
        facing=facing,
        lit=_unit(0.7 * outwards + 0.55 * out + 0.2 * facing + (0, 0, 0.1)),
        size=side * ((0.75, 1.35) if species.droop > 0.7 else (1.0, 1.0)),
        tint=own * shade[:, None],
    )


def _limbs(
    rng: np.random.Generator, species: Species, trunk: np.ndarray, clumps: np.ndarray, detail: float
) -> list[Mesh]:
    """Main branches, from the trunk to some of the clumps; SemanticKITTI counts them as vegetation."""
    order = rng.permutation(len(clumps))[: int(np.clip(16 * detail, 3, 16))]
    limbs = []
    for target in clumps[order]:
        rise = rng.uniform(0.45, 0.8) * np.hypot(*target[:2])
        start = np.clip(target[2] - rise, trunk[2, 2], trunk[-1, 2] * 0.95)
        foot = np.array([np.interp(start, trunk[:, 2], trunk[:, axis]) for axis in (0, 1, 2)])
        thick = float(min(0.6 * np.interp(start, trunk[:, 2], trunk[:, 3]), 0.08 * np.linalg.norm(target - foot)))
        half = 0.5 * (foot + target) + (*rng.normal(0, 0.04 * rise + 0.02, 2), 0.12 * rise)
        course = np.array([foot, half, target])
        limbs.append(tube(course, (thick, 0.6 * thick, 0.15 * thick), species.bark, sides=5, closed=False))
    return limbs


def _whorls(rng: np.random.Generator, species: Species, size: tuple[float, float, float], detail: float) -> _Cards:
    """Branches in whorls, each a row of flat drooping sprays; size: height, foot, radius."""
    height, foot, radius = size
    step = species.card * 0.52 / np.sqrt(min(detail, 1.0)) ** 0.8
    levels = np.arange(foot, height - 0.3, step)
    part = (levels - foot) / (height - foot)
    wide = np.interp(part, np.linspace(0, 1, len(species.profile)), species.profile) * radius
    count = np.maximum((2 * np.pi * wide / (1.25 * step)).astype(int), 4).clip(4, 11)
    level = np.repeat(np.arange(len(levels)), count)
    turn = rng.uniform(0, 2 * np.pi, len(level))
    long = np.maximum(wide[level] * rng.uniform(0.72, 1.12, len(level)), 0.25)
    sprays = np.maximum((long / (0.75 * step)).astype(int), 1)
    branch = np.repeat(np.arange(len(level)), sprays)
    along = np.concatenate([(np.arange(n) + 0.75) / n for n in sprays])
    away = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(len(turn))])[branch]
    reach = (along * long[branch])[:, None]
    jitter = rng.normal(0, 0.12, len(level))[branch]
    sag = -species.droop * reach[:, 0] * (1 - 0.35 * along) + jitter
    middle = away * reach + np.column_stack([np.zeros((len(reach), 2)), levels[level[branch]] + sag + 0.2])
    middle[:, 2] = np.maximum(middle[:, 2], 0.3)
    n = len(middle)
    aside = np.column_stack([-away[:, 1], away[:, 0], np.zeros(n)]) * rng.normal(0, 0.5, (n, 1))
    shade = (0.35 + 0.65 * along) * (0.8 + 0.3 * rng.uniform(size=n))
    side = step / 0.52 * rng.uniform(0.8, 1.15, (n, 1)) * np.where(part[level[branch]] > 0.85, 0.7, 1.0)[:, None]
    return _Cards(
        middle=middle,
        tip=_unit(away + aside + (0, 0, -species.droop) + rng.normal(0, 0.15, (n, 3))),
        facing=_unit(0.45 * away + (0, 0, 0.8) + rng.normal(0, 0.35, (n, 3))),
        lit=_unit(away + (0, 0, 0.55) + rng.normal(0, 0.15, (n, 3))),
        size=side * (1.0, 1.15),
        tint=_shades(rng, len(level), 0.12)[branch] * _shades(rng, n, 0.1) * shade[:, None],
    )
