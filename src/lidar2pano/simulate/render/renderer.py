"""The renderer: camera images, object types and distances along any raster of rays."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from lidar2pano.calibration import Calibration
from lidar2pano.simulate.render.looks import Look
from lidar2pano.simulate.render.shading import Visibility, edge_aware_mean, gbuffer, shade, sky_visibility, sunlit
from lidar2pano.simulate.scene.random_streams import stream
from lidar2pano.simulate.scene.raycast import Hits, Scene
from lidar2pano.simulate.scene.surfaces import MATERIALS
from lidar2pano.views import View

TILE = 65536  # rays cast at once
SUBPIXELS = ((0.0, 0.37), (-0.33, -0.18), (0.33, -0.18))  # offsets of the further rays of pixels at edges, pixels
JUMP = 0.1  # relative difference in distance between neighbours at an edge
NOTHING = np.uint8(255)  # the number of no type of object
BLUR = (0.11, 0.78, 0.11)  # kernel along rows and columns: sigma 0.5 pixels
SATURATION = 4.0  # times white: radiance is clipped there before the blur
SENSOR_NOISE = 1.8  # standard deviation in steps of 8 bits
CONTRAST = 1.3  # exponent of the tone curve, as in KITTI's images
SHOULDER = 0.7  # brightness above which highlights are compressed

CLOSE = 12.0  # metres within which penumbrae are several pixels wide
LEAF_CELL = 1.2  # metres within which leaves may share a shadow ray

_LEAFY = np.array([bool(material.cutout) and material.transmission > 0 for material in MATERIALS.values()])

Rays = tuple[np.ndarray, np.ndarray, float, bool]
"""origin (3,) float64 metres, directions (H, W, 3) float32 unit vectors, world frame; radians a pixel; circular: the
last column adjoins the first, and the image has no seam."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RenderedImage:
    """An image and its ground truth.

    image        (H, W, 3) uint8 sRGB.
    object_type  (H, W) uint8 of OBJECT_TYPE_IDS, or SKY;  distance (H, W) float32 metres, inf: sky.
    """

    image: np.ndarray
    object_type: np.ndarray
    distance: np.ndarray


def pinhole(calibration: Calibration, T_world_lidar: np.ndarray) -> Rays:
    """The rays through a camera's pixel centres (integers), for a LiDAR at T_world_lidar (4, 4)."""
    width, height = calibration.size
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    back = np.linalg.inv(calibration.T_camera_lidar[:3, :3]) @ np.linalg.inv(calibration.K)
    turn = T_world_lidar[:3, :3] @ back
    ray = np.stack([u, v, np.ones_like(u)], axis=-1) @ turn.T
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    return _origin(T_world_lidar, calibration.centre), ray.astype(np.float32), 1 / float(calibration.K[0, 0]), False


def cylinder(view: View, T_world_lidar: np.ndarray) -> Rays:
    """The rays through the pixel centres of a view, for a LiDAR at T_world_lidar (4, 4)."""
    ray = _directions(view) @ T_world_lidar[:3, :3].T
    return _origin(T_world_lidar, view.origin), ray.astype(np.float32), 1 / view.focal_px, view.circular


@lru_cache(maxsize=2)
def _directions(view: View) -> np.ndarray:
    """Unit vectors (H, W, 3) float64 in the sensor frame, the same for every frame of data."""
    from lidar2pano.geometry.projection import directions

    return directions(view).numpy().astype(np.float64)


def _origin(T_world_lidar: np.ndarray, point: tuple[float, float, float]) -> np.ndarray:
    return T_world_lidar[:3, :3] @ np.asarray(point, dtype=np.float64) + T_world_lidar[:3, 3]


def render(scene: Scene, rays: Rays, look: Look, seed: int = 0) -> RenderedImage:
    """The image of a camera along its rays; `seed`: of the sensor noise."""
    origin, directions, pixel_angle, circular = rays
    shape, origin = directions.shape[:2], origin.astype(np.float32)
    direction = directions.reshape(-1, 3)
    tiles = np.split(direction, range(TILE, len(direction), TILE))
    hits = Hits.joined([scene.cast(origin, tile) for tile in tiles])
    surfaces = gbuffer(hits, origin, directions)
    from_sky = sky_visibility(scene, hits, surfaces, circular).reshape(-1)
    from_sun = _sun(scene, hits, origin, direction, look, shape)
    # One ray a pixel makes penumbrae noisy, most of all near by.
    from_sun = edge_aware_mean(from_sun, surfaces, circular, (1,))
    smoother = edge_aware_mean(from_sun, surfaces, circular, (2,))
    from_sun = np.where(surfaces.distance < CLOSE, smoother, from_sun).reshape(-1)
    limit, visibility = SATURATION / look.exposure, Visibility(from_sun, from_sky)
    radiance = np.minimum(shade(scene, hits, origin, direction, pixel_angle, look, visibility), limit)
    count = np.ones(len(direction), dtype=np.float32)
    edge, leafy_edge = (part.reshape(-1) for part in _edges(hits, shape, circular))
    for index, off in enumerate(SUBPIXELS):  # three further rays a pixel at edges, one a pixel at the rim of leaves
        chosen = np.flatnonzero(edge if index else edge | leafy_edge)
        for pixels in np.split(chosen, range(TILE, len(chosen), TILE)):
            ray = _beside(directions, pixels, off, circular)
            more = scene.cast(origin, ray)
            lit = sunlit(scene, more, np.broadcast_to(origin, ray.shape), ray, look)
            visibility = Visibility(lit, from_sky[pixels])
            radiance[pixels] += np.minimum(shade(scene, more, origin, ray, 0.6 * pixel_angle, look, visibility), limit)
            count[pixels] += 1
    radiance /= count[:, None]
    return RenderedImage(
        image=_camera_image(radiance.reshape(*shape, 3), look, circular, seed),
        object_type=hits.object_type.reshape(shape),
        distance=hits.distance.reshape(shape),
    )


