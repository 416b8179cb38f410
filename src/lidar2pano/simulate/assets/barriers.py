"""Fences, railings, walls and guard rails along x from 0 to `length` metres.

`ground` gives the height (N,) of the ground at x (N,), both in metres; a barrier follows it in pieces of about 2 m.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from lidar2pano.simulate.scene.mesh import PLAIN, Mesh, Tint, box, merged, mesh, tube
from lidar2pano.simulate.scene.random_streams import pick

GroundHeight = Callable[[np.ndarray], np.ndarray]
Finish = tuple[str, Tint]
"""Material and tint."""
PIECE = 2.0  # metres from post to post


def _post_positions(length: float, ground: GroundHeight, piece: float = PIECE) -> tuple[np.ndarray, np.ndarray]:
    """x of the posts, and the height of the ground there, both (N,)."""
    x = np.linspace(0.0, length, max(round(length / piece), 1) + 1)
    return x, np.asarray(ground(x), dtype=np.float64)


def _posts(x: np.ndarray, z: np.ndarray, size: tuple[float, float, float], finish: Finish, aside: float = 0.0) -> Mesh:
    """A box at each x, of `size` along x, y and above the ground; it reaches a little into the ground."""
    long, deep, high = size
    unit = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2
    ring = np.concatenate([np.column_stack([unit * (long, deep), np.full(4, level)]) for level in (-0.3, high)])
    points = np.stack([x, np.full_like(x, aside), z], axis=1)[:, None] + ring
    sides = np.array([(0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7), (4, 5, 6, 7)])
    faces = (8 * np.arange(len(x))[:, None, None] + sides).reshape(-1, 4)
    return mesh(points.reshape(-1, 3), _triangles(faces), *finish)


def _triangles(quads: np.ndarray) -> np.ndarray:
    return np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])


def _sheet(x: np.ndarray, z: np.ndarray, up: tuple[float, float], finish: Finish, *, part: bool) -> Mesh:
    """A thin upright sheet; v in metres, or from 0 to 1 over its height where `part`."""
    low, high = up
    points = np.concatenate([np.column_stack([x, 0 * x, z + level]) for level in up])
    run = np.concatenate([[0], np.cumsum(np.hypot(np.diff(x), np.diff(z)))])
    uv = np.column_stack([np.tile(run, 2), np.repeat((0.001, 0.999) if part else (0.0, high - low), len(x))])
    i, n = np.arange(len(x) - 1), len(x)
    quads = np.stack([i, i + 1, i + 1 + n, i + n], axis=1)
    normals = np.tile((0.0, -1.0, 0.0), (2 * n, 1))
    return mesh(points, _triangles(quads), *finish, normals=normals, uv=uv)


def _beam(x: np.ndarray, z: np.ndarray, profile: np.ndarray, finish: Finish) -> Mesh:
    """A profile (M, 2) of (y, height), counter-clockwise seen from +x, swept along the ground; with end faces."""
    n, m = len(x), len(profile)
    fan = np.array([(0, c, c + 1) for c in range(1, m - 1)])
    points, quads = _swept(x, z, profile, m)
    return mesh(points, np.concatenate([_triangles(quads[:, ::-1]), fan[:, ::-1], fan + (n - 1) * m]), *finish)


def _swept(x: np.ndarray, z: np.ndarray, line: np.ndarray, sides: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) of a line (M, 2) of (y, height) swept along the ground, and quads of its first `sides` sides."""
    n, m = len(x), len(line)
    points = np.stack([np.repeat(x, m), np.tile(line[:, 0], n), np.repeat(z, m) + np.tile(line[:, 1], n)], axis=1)
    i, j = np.meshgrid(np.arange(n - 1), np.arange(sides), indexing="ij")
    k = (j + 1) % m
    return points, np.stack([i * m + j, (i + 1) * m + j, (i + 1) * m + k, i * m + k], axis=-1).reshape(-1, 4)


def _bar(low: float, high: float, left: float, right: float) -> np.ndarray:
    """An oblong profile, counter-clockwise seen from +x: from `low` to `high`, y from `left` to `right`."""
    return np.array([(left, low), (right, low), (right, high), (left, high)])


def picket_fence(rng: np.random.Generator, length: float, ground: GroundHeight) -> Mesh:
    """Pickets on two rails between posts, 0.8 to 1.2 m high."""
    x, z = _post_positions(length, ground)
    high = rng.uniform(0.8, 1.2)
    tint = pick(rng, (PLAIN, (0.6, 0.6, 0.62), (1.9, 2.4, 3.2), (0.5, 0.9, 0.5)), p=(0.5, 0.2, 0.2, 0.1))
    finish = ("wood", tint)
    rails = [_beam(x, z, _bar(level, level + 0.07, 0.02, 0.06), finish) for level in (0.2, high - 0.3)]
    pales = _sheet(x, z, (0.06, high), ("pickets", tint), part=False)
    return merged([_posts(x, z, (0.09, 0.09, high + 0.05), finish, 0.06), *rails, pales], "fence")


def wire_fence(rng: np.random.Generator, length: float, ground: GroundHeight) -> Mesh:
    """Wire netting between steel posts, 0.9 to 2 m high."""
    x, z = _post_positions(length, ground, 2.5)
    high = rng.uniform(0.9, 2.0)
    tint = pick(rng, (PLAIN, (0.25, 0.6, 0.35), (0.4, 0.42, 0.45)))
    netting = _sheet(x, z, (0.03, high), ("wire", tint), part=False)
    posts = _posts(x, z, (0.05, 0.05, high + 0.06), ("plastic", tint))
    material = "plastic" if rng.uniform() < 0.7 else "wire"
    line = _beam(x, z, _bar(high - 0.01, high + 0.015, -0.012, 0.012), (material, tint))
    return merged([posts, netting, line], "fence")


