"""Triangle meshes with materials and object types, and the primitives of their construction; metres, z up."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidar2pano.simulate.scene.surfaces import MATERIAL_IDS, OBJECT_TYPE_IDS

Point = Sequence[float] | np.ndarray
Points = Sequence[Point] | np.ndarray
Tint = tuple[float, float, float]
"""Factors on the linear RGB albedo of a material."""
PLAIN: Tint = (1.0, 1.0, 1.0)
UNTYPED = 254  # object type of a mesh until it is `merged` into an object


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mesh:
    """V vertices and F triangles in the object frame: origin on the ground, x forward, y left, z up; metres.

    vertices  (V, 3) float32;  normals (V, 3) float32 unit, pointing outwards.
    uv        (V, 2) float32 texture coordinates: metres along the surface.
    faces     (F, 3) int32, counter-clockwise from outside.
    material  (F,) uint8 of MATERIAL_IDS;  object_type (F,) uint8 of OBJECT_TYPE_IDS, or UNTYPED.
    tint      (F, 3) float32: multiplies the material's albedo.
    """

    vertices: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    faces: np.ndarray
    material: np.ndarray
    object_type: np.ndarray
    tint: np.ndarray

    def __len__(self) -> int:
        """Number of triangles."""
        return len(self.faces)

    def transformed(self, rotation: np.ndarray, position: Point) -> Mesh:
        """The mesh rotated by R_world_object (3, 3) and translated to `position`, metres."""
        R = np.asarray(rotation, dtype=np.float32).T
        vertices = self.vertices @ R + np.asarray(position, dtype=np.float32)
        return replace(self, vertices=vertices, normals=self.normals @ R)

    def placed(self, position: Point, yaw: float = 0.0) -> Mesh:
        """The mesh rotated by `yaw` radians to the left, and translated to `position`, metres."""
        c, s = np.cos(yaw), np.sin(yaw)
        return self.transformed(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), position)


def mesh(
    vertices: Points,
    faces: Points,
    material: str,
    tint: Tint = PLAIN,
    *,
    normals: np.ndarray | None = None,
    uv: np.ndarray | None = None,
) -> Mesh:
    """A mesh of one material and tint, UNTYPED.

    Without `normals` faces are flat and share no vertices; without `uv` each face is projected onto the axis plane
    closest to it.
    """
    vertices = np.asarray(vertices, dtype=np.float32).reshape(-1, 3)
    faces = np.asarray(faces, dtype=np.int32).reshape(-1, 3)
    if normals is None:
        vertices = vertices[faces].reshape(-1, 3)
        uv = None if uv is None else np.asarray(uv, dtype=np.float32)[faces].reshape(-1, 2)
        faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
        normals = np.repeat(face_normals(vertices, faces), 3, axis=0)
    uv = projected_uv(vertices, normals) if uv is None else np.asarray(uv, dtype=np.float32)
    count = len(faces)
    return Mesh(
        vertices=vertices,
        normals=np.asarray(normals, dtype=np.float32),
        uv=uv,
        faces=faces,
        material=np.full(count, MATERIAL_IDS[material], dtype=np.uint8),
        object_type=np.full(count, UNTYPED, dtype=np.uint8),
        tint=np.tile(np.asarray(tint, dtype=np.float32), (count, 1)),
    )


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (F, 3) of triangles; zero for triangles without area."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


def smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (V, 3): the area-weighted mean of the faces around each vertex."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    total = np.zeros((len(vertices), 3))
    for corner in range(3):
        np.add.at(total, faces[:, corner], normal)
    return (total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)).astype(np.float32)


def projected_uv(vertices: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Texture coordinates (V, 2), metres: along and up walls, x and y on floors."""
    flat = np.abs(normals[:, 2]) > 0.7
    along = np.abs(normals[:, 1]) > np.abs(normals[:, 0])
    u = np.where(flat | along, vertices[:, 0], vertices[:, 1])
    return np.stack([u, np.where(flat, vertices[:, 1], vertices[:, 2])], axis=1).astype(np.float32)


def merged(meshes: Iterable[Mesh], object_type: str = "") -> Mesh:
    """All meshes as one; `object_type`: of the untyped ones."""
    parts = [part for part in meshes if len(part)]
    if not parts:
        return mesh(np.zeros((0, 3)), np.zeros((0, 3)), "asphalt")
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    whole = Mesh(
        faces=np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]).astype(np.int32),
        **{
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("vertices", "normals", "uv", "material", "object_type", "tint")
        },
    )
    if object_type:
        whole.object_type[whole.object_type == UNTYPED] = OBJECT_TYPE_IDS[object_type]
    return whole


