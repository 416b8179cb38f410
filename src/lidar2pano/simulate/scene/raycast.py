"""Ray casting with Embree (optional package embreex)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from lidar2pano.errors import require_extra
from lidar2pano.simulate.scene.mesh import Mesh, face_normals, merged
from lidar2pano.simulate.scene.surfaces import RAW_IDS, RAW_MOVING_IDS, SKY, masks, solid_at

LAYERS = 8  # most surfaces with cut-outs in the way of a ray: the last one stops it, hole or not
SHADOW_LAYERS = 4  # the same for shadow rays
STEP = 2e-4  # metres behind a hole at which a ray is cast again


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneObject:
    """A mesh in the world frame: `instance` as in SemanticKITTI's labels (0 = none); `moving`: of a moving class."""

    mesh: Mesh
    instance: int = 0
    moving: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hits:
    """First hits of N rays.

    distance  (N,) float32 metres, inf where nothing was hit.
    normal    (N, 3) float32 unit, interpolated between vertices; face_normal: of the triangle. Both face the ray. A
              flat cast does not interpolate: they are the same.
    uv        (N, 2) float32 texture coordinates, metres; of a flat cast for moving objects only.
    material, object_type  (N,) uint8 of MATERIAL_IDS and OBJECT_TYPE_IDS; object_type is SKY where nothing was hit.
    tint      (N, 3) float32;  instance (N,) uint16;  moving (N,) bool.
    face      (N,) int64 index of the triangle, -1 where nothing was hit.
    """

    distance: np.ndarray
    normal: np.ndarray
    face_normal: np.ndarray
    uv: np.ndarray
    material: np.ndarray
    object_type: np.ndarray
    tint: np.ndarray
    instance: np.ndarray
    moving: np.ndarray
    face: np.ndarray

    @property
    def valid(self) -> np.ndarray:
        """(N,) bool: something was hit."""
        return self.face >= 0

    @property
    def raw(self) -> np.ndarray:
        """SemanticKITTI's raw class ids (N,) uint16; 0 where nothing was hit."""
        ids = np.where(self.valid, self.object_type, 0)
        return np.where(self.valid, np.where(self.moving, RAW_MOVING_IDS[ids], RAW_IDS[ids]), 0).astype(np.uint16)

    @classmethod
    def joined(cls, parts: Sequence[Hits]) -> Hits:
        """The hits of all parts, in their order."""
        names = [field.name for field in fields(cls)]
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})

    def subset(self, indices: np.ndarray) -> Hits:
        """The hits of some rays, by mask or indices."""
        return Hits(**{part.name: getattr(self, part.name)[indices] for part in fields(self)})


class Scene:
    """Static and moving objects; `with_moving` replaces the moving ones without building the static ones again."""

    def __init__(self, standing: Sequence[SceneObject], moving: Sequence[SceneObject] = ()) -> None:
        self._bvhs = [_Bvh(standing), _Bvh(moving)]

    def with_moving(self, moving: Sequence[SceneObject]) -> Scene:
        """The same static objects with other moving ones."""
        scene = Scene.__new__(Scene)
        scene._bvhs = [self._bvhs[0], _Bvh(moving)]
        return scene

    def cast(self, origin: np.ndarray, direction: np.ndarray, *, flat: bool = False) -> Hits:
        """First hits of rays from origin (N, 3) or (3,) along unit vectors direction (N, 3), metres.

        flat  leave out interpolated normals, and texture coordinates of static objects.
        """
        direction = np.ascontiguousarray(direction, dtype=np.float32)
        origin = np.ascontiguousarray(np.broadcast_to(np.asarray(origin, dtype=np.float32), direction.shape))
        first = [bvh.first(origin, direction) for bvh in self._bvhs]
        standing = first[0].distance <= first[1].distance
        hit_rays = [np.flatnonzero(standing & (first[0].face >= 0)), np.flatnonzero(~standing)]
        hits = _no_hits(len(direction), flat)
        for bvh, nearest, rays in zip(self._bvhs, first, hit_rays, strict=True):
            bvh.describe(hits, nearest, rays, direction)
        if len(hit_rays[1]):
            hits.face[hit_rays[1]] += len(self._bvhs[0])
        return hits

    def unoccluded(self, origin: np.ndarray, direction: np.ndarray, far: float | np.ndarray = 300.0) -> np.ndarray:
        """Shadow rays from origin (N, 3) along direction (N, 3) or (3,): (N,) bool: no hit within `far`."""
        origin = np.ascontiguousarray(origin, dtype=np.float32)
        direction = np.ascontiguousarray(np.broadcast_to(np.asarray(direction, dtype=np.float32), origin.shape))
        far = np.broadcast_to(np.asarray(far, dtype=np.float32), len(origin))
        free = np.ones(len(origin), dtype=bool)
        for bvh in self._bvhs:
            rays = np.flatnonzero(free)
            free[rays] = bvh.first(origin[rays], direction[rays], far[rays], SHADOW_LAYERS).face < 0
        return free


@dataclass(frozen=True, slots=True, eq=False)
class _Nearest:
    distance: np.ndarray  # (N,) float32, inf: none
    face: np.ndarray  # (N,) int64, -1: none
    u: np.ndarray
    v: np.ndarray


