"""What rays meet in a scene (Embree, by the optional package embreex)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.simulate.scene.cutouts import masks, solid_at
from lidar2pano.simulate.scene.mesh import Mesh, face_normals, merged
from lidar2pano.simulate.scene.surfaces import RAW, RAW_MOVING, SKY

LAYERS = 8  # cards of leaves or wire that one ray may meet: the last one stops it, hole or not
SHADES = 4  # the same for light: behind so many cards there is shade
STEP = 2e-4  # metres that a ray goes on behind a hole before it looks again


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """A thing in its place: `instance` as in SemanticKITTI's labels (0 = none), `moving` chooses the moving classes."""

    mesh: Mesh
    instance: int = 0
    moving: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hits:
    """What N rays met first.

    distance  (N,) float32 metres, inf where nothing was met.
    normal    (N, 3) float32 unit, smooth where the surface is; facet: the flat triangle's. Both face the ray. Of a
              flat cast they are the same.
    uv        (N, 2) float32 metres on the surface; of a flat cast only where it moves.
    material, kind  (N,) uint8 of MATERIAL_IDS and KIND_IDS; kind is SKY where nothing was met.
    tint      (N, 3) float32;  instance (N,) uint16;  moving (N,) bool.
    face      (N,) int64: a number of the triangle, -1 where nothing was met.
    """

    distance: np.ndarray
    normal: np.ndarray
    facet: np.ndarray
    uv: np.ndarray
    material: np.ndarray
    kind: np.ndarray
    tint: np.ndarray
    instance: np.ndarray
    moving: np.ndarray
    face: np.ndarray

    @property
    def met(self) -> np.ndarray:
        """(N,) bool: something was met."""
        return self.face >= 0

    @property
    def raw(self) -> np.ndarray:
        """SemanticKITTI's raw class ids (N,) uint16; 0 where nothing was met."""
        known = np.where(self.met, self.kind, 0)
        return np.where(self.met, np.where(self.moving, RAW_MOVING[known], RAW[known]), 0).astype(np.uint16)

    def taken(self, which: np.ndarray) -> Hits:
        """The hits of some rays: a mask or indices."""
        return Hits(**{part.name: getattr(self, part.name)[which] for part in fields(self)})


class Scene:
    """Standing parts and moving parts; `with_moving` exchanges the latter and keeps the rest as it is built."""

    def __init__(self, standing: Sequence[Part], moving: Sequence[Part] = ()) -> None:
        self._trees = [_Tree(standing), _Tree(moving)]

    def with_moving(self, moving: Sequence[Part]) -> Scene:
        """The same standing parts with other moving ones."""
        scene = Scene.__new__(Scene)
        scene._trees = [self._trees[0], _Tree(moving)]
        return scene

    def cast(self, origin: np.ndarray, way: np.ndarray, *, flat: bool = False) -> Hits:
        """First hits of rays from origin (N, 3) or (3,) along unit vectors way (N, 3), metres.

        flat  smooth normals, and places on the surface of what stands, are not wanted.
        """
        way = np.ascontiguousarray(way, dtype=np.float32)
        origin = np.ascontiguousarray(np.broadcast_to(np.asarray(origin, dtype=np.float32), way.shape))
        first = [tree.first(origin, way) for tree in self._trees]
        standing = first[0].distance <= first[1].distance
        found = [np.flatnonzero(standing & (first[0].face >= 0)), np.flatnonzero(~standing)]
        hits = _nothing(len(way), flat)
        for tree, nearest, rays in zip(self._trees, first, found, strict=True):
            tree.describe(hits, nearest, rays, way)
        if len(found[1]):
            hits.face[found[1]] += len(self._trees[0])
        return hits

    def light(self, origin: np.ndarray, way: np.ndarray, far: float | np.ndarray = 300.0) -> np.ndarray:
        """Whether light reaches origin (N, 3) from the direction way (N, 3) or (3,): (N,) bool; `far` in metres."""
        origin = np.ascontiguousarray(origin, dtype=np.float32)
        way = np.ascontiguousarray(np.broadcast_to(np.asarray(way, dtype=np.float32), origin.shape))
        far = np.broadcast_to(np.asarray(far, dtype=np.float32), len(origin))
        free = np.ones(len(origin), dtype=bool)
        for tree in self._trees:
            rays = np.flatnonzero(free)
            free[rays] = tree.first(origin[rays], way[rays], far[rays], SHADES).face < 0
        return free


@dataclass(frozen=True, slots=True, eq=False)
class _Nearest:
    distance: np.ndarray  # (N,) float32, inf: none
    face: np.ndarray  # (N,) int64, -1: none
    u: np.ndarray
    v: np.ndarray