def railing(rng: np.random.Generator, length: float, ground: GroundHeight) -> Mesh:
    """An iron railing of upright bars, 0.9 to 1.3 m high, sometimes on a low wall."""
    x, z = _post_positions(length, ground)
    foot = rng.choice((0.0, 0.0, 0.4))
    high = foot + rng.uniform(0.85, 1.25)
    tint = pick(rng, (PLAIN, (0.5, 1.6, 0.9), (4.0, 4.0, 4.2)))
    parts = [_sheet(x, z, (foot + 0.05, high), ("railing", tint), part=True)]
    parts.append(_posts(x, z, (0.05, 0.05, high + 0.08), ("dark-metal", tint)))
    parts.append(_beam(x, z, _bar(high - 0.03, high + 0.01, -0.02, 0.02), ("dark-metal", tint)))
    if foot:
        parts.append(merged([_beam(x, z, _bar(-0.4, foot, -0.12, 0.12), ("concrete", PLAIN))], "wall"))
    return merged(parts, "fence")


def wall(rng: np.random.Generator, length: float, ground: GroundHeight) -> Mesh:
    """A garden wall of plaster, stone or brick with a cap, 0.6 to 2 m high."""
    x, z = _post_positions(length, ground)
    material = pick(rng, ("plaster", "stone", "brick", "concrete"), p=(0.4, 0.3, 0.15, 0.15))
    light = rng.uniform(0.8, 1.15)
    high, half = 0.6 + 1.4 * rng.beta(1.2, 2.5), rng.uniform(0.1, 0.16)
    body = _beam(x, z, _bar(-0.5, high, -half, half), (material, (light, light, 0.95 * light)))
    cap = _beam(x, z, _bar(high, high + 0.06, -half - 0.05, half + 0.05), ("concrete", (0.95, 0.95, 0.95)))
    parts = [body, cap]
    if rng.uniform() < 0.35:  # piers
        piers = (0.34, 2 * half + 0.12, high + 0.15)
        parts.append(_posts(x[::2], z[::2], piers, (material, (light, light, light))))
    return merged(parts, "wall")


def guard_rail(rng: np.random.Generator, length: float, ground: GroundHeight) -> Mesh:
    """Steel posts with a W beam on the side of -y, its upper edge 0.75 m over the ground."""
    x, z = _post_positions(length, ground)
    light = rng.uniform(0.8, 1.1)
    finish = ("metal", (light, light, light))
    # The front of the beam from its lower edge to its upper, and back 5 mm behind it.
    y = -0.09 - np.array([0.0, 0.03, 0.08, 0.08, 0.03, 0.03, 0.08, 0.08, 0.03, 0.0])
    up = 0.44 + np.array([0.0, 0.01, 0.05, 0.09, 0.13, 0.18, 0.22, 0.26, 0.30, 0.31])
    front, back = np.column_stack([y, up]), np.column_stack([y + 0.005, up])
    fine = np.linspace(0, length, 2 * (len(x) - 1) + 1)
    parts = []
    for line in (front, back[::-1]):  # their outside is on the left, seen from +x
        points, quads = _swept(fine, np.interp(fine, x, z), line, len(line) - 1)
        parts.append(mesh(points, _triangles(quads), *finish))
    parts.append(_posts(x, z, (0.06, 0.11, 0.72), finish, 0.06))
    return merged([*parts, _posts(x, z + 0.42, (0.1, 0.12, 0.3), finish, -0.05)], "guard-rail")


def noise_barrier(rng: np.random.Generator, length: float, ground: GroundHeight) -> Mesh:
    """Panels between steel columns, 2.5 to 4.5 m high."""
    x, z = _post_positions(length, ground, 4.0)
    high = rng.uniform(2.5, 4.5)
    material = pick(rng, ("concrete", "wood", "metal"))
    finish = material, pick(rng, ((0.9, 0.95, 0.85), (0.6, 0.8, 0.65), (1.0, 0.95, 0.9)))
    parts = [_beam(x, z, _bar(-0.4, 0.5, -0.1, 0.1), ("concrete", (0.9, 0.9, 0.9)))]
    panels = max(round((high - 0.5) / 0.5), 1)
    for low, top in pairwise(np.linspace(0.5, high, panels + 1)):
        parts.append(_beam(x, z, _bar(low, top - 0.03, -0.06, 0.06), finish))
    parts.append(_beam(x, z, _bar(0.5, high - 0.03, -0.04, 0.04), finish))
    parts.append(_posts(x, z, (0.16, 0.2, high + 0.03), ("metal", (0.8, 0.8, 0.8))))
    return merged(parts, "wall")


def delineator(rng: np.random.Generator) -> Mesh:
    """A white post at the edge of a road, with a black band and a reflector towards +x."""
    height, lean = rng.uniform(0.95, 1.05), rng.normal(0, 0.02, 2)
    shaft = tube([(0, 0, -0.2), (*lean, height)], 0.06, "plastic", (1.7, 1.7, 1.7))
    band = tube([(*(0.7 * lean), height - 0.3), (*lean, height - 0.08)], 0.066, "dark-metal", (0.5, 0.5, 0.5))
    return merged([shaft, band, box((0.066, 0, height - 0.19), (0.01, 0.05, 0.16), "sign")], "pole")
