"""Cameras of the street world: pictures, classes and distances along any raster of rays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np

from lidar2pano.calibration import Calibration
from lidar2pano.simulate.draws import stream
from lidar2pano.simulate.looks import Look
from lidar2pano.simulate.materials import MATERIALS
from lidar2pano.simulate.occlusion import guide, openness, smoothed
from lidar2pano.simulate.raycast import Hits, Scene
from lidar2pano.simulate.shading import Reach, shade, sunlit
from lidar2pano.views import View

TILE = 65536  # rays that are cast at once
CORNERS = ((0.0, 0.37), (-0.33, -0.18), (0.33, -0.18))  # further rays of pixels at edges, in pixels from the middle
JUMP = 0.1  # share of the distance by which neighbours lie apart where there is an edge
LENS = (0.11, 0.78, 0.11)  # blur along rows and columns: sigma 0.5 pixels
FULL = 4.0  # light above that many times white is cut before it spreads into its neighbours
GRAIN = 1.8  # standard deviation of the sensor's noise in steps of 8 bits
CONTRAST = 1.3  # exponent of the film's curve: shades are deeper than life, as in KITTI's pictures
STRIP = 32  # rows that are developed at once
SHOULDER = 0.7  # brightness above which the film begins to save the lights

CLOSE = 12.0  # metres within which penumbrae are some pixels wide
CLUMP = 1.2  # metres between leaves that may share a ray to the sun

_LEAFY = np.array([bool(material.cutout) and material.through > 0 for material in MATERIALS.values()])

Rays = tuple[np.ndarray, np.ndarray, float]
"""origin (3,) float64 metres, directions (H, W, 3) float32 unit vectors, both in the world's frame; pixel's radians."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Picture:
    """colour (H, W, 3) uint8 sRGB; kind (H, W) uint8 of KIND_IDS or SKY; distance (H, W) float32 metres, inf: sky."""

    colour: np.ndarray
    kind: np.ndarray
    distance: np.ndarray


def pinhole(calibration: Calibration, T_world_lidar: np.ndarray) -> Rays:
    """The rays through a camera's pixel centres (integers), for a LiDAR that stands at T_world_lidar (4, 4)."""
    width, height = calibration.size
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    back = np.linalg.inv(calibration.T_camera_lidar[:3, :3]) @ np.linalg.inv(calibration.K)
    turn = T_world_lidar[:3, :3] @ back
    ray = np.stack([u, v, np.ones_like(u)], axis=-1) @ turn.T
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    return _origin(T_world_lidar, calibration.centre), ray.astype(np.float32), 1 / float(calibration.K[0, 0])


def cylinder(view: View, T_world_lidar: np.ndarray) -> Rays:
    """The rays through the pixel centres of a view, for a LiDAR that stands at T_world_lidar (4, 4)."""
    ray = _directions(view) @ T_world_lidar[:3, :3].T
    return _origin(T_world_lidar, view.origin), ray.astype(np.float32), 1 / view.focal_px


@lru_cache(maxsize=2)
def _directions(view: View) -> np.ndarray:
    """The same for every frame: (H, W, 3) float64 in the sensor's frame."""
    from lidar2pano.geometry.projection import directions

    return directions(view).numpy().astype(np.float64)


def _origin(T_world_lidar: np.ndarray, point: tuple[float, float, float]) -> np.ndarray:
    return T_world_lidar[:3, :3] @ np.asarray(point, dtype=np.float64) + T_world_lidar[:3, 3]