class _Bvh:
    """Objects in one bounding volume hierarchy, with the attributes of their triangles."""

    def __init__(self, parts: Sequence[SceneObject]) -> None:
        whole = merged(part.mesh for part in parts)
        parts = [part for part in parts if len(part.mesh)]
        self.mesh = whole
        counts = [len(part.mesh) for part in parts]
        part = np.repeat(np.array([(part.instance << 32) | (part.moving << 16) for part in parts], np.uint64), counts)
        self.moves = any(part.moving for part in parts)
        # All attributes of a triangle in one number: random reads of large tables are slow.
        self.attributes = part | whole.object_type.astype(np.uint64) << 8 | whole.material
        self.face_normal = face_normals(whole.vertices, whole.faces)
        # One row a triangle: the texture coordinates of its three corners.
        self.corner_uv = whole.uv[whole.faces].astype(np.float32)
        self.mask = np.append(masks()[1][whole.material], -1).astype(np.int8)  # the last for face -1
        self._embree = _embree(whole)

    def __len__(self) -> int:
        return len(self.mesh)

    def first(
        self, origin: np.ndarray, direction: np.ndarray, far: np.ndarray | None = None, layers: int = LAYERS
    ) -> _Nearest:
        """Nearest hit of each ray, no farther than `far` (N,); it passes through up to `layers` holes of cut-outs."""
        count = len(direction)
        if not len(self) or not count:
            zero = np.zeros(count, np.float32)
            return _Nearest(np.full(count, np.inf, np.float32), np.full(count, -1), zero, zero)
        result = self._embree.run(origin, direction, dists=None if far is None else far.copy(), output=1)
        face, u, v = result["primID"], result["u"], result["v"]
        distance = np.where(face >= 0, result["tfar"], np.float32(np.inf))
        rays = self._holes(face, u, v)
        gone = distance[rays] + np.float32(STEP)
        for _ in range(layers - 1):
            if not len(rays):
                break
            start, left = origin[rays] + direction[rays] * gone[:, None], None if far is None else far[rays] - gone
            result = self._embree.run(start, direction[rays], dists=left, output=1)
            face[rays], u[rays], v[rays] = result["primID"], result["u"], result["v"]
            away = gone + np.where(result["primID"] >= 0, result["tfar"], np.float32(np.inf))
            distance[rays] = away
            holes = self._holes(result["primID"], result["u"], result["v"])
            rays, gone = rays[holes], away[holes] + np.float32(STEP)
        return _Nearest(distance, face, u, v)

    def _holes(self, face: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Indices of the hits in holes of cut-outs; a face of -1 is none."""
        maybe = np.flatnonzero(self.mask[face] >= 0)
        face = face[maybe]
        return maybe[~solid_at(_interpolated(self.corner_uv[face], u[maybe], v[maybe]), self.mask[face])]

    def describe(self, hits: Hits, nearest: _Nearest, rays: np.ndarray, direction: np.ndarray) -> None:
        """Write the hits of some rays into `hits`."""
        face = nearest.face[rays]
        u, v, face_normal = nearest.u[rays], nearest.v[rays], self.face_normal[face]
        # einsum: numpy's sum over an axis of three is five times slower
        sign = np.where(np.einsum("ij,ij->i", face_normal, direction[rays]) > 0, np.float32(-1), np.float32(1))
        hits.face_normal[rays] = face_normal * sign[:, None]
        if hits.normal is not hits.face_normal:
            normal = _interpolated(self.mesh.normals[self.mesh.faces[face]], u, v)
            length = np.maximum(np.sqrt(np.einsum("ij,ij->i", normal, normal)), np.float32(1e-9))
            hits.normal[rays] = normal * (sign / length)[:, None]
        if hits.normal is not hits.face_normal or self.moves:
            hits.uv[rays] = _interpolated(self.corner_uv[face], u, v)
        hits.distance[rays], hits.face[rays] = nearest.distance[rays], face
        attributes = self.attributes[face]
        hits.material[rays], hits.object_type[rays] = attributes.astype(np.uint8), (attributes >> 8).astype(np.uint8)
        hits.moving[rays] = (attributes >> 16).astype(np.uint8)
        hits.instance[rays] = (attributes >> 32).astype(np.uint16)
        hits.tint[rays] = self.mesh.tint[face]


def _interpolated(corners: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Values (N, C) between corner values (N, 3, C) by barycentric coordinates."""
    return np.einsum("nij,ni->nj", corners, np.stack([1 - u - v, u, v], axis=1))


def _no_hits(count: int, flat: bool) -> Hits:
    face_normal = np.zeros((count, 3), np.float32)
    return Hits(
        distance=np.full(count, np.inf, np.float32),
        normal=face_normal if flat else np.zeros((count, 3), np.float32),
        face_normal=face_normal,
        uv=np.zeros((count, 2), np.float32),
        material=np.zeros(count, np.uint8),
        object_type=np.full(count, SKY, np.uint8),
        tint=np.ones((count, 3), np.float32),
        instance=np.zeros(count, np.uint16),
        moving=np.zeros(count, bool),
        face=np.full(count, -1),
    )


def _embree(whole: Mesh):  # noqa: ANN202 embreex has no types
    with require_extra("world", "the street world"):
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    scene = EmbreeScene()
    if len(whole):
        TriangleMesh(scene, whole.vertices, np.ascontiguousarray(whole.faces, dtype=np.int32))
    return scene
