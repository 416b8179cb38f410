"""The plots along the street of the demonstration scan: trees and bushes, houses, and what stands round a garden."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from demo_objects import BARK, LEAF, PAVING, STEEL, TIMBER, Matter, Solid, ball, box, drum, placed, prism

BACK = 8.0  # from the middle of the street to the back of the pavement, where the plots begin
Draw = Callable[..., np.random.Generator]  # the random numbers of a thing of this name


def foliage(rng: np.random.Generator, radii: tuple, lumps: int, size: tuple) -> list[Solid]:
    """Porous lumps of leaves that fill an ellipsoid around (0, 0, 0); `size` is the range of their radii."""
    parts = []
    for _ in range(lumps):
        way = rng.normal(size=3)
        where = way / np.linalg.norm(way) * rng.uniform(0.1, 1.3) ** 0.4 * np.array(radii)
        extent = tuple(rng.uniform(*size) * rng.uniform(0.7, 1.2, 3))
        pores = 0.9 * float(np.mean(extent))
        parts.append(ball(LEAF, "vegetation", where, extent, pores=pores, salt=int(rng.integers(1 << 30))))
    return parts


def tree(rng: np.random.Generator, height: float) -> list[Solid]:
    """A trunk that leans a little, limbs, and a crown that begins at about two metres."""
    lean, radius = rng.normal(0, 0.03, 2), rng.uniform(0.009, 0.016) * height + 0.05
    fork = rng.uniform(0.32, 0.42) * height
    top = (lean[0] * fork, lean[1] * fork, fork)
    parts = [
        drum(BARK, "trunk", ((0, 0, -0.3), top), radius),
        drum(BARK, "trunk", ((0, 0, -0.3), (0, 0, 0.2)), 1.2 * radius),
    ]
    for _ in range(4):
        angle, out = rng.uniform(0, 2 * np.pi), rng.uniform(0.15, 0.3) * height
        tip = (top[0] + out * np.cos(angle), top[1] + out * np.sin(angle), fork + 0.8 * out)
        parts.append(drum(BARK, "trunk", (top, tip), 0.4 * radius))
    low = rng.uniform(1.6, 2.4)
    wide, tall = rng.uniform(0.24, 0.34) * height, (height - low) / 2
    return parts + placed(foliage(rng, (wide, wide, tall), 220, (0.12, 0.4)), top[0], top[1], low + tall)


def bush(rng: np.random.Generator, radius: float) -> list[Solid]:
    """A rounded shrub that reaches the ground."""
    tall = radius * rng.uniform(0.7, 1.3)
    lumps = int(25 + 50 * radius)
    return placed(
        foliage(rng, (radius, radius, tall), lumps, (0.06 + 0.05 * radius, 0.13 + 0.16 * radius)), 0, 0, 0.85 * tall
    )


def hedge(rng: np.random.Generator, x0: float, x1: float, height: float) -> list[Solid]:
    """A clipped hedge along x, 0.7 m thick, with tufts that stand out of it."""
    salt = int(rng.integers(1 << 30))
    parts = [box(LEAF, "vegetation", (x0, -0.35, -0.3), (x1, 0.35, height), pores=0.3, salt=salt)]
    for _ in range(int(12 * (x1 - x0))):
        where = (rng.uniform(x0, x1), rng.uniform(-0.4, 0.4), rng.uniform(0.1, height))
        parts += placed(foliage(rng, (0.1, 0.1, 0.1), 1, (0.12, 0.34)), *where)
    return parts


def house(rng: np.random.Generator, x0: float, x1: float, front: float) -> list[Solid]:
    """A house with a gabled roof between x0 and x1, its front at y = front, with steps and perhaps a bay window."""
    depth, eaves, wide = rng.uniform(9, 11), rng.uniform(3.3, 6.2), x1 - x0
    wall = Matter(rng.uniform(0.36, 0.58), 0.08)
    ridge = rng.random() < 0.6  # along the street
    half, span = (wide / 2, depth / 2) if ridge else (depth / 2, wide / 2)
    profile = ((-span, -1.0), (span, -1.0), (span, eaves), (0.0, eaves + 0.8 * span), (-span, eaves))
    shell = placed([prism(wall, "building", profile, half, skin="facade")], 0, 0, 0, np.pi / 2 if ridge else 0.0)
    out = placed(shell, (x0 + x1) / 2, front + depth / 2)
    door = rng.uniform(x0 + 1, x1 - 2)
    out.append(box(PAVING, "building", (door - 0.3, front - 0.9, -0.3), (door + 1.4, front + 0.1, 0.35)))
    out.append(box(TIMBER, "building", (door - 0.4, front - 1.0, 2.3), (door + 1.5, front + 0.1, 2.45)))
    out += [
        drum(STEEL, "building", ((x, front - 0.08, -0.3), (x, front - 0.08, eaves)), 0.06) for x in (x0 + 0.2, x1 - 0.2)
    ]
    if rng.random() < 0.5:
        bay = rng.uniform(x0 + 1, x1 - 4)
        face = ((bay, -0.5), (bay + 2.6, -0.5), (bay + 2.6, 2.7), (bay, 2.7))
        out += placed([prism(wall, "building", face, 0.45, skin="facade")], 0, front - 0.35)
    return out


def boundary(rng: np.random.Generator, x0: float, x1: float) -> list[Solid]:
    """What closes a front garden towards the pavement: hedge, wall, pickets, or nothing."""
    kind, tall = rng.choice(4, p=(0.46, 0.2, 0.2, 0.14)), rng.uniform(0.7, 1.5)
    if kind == 0:
        return placed(hedge(rng, x0, x1, tall), 0, BACK + 0.4)
    if kind == 1:
        parts = [box(Matter(0.36, 0.08), "fence", (x0, BACK + 0.05, -0.4), (x1, BACK + 0.3, 0.75 * tall))]
        pillars = np.arange(x0, x1, 3.2)
        return parts + [
            box(Matter(0.42, 0.08), "fence", (x - 0.2, BACK, -0.4), (x + 0.2, BACK + 0.38, tall)) for x in pillars
        ]
    if kind == 2:
        fence = box(TIMBER, "fence", (x0, BACK + 0.1, -0.3), (x1, BACK + 0.14, 0.85 * tall), skin="pickets")
        posts = [
            drum(BARK, "fence", ((x, BACK + 0.12, -0.3), (x, BACK + 0.12, tall)), 0.05) for x in np.arange(x0, x1, 2.4)
        ]
        return [fence, *posts]
    return []


def thicket(draw: Draw, x0: float, x1: float) -> list[Solid]:
    """Trees and undergrowth in place of a house."""
    out = []
    for k in range(int(x1 - x0)):
        rng = draw("thicket", k)
        x, y = rng.uniform(x0, x1), BACK + rng.uniform(1.5, 14)
        out += placed(tree(rng, rng.uniform(4, 9)) if rng.random() < 0.35 else bush(rng, rng.uniform(0.7, 2.0)), x, y)
    return out


def lot(draw: Draw, x0: float, x1: float) -> list[Solid]:
    """A plot between x0 and x1: house, garden, boundaries. The street lies towards -y, its middle at y = 0."""
    rng = draw("plan")
    gap, front = rng.uniform(3.2, 6.5), rng.uniform(10.3, 13.0)
    left = x0 + gap * rng.uniform(0.2, 0.8)
    wild = rng.random() < 0.25  # nobody has built here yet
    out = thicket(draw, x0, x1) if wild else house(draw("house"), left, left + x1 - x0 - gap, front)
    gate = rng.uniform(x0 + 2, x1 - 2)
    for first, last in ((x0 + 0.2, gate - 0.6), (gate + 0.6, x1 - 0.2)):
        if last - first > 1.5:
            out += boundary(draw("boundary", int(last > gate)), first, last)
    for k in range(rng.integers(4, 10)):
        own = draw("bush", k)
        where = own.uniform(x0 + 1, x1 - 1), own.uniform(BACK + 0.9, front - 0.7)
        out += placed(bush(own, own.uniform(0.4, 1.2)), *where)
    if rng.random() < 0.45:
        own = draw("tree")
        out += placed(tree(own, own.uniform(4, 7)), own.uniform(x0 + 1.5, x1 - 1.5), BACK + 1.6)
    for k, x in enumerate(np.arange(x0, x1, 4.0)):  # the back gardens are full
        own = draw("back", k)
        out += placed(bush(own, own.uniform(1.3, 2.8)), x + own.uniform(0, 4), front + own.uniform(12, 22))
    if rng.random() < 0.4:
        out.append(box(TIMBER, "fence", (x0, front + 4, -0.4), (x1, front + 4.1, 1.8)))
    return out