def render(
    scene: Scene, origin: np.ndarray, directions: np.ndarray, pixel_angle: float, look: Look, seed: int = 0
) -> Picture:
    """The picture that a camera takes along its rays (see Rays); `seed` chooses the sensor's noise.

    A picture whose last column is one pixel away from its first is closed: it has no seam.
    """
    shape = directions.shape[:2]
    wraps, origin = _closed(directions, pixel_angle), np.asarray(origin, dtype=np.float32)
    way = directions.reshape(-1, 3)
    hits = _hits(scene, origin, way)
    surfaces = guide(hits, origin, directions)
    from_sky = openness(scene, hits, surfaces, wraps).reshape(-1)
    from_sun = _sun(scene, hits, origin, way, look, shape)
    from_sun = smoothed(from_sun, surfaces, wraps, (1,))  # one ray a pixel is a grainy penumbra, most so near by
    from_sun = np.where(surfaces.distance < CLOSE, smoothed(from_sun, surfaces, wraps, (2,)), from_sun).reshape(-1)
    limit = FULL / look.exposure
    radiance = np.minimum(shade(scene, hits, origin, way, pixel_angle, look, Reach(from_sun, from_sky)), limit)
    count = np.ones(len(way), dtype=np.float32)
    for place, ray in _further(hits, directions, wraps):
        met = scene.cast(origin, ray)
        sun = sunlit(scene, met, np.broadcast_to(origin, ray.shape), ray, look)
        more = shade(scene, met, origin, ray, 0.6 * pixel_angle, look, Reach(sun, from_sky[place]))
        radiance[place] += np.minimum(more, limit)
        count[place] += 1
    radiance /= count[:, None]
    return Picture(
        colour=developed(radiance.reshape(*shape, 3), look, wraps, seed),
        kind=hits.kind.reshape(shape),
        distance=hits.distance.reshape(shape),
    )


def _closed(directions: np.ndarray, pixel_angle: float) -> bool:
    gap = np.linalg.norm(directions[:, 0] - directions[:, -1], axis=1).max()
    return bool(directions.shape[1] > 8 and gap < 1.5 * pixel_angle)


def _hits(scene: Scene, origin: np.ndarray, way: np.ndarray) -> Hits:
    whole: dict[str, np.ndarray] = {}
    for first in range(0, len(way), TILE):
        part = scene.cast(origin, way[first : first + TILE])
        for field in fields(Hits):
            values = getattr(part, field.name)
            if field.name not in whole:
                whole[field.name] = np.empty((len(way), *values.shape[1:]), dtype=values.dtype)
            whole[field.name][first : first + TILE] = values
    return Hits(**whole)


def _sun(
    scene: Scene, hits: Hits, origin: np.ndarray, way: np.ndarray, look: Look, shape: tuple[int, int]
) -> np.ndarray:
    """Which of a picture's pixels the sun lights (H, W); four neighbours among leaves share one ray, for speed."""
    index = np.arange(len(way), dtype=np.int32).reshape(shape)
    first = np.repeat(np.repeat(index[::2, ::2], 2, axis=0), 2, axis=1)[: shape[0], : shape[1]].reshape(-1)
    shares = _LEAFY[hits.material] & hits.met & (hits.material == hits.material[first])
    distance = np.where(hits.met, hits.distance, 0)
    shares &= np.abs(distance - distance[first]) < CLUMP
    asked = np.flatnonzero(~shares | (first == index.reshape(-1)))
    lit = np.empty(len(way), dtype=np.float32)
    lit[asked] = sunlit(scene, hits.taken(asked), np.broadcast_to(origin, (len(asked), 3)), way[asked], look)
    return np.where(shares, lit[first], lit).reshape(shape)


