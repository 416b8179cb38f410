"""Shading: the sky's and the sun's light on surfaces, and their radiance towards a camera."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from lidar2pano.simulate.render.looks import FALLEN, LITTERED, Look, Sky, seasonal_albedo, sky
from lidar2pano.simulate.render.textures import OF_MATERIAL, TEXTURE_IDS, sample, sample_wide, spatial_hash
from lidar2pano.simulate.scene.raycast import Hits, Scene
from lidar2pano.simulate.scene.surfaces import OBJECT_TYPE_IDS, material_table

OCCLUSION_CELL = 0.02  # metres: points within one cell share one ray
NEAR, FAR = 0.25, 15.0  # metres: the rays' lengths, log-uniform
LEAFY = np.float32(0.6)  # of leaves: their tints contain the shade inside the crown
_THIN = material_table("transmission") > 0
STRIDES = (1, 2, 4)  # pixels, of the a-trous filter
TILE = 32768  # rays shaded at once: their arrays fit the cache
CELL = 0.008  # metres: points within one cell share one sample of the sun's disc
TAPS = 3  # texture samples across a surface at grazing angles
BOUNCE = 0.08  # share of the sky's light reflected by an occluder
LAMP_RADIANCE = 2.5  # radiance of emission 1
_ALBEDO, _EMISSION = material_table("albedo").T.copy(), LAMP_RADIANCE * material_table("emission").T
_ROUGHNESS, _TRANSMISSION = material_table("roughness"), material_table("transmission")
# Leaves have their crown's normals, unfit for specular reflection.
_SPECULAR = np.where(_TRANSMISSION > 0, 0, material_table("specular"))
_ASPHALT, _ROAD = TEXTURE_IDS["asphalt"], OBJECT_TYPE_IDS["road"]
_MIRRORS = (_SPECULAR > 0) & (_ROUGHNESS < 0.15)  # reflections are traced


class GBuffer(NamedTuple):
    """Visible surfaces: position and normal (3, h, w) float32, distance (h, w) metres (0 where there is sky)."""

    position: np.ndarray
    normal: np.ndarray
    distance: np.ndarray

    def part(self, rows: slice, columns: slice) -> GBuffer:
        """The buffer of some pixels."""
        return GBuffer(self.position[:, rows, columns], self.normal[:, rows, columns], self.distance[rows, columns])


def sky_visibility(scene: Scene, hits: Hits, gbuffer: GBuffer, circular: bool) -> np.ndarray:
    """Share (H, W) float32 of the sky's light that reaches the hits of an image's rays.

    One cosine-distributed ray for every second pixel of every second row, then an edge-aware filter.
    circular: the last column adjoins the first.
    """
    shape = gbuffer.distance.shape
    half = slice(None, None, 2)
    coarse = gbuffer.part(half, half)
    coarse_hits = np.arange(len(hits.face)).reshape(shape)[half, half].reshape(-1)
    free = np.where(_THIN[hits.material[coarse_hits]] & hits.valid[coarse_hits], LEAFY, np.float32(1))
    met = np.flatnonzero(hits.valid[coarse_hits] & (free == 1))
    position, normal = (part.reshape(3, -1)[:, met] for part in coarse[:2])
    face_normal = np.ascontiguousarray(hits.face_normal[coarse_hits[met]].T, dtype=np.float32)
    height = 2 * spatial_hash(position, OCCLUSION_CELL, 11) - 1
    turn = np.float32(2 * np.pi) * spatial_hash(position, OCCLUSION_CELL, 12)
    flat = np.sqrt(1 - height * height)
    # The cosine distribution: the normal + a point on the unit sphere.
    direction = normal + np.stack([flat * np.cos(turn), flat * np.sin(turn), height])
    direction -= 2 * np.minimum(_dot(direction, face_normal), 0) * face_normal
    direction /= np.sqrt(_dot(direction, direction)) + 1e-6
    start = position + ray_offset(hits, coarse_hits[met])
    far = NEAR * (FAR / NEAR) ** spatial_hash(position, OCCLUSION_CELL, 13)
    free[met] = scene.unoccluded(start.T, direction.T, far)  # 1 where a ray hits nothing, else 0
    rough = free.reshape(coarse.distance.shape)
    return _upsampled(edge_aware_mean(rough, coarse, circular, STRIDES), gbuffer, circular)


def gbuffer(hits: Hits, origin: np.ndarray, directions: np.ndarray) -> GBuffer:
    """The G-buffer of rays (H, W, 3) from `origin` (3,)."""
    rows, columns = directions.shape[:2]
    distance = np.where(hits.valid, hits.distance, 0).reshape(rows, columns)
    position = np.ascontiguousarray(directions.transpose(2, 0, 1)) * distance
    position += np.asarray(origin, dtype=np.float32)[:, None, None]
    normal = np.ascontiguousarray(hits.normal.T).reshape(3, rows, columns)
    return GBuffer(position, normal, distance)


def edge_aware_mean(value: np.ndarray, gbuffer: GBuffer, circular: bool, strides: tuple[int, ...]) -> np.ndarray:
    """Edge-avoiding a-trous filter of (H, W) along rows and columns in turn (Dammertz 2010)."""
    for stride in strides:
        for axis in (1, 2):
            total, weight = value.copy(), np.ones_like(value)
            for step in (-stride, stride):
                neighbour = GBuffer(*(_shifted(part, step, axis - 3, circular) for part in gbuffer))
                likeness = _similarity(gbuffer, neighbour)
                total += likeness * _shifted(value, step, axis - 3, circular)
                weight += likeness
            value = total / weight
    return value


def _shifted(field: np.ndarray, step: int, axis: int, circular: bool) -> np.ndarray:
    """The field shifted by `step` pixels; at borders that are not circular, the field itself."""
    moved = np.roll(field, -step, axis)
    if axis == -2 or not circular:
        edge = [slice(None)] * field.ndim
        edge[axis] = slice(-step, None) if step > 0 else slice(None, -step)
        moved[tuple(edge)] = field[tuple(edge)]
    return moved


def _similarity(first: GBuffer, second: GBuffer) -> np.ndarray:
    """Weights in [0, 1]: close to 1 where two pixels lie on one smooth surface."""
    off = second.position - first.position
    level = np.clip(1 - np.abs(_dot(off, first.normal)) / (0.03 + 0.01 * first.distance), 0, 1)
    return level * np.clip(2 * _dot(first.normal, second.normal) - 1, 0, 1)


def _upsampled(coarse: np.ndarray, gbuffer: GBuffer, circular: bool) -> np.ndarray:
    """Joint bilateral upsampling from every second row and column to all pixels."""
    every, even, odd = slice(None), slice(None, None, 2), slice(1, None, 2)
    rows, columns = gbuffer.distance.shape
    tall = np.empty((rows, coarse.shape[1]), dtype=np.float32)
    tall[0::2] = coarse
    tall[1::2] = _interpolated(coarse, gbuffer.part(even, even), gbuffer.part(odd, even), 0, False)
    out = np.empty((rows, columns), dtype=np.float32)
    out[:, 0::2] = tall
    out[:, 1::2] = _interpolated(tall, gbuffer.part(every, even), gbuffer.part(every, odd), 1, circular)
    return out


def _interpolated(value: np.ndarray, coarse: GBuffer, fine: GBuffer, axis: int, circular: bool) -> np.ndarray:
    """Values of the pixels between two neighbours along an axis."""
    rows, columns = (slice(0, length) for length in fine.distance.shape)
    neighbour = GBuffer(*(_shifted(part, 1, axis - 2, circular) for part in coarse)).part(rows, columns)
    nearer, farther = (_similarity(fine, side) + np.float32(1e-3) for side in (coarse.part(rows, columns), neighbour))
    next_value = _shifted(value, 1, axis - 2, circular)[rows, columns]
    return (value[rows, columns] * nearer + next_value * farther) / (nearer + farther)


class Visibility(NamedTuple):
    """Shares (N,) float32 of the light of the sun and of the sky that reach N points unoccluded."""

    sun: np.ndarray
    sky: np.ndarray

    def subset(self, indices: np.ndarray) -> Visibility:
        """The shares of some points."""
        return Visibility(self.sun[indices], self.sky[indices])


@dataclass(slots=True, eq=False)
class _ShadingPoints:
    """Hits of n rays in the world frame, coordinates first (3, n) for speed."""

    hits: Hits
    position: np.ndarray
    direction: np.ndarray
    normal: np.ndarray
    face_normal: np.ndarray
    footprint_m: np.ndarray  # (n,) width of a pixel there, square to the ray
    facing: np.ndarray  # (n,) cosine between ray and face normal

    def subset(self, indices: np.ndarray) -> _ShadingPoints:
        """Some of the points."""
        arrays = (getattr(self, part.name)[..., indices] for part in fields(self)[1:])
        return _ShadingPoints(self.hits.subset(indices), *arrays)


def shade(
    scene: Scene,
    hits: Hits,
    origin: np.ndarray,
    direction: np.ndarray,
    pixel_angle: float,
    look: Look,
    visibility: Visibility,
) -> np.ndarray:
    """Radiance (N, 3) float32, linear RGB, along rays.

    hits         first hits of the rays from origin (N, 3) or (3,) along unit vectors direction (N, 3).
    pixel_angle  radians between neighbouring rays: textures are averaged over it.
    visibility   of sun and sky at the hits.
    """
    origin = np.broadcast_to(np.asarray(origin, dtype=np.float32), direction.shape)
    out = np.empty(direction.shape, dtype=np.float32)
    for first in range(0, len(direction), TILE):
        part = slice(first, first + TILE)
        some, away = (np.flatnonzero(valid) + first for valid in (hits.valid[part], ~hits.valid[part]))
        rays = np.ascontiguousarray(direction[part].T, dtype=np.float32)
        out[away] = sky(look).radiance(rays[:, away - first]).T
        points = _shading_points(hits.subset(some), origin[some].T, rays[:, some - first], pixel_angle)
        out[some] = _surface(scene, points, look, visibility.subset(some)).T
    return out


def _shading_points(hits: Hits, origin: np.ndarray, direction: np.ndarray, pixel_angle: float) -> _ShadingPoints:
    normal, face_normal = (np.ascontiguousarray(part.T, dtype=np.float32) for part in (hits.normal, hits.face_normal))
    facing = np.clip(-_dot(direction, face_normal), 0.02, 1)
    position, footprint_m = origin + direction * hits.distance, hits.distance * np.float32(pixel_angle)
    return _ShadingPoints(hits, position, direction, normal, face_normal, footprint_m, facing)


def _surface(scene: Scene, points: _ShadingPoints, look: Look, visibility: Visibility) -> np.ndarray:
    """Radiance (3, n) of surfaces."""
    dome, material = sky(look), points.hits.material
    albedo, normal = _material(points, look)
    sun = np.array(look.sun_direction, dtype=np.float32)[:, None]
    cosine = _dot(normal, sun)
    strength = np.maximum(cosine, 0) + _TRANSMISSION[material] * np.maximum(-cosine, 0.25)
    direct = np.array(look.sun_colour, dtype=np.float32)[:, None] * (strength * visibility.sun)
    ambient = dome.ambient(normal)
    ambient *= visibility.sky + BOUNCE * (1 - visibility.sky)
    out = albedo * (direct + ambient)
    glossy = np.flatnonzero(_SPECULAR[material])
    if len(glossy):
        some = points.subset(glossy)
        out[:, glossy] = _glossy(scene, some, look, normal[:, glossy], out[:, glossy], visibility.subset(glossy))
    out += _EMISSION[:, material]
    clear = np.exp(points.hits.distance * np.float32(-1 / look.haze_m))
    return out * clear + dome.airlight * (1 - clear)


def _material(points: _ShadingPoints, look: Look) -> tuple[np.ndarray, np.ndarray]:
    """Albedo (3, n), and normal (3, n) with the texture's bump map."""
    hits = points.hits
    texture = OF_MATERIAL[hits.material]
    tint = np.ascontiguousarray(hits.tint.T)
    along, up = _tangents(points.face_normal)
    factor, slope = _sampled(points, texture, along, up)
    albedo = _ALBEDO[:, hits.material] * tint * factor
    albedo = seasonal_albedo(look, albedo, hits.material, tint, points.position)
    flat = (np.abs(points.face_normal[2]) > 0.7) | hits.moving
    x, y, z = points.position  # each wall has its own uv: world coordinates make neighbours differ
    wide = np.where(flat, hits.uv.T, np.stack([x + 0.43 * z, y + 0.71 * z]))
    albedo *= sample_wide(texture, wide.T, points.footprint_m / np.sqrt(points.facing)).T
    _tracks(albedo, hits, texture)
    _litter(albedo, points, look)
    normal = points.normal - along * slope[0] - up * slope[1]
    return np.clip(albedo, 0, 0.95), normal / np.sqrt(_dot(normal, normal))


