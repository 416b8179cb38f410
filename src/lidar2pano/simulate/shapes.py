"""Simple solids that things are built from, as Mesh; metres, z up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidar2pano.simulate.mesh import Mesh, cross, mesh, smooth_normals

_BOX = np.array([(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (2, 3, 7, 6), (1, 2, 6, 5), (3, 0, 4, 7)])
SIDES = ("bottom", "top", "right", "left", "front", "back")  # right is -y, front is +x


def box(  # noqa: PLR0913 a box has a place, a size and looks
    centre: Sequence[float] | np.ndarray,
    size: Sequence[float] | np.ndarray,
    material: str,
    kind: str,
    *,
    yaw: float = 0.0,
    without: Sequence[str] = (),
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Mesh:
    """A box around `centre` of `size` (along x, y, z), turned by `yaw` radians, some SIDES left out."""
    corner = np.array(
        [(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1), (-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)]
    )
    quads = _BOX[[i for i, side in enumerate(SIDES) if side not in without]]
    solid = polygons(corner * np.asarray(size) / 2, quads, material, kind, tint=tint)
    x, y, z = centre
    return solid.placed((x, y, z), yaw)


def polygons(
    points: np.ndarray,
    polygon: np.ndarray,
    material: str,
    kind: str,
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Mesh:
    """Flat convex polygons (P, n) of indices into points (N, 3), counter-clockwise from outside."""
    polygon = np.atleast_2d(polygon)
    fan = [polygon[:, [0, i, i + 1]] for i in range(1, polygon.shape[1] - 1)]
    return mesh(points, np.stack(fan, axis=1).reshape(-1, 3), material, kind, tint=tint)


def prism(
    outline: np.ndarray,
    low: float,
    high: float,
    material: str,
    kind: str,
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Mesh:
    """A convex outline (n, 2), counter-clockwise, raised from z = low to high; with top and bottom."""
    n = len(outline)
    points = np.concatenate([np.column_stack([outline, np.full(n, z)]) for z in (low, high)])
    i = np.arange(n)
    j = (i + 1) % n
    sides = np.stack([i, j, j + n, i + n], axis=1)
    triangles = [sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]]
    caps = np.stack([np.zeros(n - 2, int), i[1:-1], i[2:]], axis=1)
    return mesh(points, np.concatenate([*triangles, caps[:, ::-1], caps + n]), material, kind, tint=tint)


def tube(  # noqa: PLR0913 a tube has a course, a girth and looks
    course: np.ndarray,
    radius: float | Sequence[float] | np.ndarray,
    material: str,
    kind: str,
    *,
    sides: int = 8,
    closed: bool = True,
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Mesh:
    """A round tube along `course` (n, 3); `radius` one or n values; `closed`: with end caps. Smooth."""
    course = np.asarray(course, dtype=np.float64)
    n = len(course)
    radii = np.broadcast_to(np.asarray(radius, dtype=np.float64), (n,))
    way = np.gradient(course, axis=0)
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    aside = cross(way, np.where(np.abs(way[:, 2:]) > 0.9, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    for i in range(1, n):  # each ring turns as little as it can from the last, so that bends do not twist the tube
        level = aside[i - 1] - way[i] * (way[i] @ aside[i - 1])
        long = np.sqrt(level @ level)
        aside[i] = level / long if long > 1e-6 else aside[i]
    other = cross(way, aside)
    angle = np.arange(sides + 1) * (2 * np.pi / sides)
    round_ = np.cos(angle)[:, None] * aside[:, None] + np.sin(angle)[:, None] * other[:, None]
    points = course[:, None] + radii[:, None, None] * round_
    run = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(course, axis=0), axis=1))])
    around, along = np.meshgrid(angle * radii.mean(), run)
    grid = np.arange(n * (sides + 1)).reshape(n, sides + 1)
    faces = quads_of(grid)[:, ::-1]
    uv = np.stack([around, along], axis=-1).reshape(-1, 2)
    points, normals = points.reshape(-1, 3), round_.reshape(-1, 3)
    if closed:
        caps = [(grid[0, :-1], course[0], -way[0]), (grid[-1, :-1][::-1], course[-1], way[-1])]
        for rim, middle, normal in caps:
            start = len(points)
            points = np.concatenate([points, points[rim], middle[None]])
            normals = np.concatenate([normals, np.tile(normal, (sides + 1, 1))])
            uv = np.concatenate([uv, np.zeros((sides + 1, 2))])
            i = np.arange(sides)
            fan = np.stack([start + i, start + (i + 1) % sides, np.full(sides, start + sides)], axis=1)
            faces = np.concatenate([faces, fan[:, ::-1]])
    return mesh(points, faces, material, kind, normals=normals, uv=uv, tint=tint)


def ellipsoid(
    centre: Sequence[float] | np.ndarray,
    radii: Sequence[float] | np.ndarray,
    material: str,
    kind: str,
    detail: int = 8,
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Mesh:
    """An ellipsoid with `detail` rings and twice as many columns; smooth."""
    polar, turn = np.meshgrid(
        np.linspace(0, np.pi, detail + 1), np.linspace(0, 2 * np.pi, 2 * detail + 1), indexing="ij"
    )
    unit = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=-1)
    normals = unit / np.asarray(radii, dtype=np.float64)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    faces = quads_of(np.arange(unit.shape[0] * unit.shape[1]).reshape(unit.shape[:2]))
    uv = np.stack([turn * max(radii[:2]), polar * radii[2]], axis=-1).reshape(-1, 2)
    points = (unit * np.asarray(radii) + np.asarray(centre)).reshape(-1, 3)
    return mesh(points, faces, material, kind, normals=normals.reshape(-1, 3), uv=uv, tint=tint)


def loft(
    sections: np.ndarray,
    material: str,
    kind: str,
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Mesh:
    """A smooth skin over cross sections (n, m, 3), each an open or closed line of m points seen counter-clockwise.

    Looking along the way from section to section, the points run counter-clockwise.
    """
    n, m = sections.shape[:2]
    faces = quads_of(np.arange(n * m).reshape(n, m))[:, ::-1]
    points = np.asarray(sections, dtype=np.float32).reshape(-1, 3)
    return mesh(points, faces, material, kind, normals=smooth_normals(points, faces), uv=None, tint=tint)


def quads_of(grid: np.ndarray) -> np.ndarray:
    """Two triangles for each cell of a grid (n, m) of vertex indices: (2 (n-1) (m-1), 3)."""
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    return np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