def _further(hits: Hits, directions: np.ndarray, wraps: bool) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pixels (indices) at edges and further rays for each: three, but one at the rim of leaves."""
    edge, ragged = (part.reshape(-1) for part in _edges(hits, directions.shape[:2], wraps))
    once, more = np.flatnonzero(edge | ragged), np.flatnonzero(edge)
    for index, (right, down) in enumerate(CORNERS):
        pixels = more if index else once
        for first in range(0, len(pixels), TILE):
            some = pixels[first : first + TILE]
            yield some, _beside(directions, some, (right, down), wraps)


def _beside(directions: np.ndarray, pixels: np.ndarray, off: tuple[float, float], wraps: bool) -> np.ndarray:
    """Unit vectors (K, 3) through points `off` (right, down) pixels beside the middle of some pixels."""
    rows, columns = directions.shape[:2]
    row, column = np.divmod(pixels, columns)
    left, right = column - 1, column + 1
    if wraps:
        left, right = left % columns, right % columns
    else:
        left, right = np.maximum(left, 0), np.minimum(right, columns - 1)
    above, below = np.maximum(row - 1, 0), np.minimum(row + 1, rows - 1)
    across = (directions[row, right] - directions[row, left]) * np.float32(off[0] / 2)
    along = (directions[below, column] - directions[above, column]) * np.float32(off[1] / 2)
    ray = directions[row, column] + across + along
    return ray / np.linalg.norm(ray, axis=1, keepdims=True)


def _edges(hits: Hits, shape: tuple[int, int], wraps: bool) -> tuple[np.ndarray, np.ndarray]:
    """Two (H, W) bool: pixels whose neighbour is another kind or material, lies much farther, or is turned away; and
    pixels at the rim of leaves, within which everything would be an edge.
    """
    kind = np.where(hits.met, hits.kind, -1).reshape(shape)
    material, leaves = hits.material.reshape(shape), (_LEAFY[hits.material] & hits.met).reshape(shape)
    sky, near = ~hits.met.reshape(shape), (1 / np.maximum(hits.distance, 1e-3)).reshape(shape)
    normal = np.ascontiguousarray(hits.normal.T).reshape(3, *shape)
    edge, ragged = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    for axis in (0, 1):
        ahead = np.roll(near, -1, axis)
        step = np.abs(ahead - near) > JUMP * np.maximum(ahead, near)
        step |= (np.roll(normal, -1, axis + 1) * normal).sum(axis=0) < 0.8
        step |= np.roll(material, -1, axis) != material
        step &= ~(sky & np.roll(sky, -1, axis))
        other, leafy = np.roll(kind, -1, axis) != kind, leaves | np.roll(leaves, -1, axis)
        if axis == 0:
            step[-1] = other[-1] = False
        elif not wraps:
            step[:, -1] = other[:, -1] = False
        step, other = (step | other) & ~leafy, other & leafy
        edge |= step | np.roll(step, 1, axis)
        ragged |= other | np.roll(other, 1, axis)
    return edge, ragged


def developed(radiance: np.ndarray, look: Look, wraps: bool, seed: int) -> np.ndarray:
    """Radiance (H, W, 3) as the camera writes it: (H, W, 3) uint8, sRGB."""
    film = radiance * (np.float32(look.exposure) * np.asarray(look.balance, dtype=np.float32))
    film = np.pad(film, ((0, 0), (1, 1), (0, 0)), mode="wrap" if wraps else "edge")
    film = np.pad(film, ((1, 1), (0, 0), (0, 0)), mode="edge")
    grain, out = stream(seed, "sensor"), np.empty(radiance.shape, dtype=np.uint8)
    for first in range(0, len(out), STRIP):
        strip = _coded(_blurred(film[first : first + STRIP + 2]), look)
        strip += grain.standard_normal(strip.shape, dtype=np.float32) * np.float32(GRAIN) + np.float32(0.5)
        out[first : first + STRIP] = np.clip(strip, 0, 255, out=strip)
    return out


def _blurred(film: np.ndarray) -> np.ndarray:
    """Through the lens; the result lacks the border of one pixel that `film` has."""
    side, middle, _ = (np.float32(weight) for weight in LENS)
    film = middle * film[1:-1] + side * (film[:-2] + film[2:])
    return middle * film[:, 1:-1] + side * (film[:, :-2] + film[:, 2:])


def _coded(film: np.ndarray, look: Look) -> np.ndarray:
    """sRGB 0..255, not yet rounded, of light where 1 is white."""
    grey = film @ np.array((0.2126, 0.7152, 0.0722), dtype=np.float32)[:, None]
    film = np.maximum(grey + (film - grey) * np.float32(look.saturation), 0)
    film *= (film * np.float32(1 / 0.18)) ** np.float32(CONTRAST - 1)  # about middle grey
    over = np.maximum(film - SHOULDER, 0)
    film = np.minimum(film, SHOULDER) + (1 - SHOULDER) * (1 - np.exp(over * np.float32(-0.8 / (1 - SHOULDER))))
    coded = np.float32(1.055) * np.maximum(film, 1e-6) ** np.float32(1 / 2.4) - np.float32(0.055)
    return 255 * np.where(film < 0.0031308, 12.92 * film, coded)