def _sun(
    scene: Scene, hits: Hits, origin: np.ndarray, direction: np.ndarray, look: Look, shape: tuple[int, int]
) -> np.ndarray:
    """Visibility of the sun (H, W); four neighbouring pixels of leaves share one ray, for speed."""
    index = np.arange(len(direction), dtype=np.int32).reshape(shape)
    first = np.repeat(np.repeat(index[::2, ::2], 2, axis=0), 2, axis=1)[: shape[0], : shape[1]].reshape(-1)
    shares = _LEAFY[hits.material] & hits.valid & (hits.material == hits.material[first])
    distance = np.where(hits.valid, hits.distance, 0)
    shares &= np.abs(distance - distance[first]) < LEAF_CELL
    traced = np.flatnonzero(~shares | (first == index.reshape(-1)))
    lit = np.empty(len(direction), dtype=np.float32)
    lit[traced] = sunlit(scene, hits.subset(traced), np.broadcast_to(origin, (len(traced), 3)), direction[traced], look)
    return np.where(shares, lit[first], lit).reshape(shape)


def _beside(directions: np.ndarray, pixels: np.ndarray, off: tuple[float, float], circular: bool) -> np.ndarray:
    """Unit vectors (K, 3) through points `off` (right, down) pixels beside the centres of some pixels."""
    rows, columns = directions.shape[:2]
    row, column = np.divmod(pixels, columns)
    left, right = column - 1, column + 1
    left, right = (part % columns if circular else part.clip(0, columns - 1) for part in (left, right))
    upper, lower = np.maximum(row - 1, 0), np.minimum(row + 1, rows - 1)
    across = (directions[row, right] - directions[row, left]) * np.float32(off[0] / 2)
    along = (directions[lower, column] - directions[upper, column]) * np.float32(off[1] / 2)
    ray = directions[row, column] + across + along
    return ray / np.linalg.norm(ray, axis=1, keepdims=True)


def _edges(hits: Hits, shape: tuple[int, int], circular: bool) -> tuple[np.ndarray, np.ndarray]:
    """Edges and rims of leaves, two (H, W) bool.

    At an edge, a neighbouring pixel differs in object type, material, distance or normal. Leaves have only a rim:
    inside it every pixel would be an edge.
    """
    object_type = np.where(hits.valid, hits.object_type, NOTHING).reshape(shape)
    material, leaves = hits.material.reshape(shape), (_LEAFY[hits.material] & hits.valid).reshape(shape)
    sky, near = ~hits.valid.reshape(shape), (1 / np.maximum(hits.distance, 1e-3)).reshape(shape)
    normal = np.ascontiguousarray(hits.normal.T).reshape(3, *shape)
    edge, leafy_edge = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    for axis in (0, 1):
        ahead = np.roll(near, -1, axis)
        step = np.abs(ahead - near) > JUMP * np.maximum(ahead, near)
        step |= (np.roll(normal, -1, axis + 1) * normal).sum(axis=0) < 0.8
        step |= np.roll(material, -1, axis) != material
        step &= ~(sky & np.roll(sky, -1, axis))
        border, leafy = np.roll(object_type, -1, axis) != object_type, leaves | np.roll(leaves, -1, axis)
        if axis == 0:
            step[-1] = border[-1] = False
        elif not circular:
            step[:, -1] = border[:, -1] = False
        step, border = (step | border) & ~leafy, border & leafy
        edge |= step | np.roll(step, 1, axis)
        leafy_edge |= border | np.roll(border, 1, axis)
    return edge, leafy_edge


def _camera_image(radiance: np.ndarray, look: Look, circular: bool, seed: int) -> np.ndarray:
    """Image (H, W, 3) uint8 sRGB of a radiance (H, W, 3)."""
    exposed = radiance * (np.float32(look.exposure) * np.asarray(look.white_balance, dtype=np.float32))
    exposed = np.pad(exposed, ((0, 0), (1, 1), (0, 0)), mode="wrap" if circular else "edge")
    exposed = np.pad(exposed, ((1, 1), (0, 0), (0, 0)), mode="edge")
    side, middle, _ = (np.float32(weight) for weight in BLUR)
    exposed = middle * exposed[1:-1] + side * (exposed[:-2] + exposed[2:])
    coded = _srgb(middle * exposed[:, 1:-1] + side * (exposed[:, :-2] + exposed[:, 2:]), look)
    noise = stream(seed, "sensor").standard_normal(coded.shape, dtype=np.float32)
    coded += noise * np.float32(SENSOR_NOISE) + np.float32(0.5)
    return np.clip(coded, 0, 255).astype(np.uint8)


def _srgb(exposed: np.ndarray, look: Look) -> np.ndarray:
    """sRGB 0..255, not rounded, of linear values where 1 is white (IEC 61966-2-1)."""
    grey = exposed @ np.array((0.2126, 0.7152, 0.0722), dtype=np.float32)[:, None]
    exposed = np.maximum(grey + (exposed - grey) * np.float32(look.saturation), 0)
    exposed *= (exposed * np.float32(1 / 0.18)) ** np.float32(CONTRAST - 1)  # about middle grey
    over = np.maximum(exposed - SHOULDER, 0)
    exposed = np.minimum(exposed, SHOULDER) + (1 - SHOULDER) * (1 - np.exp(over * np.float32(-0.8 / (1 - SHOULDER))))
    coded = np.float32(1.055) * np.maximum(exposed, 1e-6) ** np.float32(1 / 2.4) - np.float32(0.055)
    return 255 * np.where(exposed < 0.0031308, 12.92 * exposed, coded)
