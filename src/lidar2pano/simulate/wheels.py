"""Wheels, and other small parts that most road vehicles have."""

from __future__ import annotations

import numpy as np

from lidar2pano.simulate.mesh import Mesh, merged, mesh, smooth_normals
from lidar2pano.simulate.shapes import box, polygons, quads_of


def lathe(outline: np.ndarray, material: str, kind: str, sides: int = 16) -> Mesh:
    """A body of revolution around the y axis from an outline (n, 2) of (y, radius); smooth.

    Its outside is on the right of the way along the outline, seen with y to the right and the radius up... so an
    outline of growing y has its outside away from the axis.
    """
    turn = np.linspace(0, 2 * np.pi, sides + 1)
    y, radius = (np.broadcast_to(part[:, None], (len(outline), sides + 1)) for part in outline.T)
    points = np.stack([radius * np.cos(turn), y, radius * np.sin(turn)], axis=-1)
    grid = np.arange(sides * len(outline)).reshape(len(outline), sides)
    faces = quads_of(np.concatenate([grid, grid[:, :1]], axis=1))
    flat = points[:, :-1].reshape(-1, 3)
    return mesh(flat, faces, material, kind, normals=smooth_normals(flat, faces))


def wheel(radius: float, width: float, kind: str, spokes: int = 5, rim: float = 0.68) -> Mesh:
    """A wheel around the y axis with its outside to +y, centre at the origin; `rim`: its share of the radius.

    spokes = 0 gives a closed cover.
    """
    half, inner = width / 2, radius * rim
    tyre = [(-half, 0.9 * radius), (-0.36 * width, radius), (0.36 * width, radius)]
    tyre += [(half, 0.93 * radius), (half + 0.004, 0.84 * radius), (half - 0.006, inner)]
    parts = [lathe(np.array(tyre), "rubber", kind)]
    if spokes == 0:
        cover = [
            (half - 0.006, inner),
            (half + 0.006, 0.9 * inner),
            (half - 0.02, 0.6 * inner),
            (half - 0.002, 0.25 * inner),
        ]
        parts.append(lathe(np.array([*cover, (half, 1e-3)]), "rim", kind))
        return merged(parts)
    ring = [(half - 0.006, inner), (half - 0.008, 0.9 * inner), (half - 0.05, 0.86 * inner)]
    parts.append(lathe(np.array(ring), "rim", kind))
    parts.append(lathe(np.array([(half - 0.05, 0.88 * inner), (half - 0.06, 1e-3)]), "underbody", kind, sides=10))
    points, quads = [], []
    wide = np.clip(1.5 / spokes, 0.12, 0.3) * inner
    for angle in np.arange(spokes) * 2 * np.pi / spokes + 0.3:
        out, side = np.array([np.cos(angle), 0, np.sin(angle)]), np.array([-np.sin(angle), 0, np.cos(angle)])
        for distance, y, w in ((0.0, half - 0.02, 1.25 * wide), (0.9 * inner, half - 0.012, wide)):
            points += [out * distance - side * w / 2 + (0, y, 0), out * distance + side * w / 2 + (0, y, 0)]
        quads.append(np.array([0, 1, 3, 2]) + len(points) - 4)
    parts.append(polygons(np.array(points), np.array(quads), "rim", kind))
    return merged(parts)


def plate(x: float, z: float, kind: str, forward: bool) -> Mesh:
    """A number plate of 0.52 x 0.11 m at (x, 0, z) that looks along +x (forward) or -x; its uv are
    the pattern's, 0.52 x 0.14 m."""
    frame = box((x, 0, z), (0.02, 0.54, 0.13), "underbody", kind)
    sign = 1.0 if forward else -1.0
    across, up = np.array([-0.26, 0.26, 0.26, -0.26]), np.array([-0.055, -0.055, 0.055, 0.055])
    points = np.stack([np.full(4, x + sign * 0.013), sign * across, z + up], axis=1)
    uv = np.stack([across + 0.26, up + 0.07], axis=1)
    normals = np.tile([sign, 0.0, 0.0], (4, 1))
    return merged([frame, mesh(points, np.array([(0, 1, 2), (0, 2, 3)]), "plate", kind, normals=normals, uv=uv)])