def _tangents(face_normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (3, n) along u and v of `mesh.projected_uv`: x and y on floors, along and up on walls."""
    x, y, z = face_normal
    flat = np.abs(z) > 0.97
    run = np.sqrt(np.maximum(x * x + y * y, 1e-12))
    sign = np.where(np.where(np.abs(y) > np.abs(x), -y, x) < 0, np.float32(-1), np.float32(1)) / run
    along = np.stack([np.where(flat, 1, -y * sign), np.where(flat, 0, x * sign), np.zeros_like(x)])
    up = np.stack([np.zeros_like(x), np.where(flat, 1, 0), np.zeros_like(x)])
    slope = z / run
    up[:, ~flat] = np.stack([-x * slope, -y * slope, run])[:, ~flat]
    return along, up


def _sampled(
    points: _ShadingPoints, texture: np.ndarray, along: np.ndarray, up: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Texture factor (3, n) and slope (2, n); at grazing angles the mean of TAPS samples (anisotropic filtering)."""
    stretch = 1 / points.facing
    narrow = np.maximum(1, stretch / TAPS)
    # Half a mip level of dither hides the transitions between levels on the ground.
    dither = 0.75 + 0.5 * spatial_hash(points.position, 0.03, 1)
    footprint = points.footprint_m * narrow * dither
    factor, slope = (part.T for part in sample(texture, points.hits.uv, footprint))
    aslant = np.flatnonzero(stretch > 1.6)
    if len(aslant):
        direction, uv = points.direction[:, aslant], points.hits.uv[aslant]
        across = np.stack([_dot(direction, along[:, aslant]), _dot(direction, up[:, aslant])])
        across /= np.sqrt(_dot(across, across)) + 1e-9
        step = (across * (points.footprint_m * stretch)[aslant] / TAPS).T
        for sign in (-1, 1):
            more = sample(texture[aslant], uv + sign * step, footprint[aslant])
            factor[:, aslant] += more[0].T
            slope[:, aslant] += more[1].T
        factor[:, aslant] *= np.float32(1 / TAPS)
        slope[:, aslant] *= np.float32(1 / TAPS)
    return factor, slope


def _tracks(albedo: np.ndarray, hits: Hits, texture: np.ndarray) -> None:
    """Darken the asphalt in wheel tracks and along the joint in the middle; v is the offset from the road's middle."""
    road = np.flatnonzero((texture == _ASPHALT) & (hits.object_type == _ROAD))
    aside = np.abs(hits.uv[road, 1])
    worn = np.cos(np.clip((np.abs(aside - 1.75) - 0.75) * 2.6, -np.pi, np.pi))
    albedo[:, road] *= 1 - 0.05 * worn - 0.22 * np.clip(1 - aside / 0.025, 0, 1)


def _litter(albedo: np.ndarray, points: _ShadingPoints, look: Look) -> None:
    share = LITTERED[points.hits.material] * np.float32(look.leaf_litter)
    ground = np.flatnonzero((share > 0) & (points.face_normal[2] > 0.7))
    if len(ground):
        ids = np.full(len(ground), TEXTURE_IDS["litter"])
        footprint = points.footprint_m[ground] / np.sqrt(points.facing[ground])
        cover = sample(ids, points.hits.uv[ground], footprint)[0][:, 0] * share[ground]
        hue = 0.6 + 0.8 * spatial_hash(points.position[:, ground], 0.06, 2)
        albedo[:, ground] += cover * (FALLEN[:, None] * hue - albedo[:, ground])


def sunlit(scene: Scene, hits: Hits, origin: np.ndarray, direction: np.ndarray, look: Look) -> np.ndarray:
    """Visibility of the sun at the hits of rays: (N,) float32, 0 or 1; stochastic in penumbrae.

    The sampled point of the sun's disc is a spatial hash of the position: it is the same in every image.
    """
    lit = np.zeros(len(direction), dtype=np.float32)
    if not any(look.sun_colour):
        return lit
    sun = np.array(look.sun_direction, dtype=np.float32)
    thin = _TRANSMISSION[hits.material] > 0
    toward = np.flatnonzero(hits.valid & (thin | ((hits.normal @ sun > 0) & (hits.face_normal @ sun > 0))))
    east = np.array((look.sun_direction[1], -look.sun_direction[0], 0), dtype=np.float32)
    east /= np.sqrt((east * east).sum()) + np.float32(1e-9)
    axes = (sun, east, np.cross(sun, east))
    wide = np.float32(np.tan(np.radians(look.sun_radius_deg)))
    for first in range(0, len(toward), TILE):
        some = toward[first : first + TILE]
        position = (origin[some] + direction[some] * hits.distance[some, None]).T
        turn = np.float32(2 * np.pi) * spatial_hash(position, CELL, 3)
        away = np.sqrt(spatial_hash(position, CELL, 4)) * wide
        ray = sum(
            axis[:, None] * part for axis, part in zip(axes, (1, away * np.cos(turn), away * np.sin(turn)), strict=True)
        )
        ray = ray / np.sqrt(_dot(ray, ray))
        behind = np.where(hits.face_normal[some] @ sun < 0, np.float32(-1), np.float32(1))  # leaves lit from behind
        lit[some] = scene.unoccluded((position + ray_offset(hits, some) * behind).T, ray.T)
    return lit


def ray_offset(hits: Hits, indices: np.ndarray) -> np.ndarray:
    """The offset (3, k) off a surface at which a new ray starts, against self-intersection."""
    return (hits.face_normal[indices] * (1e-3 + 3e-5 * hits.distance[indices, None])).T


def _glossy(  # noqa: PLR0913 the arrays of the formula
    scene: Scene, points: _ShadingPoints, look: Look, normal: np.ndarray, matt: np.ndarray, visibility: Visibility
) -> np.ndarray:
    """Radiance (3, n) of glossy surfaces: diffuse radiance `matt` and specular reflection."""
    material = points.hits.material
    gloss, rough = _SPECULAR[material], _ROUGHNESS[material]
    facing = np.clip(-_dot(normal, points.direction), 0, 1)
    share = gloss + np.maximum(1 - rough - gloss, 0) * (1 - facing) ** 5  # Schlick (1994), reduced by roughness
    mirrored = points.direction + 2 * facing * normal
    dome = sky(look)
    reflected = dome.ambient(mirrored) * visibility.sky
    clear = np.flatnonzero(_MIRRORS[material])
    if len(clear):
        start = points.position[:, clear] + ray_offset(points.hits, clear)
        reflected[:, clear] = _mirrored(scene, start, mirrored[:, clear], look, dome)
    sun = np.array(look.sun_direction, dtype=np.float32)[:, None]
    half = sun - points.direction
    half /= np.sqrt(_dot(half, half)) + 1e-6
    peak, alpha = np.clip(_dot(normal, half), 0, 1), np.maximum(rough * rough, 0.03)
    lobe = alpha**2 / (np.pi * (peak * peak * (alpha**2 - 1) + 1) ** 2)  # GGX (Walter 2007)
    glance = gloss + (1 - gloss) * (1 - np.clip(_dot(half, sun), 0, 1)) ** 5
    shine = np.pi * visibility.sun * np.maximum(_dot(normal, sun), 0) * lobe * glance * (0.25 + 0.25 * rough)
    return matt * (1 - share) + reflected * share + np.array(look.sun_colour, dtype=np.float32)[:, None] * shine


def _mirrored(scene: Scene, start: np.ndarray, direction: np.ndarray, look: Look, dome: Sky) -> np.ndarray:
    """Radiance (3, n) in a mirror: the sky, or objects in simplified light."""
    out = dome.radiance(direction, disc=False)
    hits = scene.cast(start.T, direction.T)
    hit_index = np.flatnonzero(hits.valid)
    hits, normal = hits.subset(hit_index), np.ascontiguousarray(hits.normal[hit_index].T)
    cosine = np.maximum(_dot(normal, np.array(look.sun_direction, dtype=np.float32)[:, None]), 0)
    light = 0.8 * dome.ambient(normal) + np.array(look.sun_colour, dtype=np.float32)[:, None] * (0.6 * cosine)
    out[:, hit_index] = _ALBEDO[:, hits.material] * hits.tint.T * light + _EMISSION[:, hits.material]
    return out


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Dot products (n,) of columns."""
    return (a * b).sum(axis=0)