class _Tree:
    """Parts in one acceleration structure, and the tables that tell what a triangle is."""

    def __init__(self, parts: Sequence[Part]) -> None:
        whole = merged(part.mesh for part in parts)
        parts = [part for part in parts if len(part.mesh)]
        self.mesh = whole
        counts = [len(part.mesh) for part in parts]
        part = np.repeat(np.array([(part.instance << 32) | (part.moving << 16) for part in parts], np.uint64), counts)
        self.moves = any(part.moving for part in parts)
        # All that is told of a triangle in one number: random reads of large tables are what costs.
        self.told = part | whole.kind.astype(np.uint64) << 8 | whole.material
        self.facet = face_normals(whole.vertices, whole.faces)
        # One row a triangle: the texture places of its three corners.
        self.places = whole.uv[whole.faces].astype(np.float32)
        self.mask = np.append(masks()[1][whole.material], -1).astype(np.int8)  # the last for face -1
        self._embree = _embree(whole)

    def __len__(self) -> int:
        return len(self.mesh)

    def first(
        self, origin: np.ndarray, way: np.ndarray, far: np.ndarray | None = None, layers: int = LAYERS
    ) -> _Nearest:
        """Nearest matter along each ray, no farther than `far` (N,); up to `layers` holes are looked through."""
        count = len(way)
        if not len(self) or not count:
            zero = np.zeros(count, np.float32)
            return _Nearest(np.full(count, np.inf, np.float32), np.full(count, -1), zero, zero)
        found = self._embree.run(origin, way, dists=None if far is None else far.copy(), output=1)
        face, u, v = found["primID"], found["u"], found["v"]
        distance = np.where(face >= 0, found["tfar"], np.float32(np.inf))
        rays = self._holes(face, u, v)
        gone = distance[rays] + np.float32(STEP)
        for _ in range(layers - 1):
            if not len(rays):
                break
            start, left = origin[rays] + way[rays] * gone[:, None], None if far is None else far[rays] - gone
            found = self._embree.run(start, way[rays], dists=left, output=1)
            face[rays], u[rays], v[rays] = found["primID"], found["u"], found["v"]
            away = gone + np.where(found["primID"] >= 0, found["tfar"], np.float32(np.inf))
            distance[rays] = away
            holes = self._holes(found["primID"], found["u"], found["v"])
            rays, gone = rays[holes], away[holes] + np.float32(STEP)
        return _Nearest(distance, face, u, v)

    def _holes(self, face: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Which of some hits are holes of cut-outs (indices); a face of -1 is none."""
        maybe = np.flatnonzero(self.mask[face] >= 0)
        return maybe[~self._solid(face[maybe], u[maybe], v[maybe])]

    def _solid(self, face: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return solid_at(_mixed(self.places[face], u, v), self.mask[face])

    def describe(self, hits: Hits, nearest: _Nearest, rays: np.ndarray, way: np.ndarray) -> None:
        """Write into `hits` what some rays met."""
        face = nearest.face[rays]
        u, v, facet = nearest.u[rays], nearest.v[rays], self.facet[face]
        # einsum: numpy's sum over an axis of three is five times slower
        towards = np.where(np.einsum("ij,ij->i", facet, way[rays]) > 0, np.float32(-1), np.float32(1))
        hits.facet[rays] = facet * towards[:, None]
        if hits.normal is not hits.facet:
            normal = _mixed(self.mesh.normals[self.mesh.faces[face]], u, v)
            length = np.maximum(np.sqrt(np.einsum("ij,ij->i", normal, normal)), np.float32(1e-9))
            hits.normal[rays] = normal * (towards / length)[:, None]
        if hits.normal is not hits.facet or self.moves:
            hits.uv[rays] = _mixed(self.places[face], u, v)
        hits.distance[rays], hits.face[rays] = nearest.distance[rays], face
        told = self.told[face]
        hits.material[rays], hits.kind[rays] = told.astype(np.uint8), (told >> 8).astype(np.uint8)
        hits.moving[rays], hits.instance[rays] = (told >> 16).astype(np.uint8), (told >> 32).astype(np.uint16)
        hits.tint[rays] = self.mesh.tint[face]


def _mixed(corners: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Corner values (N, 3, C) at barycentric places."""
    return np.einsum("nij,ni->nj", corners, np.stack([1 - u - v, u, v], axis=1))


def _nothing(count: int, flat: bool) -> Hits:
    facet = np.zeros((count, 3), np.float32)
    return Hits(
        distance=np.full(count, np.inf, np.float32),
        normal=facet if flat else np.zeros((count, 3), np.float32),
        facet=facet,
        uv=np.zeros((count, 2), np.float32),
        material=np.zeros(count, np.uint8),
        kind=np.full(count, SKY, np.uint8),
        tint=np.ones((count, 3), np.float32),
        instance=np.zeros(count, np.uint16),
        moving=np.zeros(count, bool),
        face=np.full(count, -1),
    )


def _embree(whole: Mesh):  # noqa: ANN202 embreex has no types
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        raise InputError("the street world needs embreex: pip install 'lidar2pano[world]'") from error
    scene = EmbreeScene()
    if len(whole):
        TriangleMesh(scene, whole.vertices, np.ascontiguousarray(whole.faces, dtype=np.int32))
    return scene
