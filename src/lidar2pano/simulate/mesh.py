"""Mesh: triangles that know what they are made of and what they are."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from lidar2pano.simulate.kinds import KIND_IDS
from lidar2pano.simulate.materials import MATERIAL_IDS


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mesh:
    """V vertices and F triangles; things stand on z = 0 at their own origin and look along x (y left, z up), metres.

    vertices  (V, 3) float32;  normals (V, 3) float32 unit, pointing outwards.
    uv        (V, 2) float32: metres along the surface (the place in a texture).
    faces     (F, 3) int32, counter-clockwise from outside.
    material  (F,) uint8 of MATERIAL_IDS;  kind (F,) uint8 of KIND_IDS.
    tint      (F, 3) float32: multiplies the material's colour.
    """

    vertices: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    faces: np.ndarray
    material: np.ndarray
    kind: np.ndarray
    tint: np.ndarray

    def __len__(self) -> int:
        """Number of triangles."""
        return len(self.faces)

    def turned(self, rotation: np.ndarray, at: tuple[float, float, float]) -> Mesh:
        """The same thing turned by a rotation (3, 3), world from thing, and moved to `at`, metres."""
        R = np.asarray(rotation, dtype=np.float32).T
        vertices = self.vertices @ R + np.asarray(at, dtype=np.float32)
        return replace(self, vertices=vertices, normals=self.normals @ R)

    def placed(self, at: tuple[float, float, float], yaw: float = 0.0, scale: float = 1.0) -> Mesh:
        """The same thing at another place, metres, turned by `yaw` radians to the left, `scale` times as large."""
        c, s = np.cos(yaw), np.sin(yaw)
        grown = self if scale == 1 else replace(self, vertices=self.vertices * np.float32(scale))
        return grown.turned(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), at)

    def tinted(self, tint: tuple[float, float, float]) -> Mesh:
        """The same thing with every face's tint multiplied."""
        return replace(self, tint=self.tint * np.asarray(tint, dtype=np.float32))


def mesh(  # noqa: PLR0913 one array or name per field
    vertices: np.ndarray,
    faces: np.ndarray,
    material: str,
    kind: str,
    *,
    normals: np.ndarray | None = None,
    uv: np.ndarray | None = None,
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Mesh:
    """A mesh of one material and kind.

    Without `normals` the faces are flat (their vertices are not shared any more); without `uv` every face is unrolled
    along the axis plane that it lies in most.
    """
    vertices = np.asarray(vertices, dtype=np.float32).reshape(-1, 3)
    faces = np.asarray(faces, dtype=np.int32).reshape(-1, 3)
    if normals is None:
        vertices = vertices[faces].reshape(-1, 3)
        uv = None if uv is None else np.asarray(uv, dtype=np.float32)[faces].reshape(-1, 2)
        faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
        normals = np.repeat(face_normals(vertices, faces), 3, axis=0)
    uv = unrolled(vertices, normals) if uv is None else np.asarray(uv, dtype=np.float32)
    count = len(faces)
    return Mesh(
        vertices=vertices,
        normals=np.asarray(normals, dtype=np.float32),
        uv=uv,
        faces=faces,
        material=np.full(count, MATERIAL_IDS[material], dtype=np.uint8),
        kind=np.full(count, KIND_IDS[kind], dtype=np.uint8),
        tint=np.tile(np.asarray(tint, dtype=np.float32), (count, 1)),
    )


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products (..., 3) of vectors of one shape; for small arrays several times as fast as numpy's."""
    x = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    y = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    return np.stack([x, y, a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]], axis=-1)


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (F, 3) of triangles; zero for triangles without area."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normal = cross(b - a, c - a)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


def smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (V, 3): the mean of the faces around each vertex, by area."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normal = cross(b - a, c - a)
    total = np.zeros((len(vertices), 3))
    for corner in range(3):
        np.add.at(total, faces[:, corner], normal)
    return (total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)).astype(np.float32)


def unrolled(vertices: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Texture places (V, 2), metres: along and up walls, x and y on floors."""
    flat = np.abs(normals[:, 2]) > 0.7
    along = np.abs(normals[:, 1]) > np.abs(normals[:, 0])
    u = np.where(flat | along, vertices[:, 0], vertices[:, 1])
    return np.stack([u, np.where(flat, vertices[:, 1], vertices[:, 2])], axis=1).astype(np.float32)


def merged(meshes: Iterable[Mesh]) -> Mesh:
    """All meshes as one."""
    parts = [part for part in meshes if len(part)]
    if not parts:
        return mesh(np.zeros((0, 3)), np.zeros((0, 3)), "asphalt", "road")
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return Mesh(
        faces=np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]).astype(np.int32),
        **{
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("vertices", "normals", "uv", "material", "kind", "tint")
        },
    )