_BOX = np.array([(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (2, 3, 7, 6), (1, 2, 6, 5), (3, 0, 4, 7)])
SIDES = ("bottom", "top", "right", "left", "front", "back")  # right is -y, front is +x


def box(centre: Point, size: Point, material: str, tint: Tint = PLAIN, *, open_sides: Sequence[str] = ()) -> Mesh:
    """A box of `size` (along x, y, z) around `centre`, without some of SIDES."""
    corner = np.array(
        [(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1), (-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)]
    )
    quads = _BOX[[i for i, side in enumerate(SIDES) if side not in open_sides]]
    return polygons(corner * np.asarray(size) / 2, quads, material, tint).placed(centre)


def polygons(points: Points, polygon: Points, material: str, tint: Tint = PLAIN, **more: np.ndarray) -> Mesh:
    """Flat convex polygons (P, n) of indices into points (N, 3), counter-clockwise from outside; `more`: of `mesh`."""
    corners = np.asarray(polygon)
    fan = [corners[:, [0, i, i + 1]] for i in range(1, corners.shape[1] - 1)]
    return mesh(points, np.stack(fan, axis=1).reshape(-1, 3), material, tint, **more)


def quadrilaterals(points: np.ndarray, material: str, tint: Tint = PLAIN, **more: np.ndarray) -> Mesh:
    """Quadrilaterals whose corners are every four of points (4 N, 3); see `polygons`."""
    return polygons(points, np.arange(len(points)).reshape(-1, 4), material, tint, **more)


def tube(
    course: Points, radius: float | Point, material: str, tint: Tint = PLAIN, *, sides: int = 8, closed: bool = True
) -> Mesh:
    """A smooth tube along the centreline `course` (n, 3); `radius`: one or n values; `closed`: with end caps."""
    course = np.asarray(course, dtype=np.float64)
    n = len(course)
    radii = np.broadcast_to(np.asarray(radius, dtype=np.float64), (n,))
    tangent = np.gradient(course, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    aside = np.cross(tangent, np.where(np.abs(tangent[:, 2:]) > 0.9, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    for i in range(1, n):  # parallel transport: bends do not twist the tube
        level = aside[i - 1] - tangent[i] * (tangent[i] @ aside[i - 1])
        long = np.sqrt(level @ level)
        aside[i] = level / long if long > 1e-6 else aside[i]
    binormal = np.cross(tangent, aside)
    angle = np.arange(sides + 1) * (2 * np.pi / sides)
    radial = np.cos(angle)[:, None] * aside[:, None] + np.sin(angle)[:, None] * binormal[:, None]
    points = course[:, None] + radii[:, None, None] * radial
    run = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(course, axis=0), axis=1))])
    turns, along = np.meshgrid(angle * radii.mean(), run)
    grid = np.arange(n * (sides + 1)).reshape(n, sides + 1)
    faces = quads_of(grid)[:, ::-1]
    uv = np.stack([turns, along], axis=-1).reshape(-1, 2)
    points, normals = points.reshape(-1, 3), radial.reshape(-1, 3)
    if closed:
        caps = [(grid[0, :-1], course[0], -tangent[0]), (grid[-1, :-1][::-1], course[-1], tangent[-1])]
        for rim, middle, normal in caps:
            start = len(points)
            points = np.concatenate([points, points[rim], middle[None]])
            normals = np.concatenate([normals, np.tile(normal, (sides + 1, 1))])
            uv = np.concatenate([uv, np.zeros((sides + 1, 2))])
            i = np.arange(sides)
            fan = np.stack([start + i, start + (i + 1) % sides, np.full(sides, start + sides)], axis=1)
            faces = np.concatenate([faces, fan[:, ::-1]])
    return mesh(points, faces, material, tint, normals=normals, uv=uv)


def ellipsoid(centre: Point, radii: Point, material: str, tint: Tint = PLAIN, *, detail: int = 8) -> Mesh:
    """A smooth ellipsoid with `detail` rings of twice as many faces."""
    polar, turn = np.meshgrid(
        np.linspace(0, np.pi, detail + 1), np.linspace(0, 2 * np.pi, 2 * detail + 1), indexing="ij"
    )
    unit = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=-1)
    normals = unit / np.asarray(radii, dtype=np.float64)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    faces = quads_of(np.arange(unit.shape[0] * unit.shape[1]).reshape(unit.shape[:2]))
    uv = np.stack([turn * max(radii[:2]), polar * radii[2]], axis=-1).reshape(-1, 2)
    points = (unit * np.asarray(radii) + np.asarray(centre)).reshape(-1, 3)
    return mesh(points, faces, material, tint, normals=normals.reshape(-1, 3), uv=uv)


def loft(sections: np.ndarray, material: str, tint: Tint = PLAIN) -> Mesh:
    """A smooth surface through cross sections (n, m, 3), open or closed lines of m points.

    Seen along the direction from section to section, the points run counter-clockwise.
    """
    n, m = sections.shape[:2]
    faces = quads_of(np.arange(n * m).reshape(n, m))[:, ::-1]
    points = np.asarray(sections, dtype=np.float32).reshape(-1, 3)
    return mesh(points, faces, material, tint, normals=smooth_normals(points, faces), uv=None)


def quads_of(grid: np.ndarray) -> np.ndarray:
    """Two triangles for each cell of a grid (n, m) of vertex indices: (2 (n-1) (m-1), 3)."""
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    return np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
