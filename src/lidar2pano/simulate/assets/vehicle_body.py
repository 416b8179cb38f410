"""Bodies of road vehicles: one skin of cells over a side view, with windows, lamps and wheel arches.

The skin of the left half is four grids that share their edges: the side (columns along x, ROWS from the roof's edge
down to the sill), the top (the same columns, ACROSS from the middle to the edge) and the two ends. The right half is
its mirror image. Within this file x runs backwards from the nose; meshes look along +x around their middle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lidar2pano.simulate.scene.mesh import (
    Mesh,
    Points,
    Tint,
    box,
    merged,
    mesh,
    polygons,
    quadrilaterals,
    quads_of,
    smooth_normals,
)
from lidar2pano.simulate.scene.surfaces import MATERIAL_IDS

SEAM = 0.009  # metres: width of the gap around a door


class Patch(NamedTuple):
    """Unpainted cells of an end: rows [a, b) and steps across [c, d); `wrap`: metres onto the side."""

    material: str
    rows: tuple[int, int]
    across: tuple[int, int]
    wrap: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleShape:
    """Side view and measures of a vehicle, metres; x backwards from the nose, z up from the road.

    profile  outline of the top: bonnet's front edge, foot and head of the windscreen, highest point of the roof, head
             and foot of the rear screen, upper edge of the tail.
    belt     height of the side windows' lower edge at the windscreen's foot and at the tail.
    rows     heights of rows 3 to 6 at the nose, and at the tail: edges for lamps and bumpers.
    panes    side windows, from x to x;  seams: gaps around doors, x;  lean: how far a window's rear end leans forward.
    rail     half width of the roof's edge, as a share of half the width;  frame: paint above the side windows.
    tuck     half width at the side windows' lower edge, as a share; near 1 the sides are flat, as a bus's.
    round    radii of the outline's corners at the screens' heads;  sweep: how far the ends' corners lie back.
    """

    length: float
    width: float
    profile: tuple[tuple[float, float], ...]
    belt: tuple[float, float]
    sill: float
    axles: tuple[float, ...]
    wheel: float
    nose_rows: tuple[float, float, float, float]
    tail_rows: tuple[float, float, float, float]
    panes: tuple[tuple[float, float], ...]
    seams: tuple[float, ...] = ()
    lean: float = 0.0
    rail: float = 0.67
    frame: float = 0.065
    round: float = 0.13
    sweep: tuple[float, float] = (0.2, 0.14)
    narrow: tuple[float, float] = (0.1, 0.08)
    tuck: float = 0.935
    crown: tuple[float, float] = (0.06, 0.045)
    gap: float = 0.045
    front: tuple[Patch, ...] = ()
    rear: tuple[Patch, ...] = ()
    rear_screen: bool = True
    cladding: str = "paint"  # of the sill and the edges of the wheel arches
    top: str = "paint"


def overhang(shape: VehicleShape) -> float:
    """Metres from an end to the nearest axle."""
    return min([shape.length / 2, *(min(axle, shape.length - axle) for axle in shape.axles)])


def rounded_profile(shape: VehicleShape) -> np.ndarray:
    """The outline of the top with its corners rounded (n, 2), x growing."""
    points = np.array(shape.profile)
    middle = points[:2].mean(0) + (0, 0.16 * (points[1, 1] - points[0, 1]))  # bonnets are convex
    points = np.insert(points, 1, middle, axis=0)
    radii = [0.6, 0.03, shape.round, 0.5, shape.round, 0.04]
    line = [points[0]]
    for start, corner, end, radius in zip(points[:-2], points[1:-1], points[2:], radii, strict=True):
        backward, forward = start - corner, end - corner
        reach = [min(radius, 0.42 * np.hypot(*way)) / np.hypot(*way) for way in (backward, forward)]
        a, b = corner + backward * reach[0], corner + forward * reach[1]
        line += [(1 - t) ** 2 * a + 2 * t * (1 - t) * corner + t**2 * b for t in (0, 0.5, 1)]
    return np.array([*line, points[-1]])


def screens(shape: VehicleShape) -> tuple[tuple[float, float], tuple[float, float]]:
    """Extents in x of the windscreen and of the rear window."""
    (a, _), (b, _) = shape.profile[1:3]
    (c, _), (d, _) = shape.profile[4:6]
    return (a + 0.01, b - 0.1 * (b - a)), (c + 0.14 * (d - c), d - 0.05 * (d - c))


def columns(shape: VehicleShape) -> tuple[np.ndarray, np.ndarray]:
    """x of the columns, and height of their lower ends at the sill or wheel arch; both (n,)."""
    length, radius = shape.length, shape.wheel + shape.gap
    (a, b), (c, d) = screens(shape)
    edges = [0.0, length, a - 0.045, a, b, c, d, *(x for pane in shape.panes for x in pane)]
    edges = np.unique(np.round([*edges, *(x for seam in shape.seams for x in (seam, seam + SEAM))], 4))
    edges = edges[np.concatenate([[True], np.diff(edges) > 0.006])]
    inner = np.unique(np.round([*rounded_profile(shape)[1:-1, 0], 0.05, 0.16, length - 0.14, length - 0.05], 4))
    inner = inner[np.concatenate([[True], np.diff(inner) > 0.03])]
    x = np.sort(np.concatenate([edges, inner[np.abs(inner[:, None] - edges).min(1) > 0.04]]))
    bottom = shape.sill + np.interp(x, [0, 0.35, length - 0.45, length], [0.05, 0, 0, 0.09])
    order = np.zeros(len(x))
    for axle in shape.axles:
        turn = np.linspace(0, np.pi, 9)
        away = np.abs(x - axle) > radius + 0.004
        keep = away | (np.abs(np.abs(x - axle)[:, None] - radius * np.abs(np.cos(turn))).min(1) > 0.012)
        x, bottom, order = x[keep], bottom[keep], order[keep]
        inside = np.abs(x - axle) < radius
        bottom = np.where(inside, shape.wheel + np.sqrt(np.maximum(radius**2 - (x - axle) ** 2, 0)), bottom)
        x = np.concatenate([x, axle - radius * np.cos(turn), [axle - radius, axle + radius]])
        bottom = np.concatenate([bottom, shape.wheel + radius * np.sin(turn), [shape.sill, shape.sill]])
        order = np.concatenate([order, np.zeros(len(turn)), [-1, 1]])
    by_x = np.lexsort([order, np.round(x, 5)])
    return x[by_x], bottom[by_x]


def lathe(outline: Points, material: str, sides: int = 16) -> Mesh:
    """A body of revolution around the y axis from an outline (n, 2) of (y, radius); smooth.

    An outline of increasing y has its outside away from the axis.
    """
    turn = np.linspace(0, 2 * np.pi, sides + 1)
    y, radius = (np.broadcast_to(part[:, None], (len(outline), sides + 1)) for part in np.asarray(outline).T)
    points = np.stack([radius * np.cos(turn), y, radius * np.sin(turn)], axis=-1)
    grid = np.arange(sides * len(outline)).reshape(len(outline), sides)
    faces = quads_of(np.concatenate([grid, grid[:, :1]], axis=1))
    flat = points[:, :-1].reshape(-1, 3)
    return mesh(flat, faces, material, normals=smooth_normals(flat, faces))


def wheel(radius: float, width: float, spokes: int = 5, rim: float = 0.68) -> Mesh:
    """A wheel around the y axis with its outside to +y, centre at the origin; `rim`: its share of the radius.

    spokes = 0 gives a closed cover.
    """
    half, inner = width / 2, radius * rim
    tyre = [(-half, 0.9 * radius), (-0.36 * width, radius), (0.36 * width, radius)]
    tyre += [(half, 0.93 * radius), (half + 0.004, 0.84 * radius), (half - 0.006, inner)]
    parts = [lathe(tyre, "rubber")]
    if spokes == 0:
        cover = [(half - 0.006, inner), (half + 0.006, 0.9 * inner), (half - 0.02, 0.6 * inner)]
        return merged([*parts, lathe([*cover, (half - 0.002, 0.25 * inner), (half, 1e-3)], "rim")])
    ring = [(half - 0.006, inner), (half - 0.008, 0.9 * inner), (half - 0.05, 0.86 * inner)]
    parts.append(lathe(ring, "rim"))
    parts.append(lathe([(half - 0.05, 0.88 * inner), (half - 0.06, 1e-3)], "underbody", 10))
    points = []
    wide = np.clip(1.5 / spokes, 0.12, 0.3) * inner
    for angle in np.arange(spokes) * 2 * np.pi / spokes + 0.3:
        out, side = np.array([np.cos(angle), 0, np.sin(angle)]), np.array([-np.sin(angle), 0, np.cos(angle)])
        for distance, y, w in ((0.0, half - 0.02, -1.25 * wide), (0.9 * inner, half - 0.012, wide)):
            points += [out * distance + side * w / 2 + (0, y, 0), out * distance - side * w / 2 + (0, y, 0)]
    return merged([*parts, quadrilaterals(np.array(points), "rim")])


def plate(x: float, z: float, forward: bool) -> Mesh:
    """A number plate of 0.52 x 0.11 m at (x, 0, z), towards +x (forward) or -x; its uv are
    the pattern's, 0.52 x 0.14 m."""
    frame = box((x, 0, z), (0.02, 0.54, 0.13), "underbody")
    sign = 1.0 if forward else -1.0
    across, up = np.array([-0.26, 0.26, 0.26, -0.26]), np.array([-0.055, -0.055, 0.055, 0.055])
    points = np.stack([np.full(4, x + sign * 0.013), sign * across, z + up], axis=1)
    uv, normals = np.stack([across + 0.26, up + 0.07], axis=1), np.tile([sign, 0.0, 0.0], (4, 1))
    return merged([frame, quadrilaterals(points, "plate", normals=normals, uv=uv)])


ACROSS = np.array([0.0, 0.32, 0.62, 0.9, 1.0])  # places of the grids' lines between the middle and the edge
ROWS = 8  # roof's edge, window's top and bottom, shoulder, three lines on the door, sill
TINTS = {"headlamp": (0.45, 0.46, 0.48), "cloth": (0.1, 0.1, 0.11)}  # a lamp's glass around its bulb; a soft top


class Body(NamedTuple):
    """A body's mesh, and the lines of its ends down the middle: (ROWS, 2) x along the mesh's axis, z."""

    mesh: Mesh
    nose: np.ndarray
    tail: np.ndarray


def body(shape: VehicleShape, tint: Tint) -> Body:
    """The skin of a vehicle with its underside and its wheel arches; `tint` multiplies the paint's grey."""
    x, bottom = columns(shape)
    top = _top(shape, x)
    side = _side(shape, x, bottom, top[:, -1])
    ends = [_end(side[0], top[0]), _end(side[-1], top[-1])]
    grids = [_warped(shape, grid) for grid in (side, top, *ends)]
    names = [_side_cells(shape, x), _top_cells(shape, x)]
    for patches in (shape.front, shape.rear):
        names.append(np.full((ROWS - 1, len(ACROSS) - 1), "paint", dtype=object))
        for patch in patches:
            names[-1][slice(*patch.rows), slice(*patch.across)] = patch.material
    half = _skin(grids, names, [(0, 1, 0), (0, 0, 1), (1, 0, 0), (-1, 0, 0)], tint)
    lining = _lining(shape, grids[0], x, bottom)
    middle = [np.stack([grid[:, 0, 0], grid[:, 0, 2]], axis=1) for grid in grids[2:]]
    return Body(merged([*both_sides(half), *both_sides(lining)]), *middle)


def both_sides(left: Mesh) -> tuple[Mesh, Mesh]:
    """A mesh and its mirror image at y = 0."""
    flip = np.array([1, -1, 1], dtype=np.float32)
    return left, replace(left, vertices=left.vertices * flip, normals=left.normals * flip, faces=left.faces[:, ::-1])


def _top(shape: VehicleShape, x: np.ndarray) -> np.ndarray:
    """Bonnet, screens, roof and boot: (n, A, 3)."""
    (_, foot), (head, rear, end) = shape.profile[:2], [p[0] for p in (shape.profile[i] for i in (2, 4, 5))]
    a, length = foot[0], shape.length
    shifted_x = x.copy()
    if shape.panes:
        last = shape.panes[-1][1]
        shifted_x += np.interp(x, [head, last, max(rear, last + 1.6 * shape.lean)], [0, -shape.lean, 0])
    line = rounded_profile(shape)
    z = np.interp(shifted_x, line[:, 0], line[:, 1])
    bend = np.interp(x, [0.4 * a, a, head, head + 0.6, rear - 0.5, end, length], [0, 0.11, 0.08, 0, 0, -0.06, 0])
    crown = np.interp(x, [0, 0.5 * a, a, head, rear, end], np.array(shape.crown)[[0, 0, 0, 1, 1, 1]])
    edge = _half_widths(shape, x, z - crown)[0]
    v = ACROSS[None]
    across = shifted_x[:, None] + bend[:, None] * v**2 * min(1.0, shape.length / 3)
    return np.stack([across, edge[:, None] * v, z[:, None] - crown[:, None] * v**2.4], -1)


def _half_widths(shape: VehicleShape, x: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half widths (n,) at the edge of the top, at height z, and at the widest."""
    length, belt = shape.length, np.interp(x, [shape.profile[1][0], shape.length], shape.belt)
    roof = max(height for _, height in shape.profile)
    up = np.clip((z - belt) / (roof - belt), 0, 1)
    near = np.maximum(1 - np.minimum(x / 0.7, (length - x) / 0.6), 0) ** 2
    widest = shape.width / 2 * (1 - near * np.where(x < length / 2, *shape.narrow))
    low = 0.94 * shape.tuck
    return widest * (low + (shape.rail - low) * up), widest


def _side(shape: VehicleShape, x: np.ndarray, bottom: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """The left side (n, ROWS, 3), from the edge of the top (n, 3) down to `bottom` (n,)."""
    belt = np.interp(x, [shape.profile[1][0], shape.length], shape.belt)
    _, widest = _half_widths(shape, x, edge[:, 2])
    foot = np.minimum(belt, edge[:, 2] - 0.03)
    tall = np.mean(shape.belt) - shape.sill
    door = [foot - 0.035, foot - 0.2 * tall, shape.sill + 0.5 * tall, shape.sill + 0.22 * tall]
    reach = min(0.5, 0.6 * overhang(shape))
    z = [edge[:, 2], np.maximum(edge[:, 2] - shape.frame, foot), foot]
    blend = np.interp(x, [0.1, reach, shape.length - reach, shape.length - 0.1], [1, 0, 0, 1])
    for row, height in enumerate(door):
        level = height + blend * (np.where(x < shape.length / 2, shape.nose_rows[row], shape.tail_rows[row]) - height)
        z.append(np.clip(level, bottom + 0.018 * (4 - row), foot - 0.018 * (row + 1)))
    z = np.stack([*z, bottom], axis=1)
    share = np.interp(
        (z - shape.sill) / tall, [0, 0.12, 0.3, 0.55, 0.8, 0.93, 1.2], [0.945, 0.98, 0.995, 1, 0.985, 0.965, 0.94]
    )
    y = np.maximum(share, shape.tuck - 0.01 * np.arange(ROWS)) * widest[:, None]
    y[:, 2] = widest * shape.tuck
    y[:, 0] = edge[:, 1]
    down = (z[:, 0] - z[:, 1]) / (z[:, 0] - z[:, 2])
    y[:, 1] = y[:, 0] + (y[:, 2] - y[:, 0]) * down + 0.03 * np.sqrt(np.maximum(down * (1 - down), 0))
    along = np.repeat(x[:, None], ROWS, axis=1)
    along[:, 0] = edge[:, 0]
    along[:, 1] = edge[:, 0] + (x - edge[:, 0]) * down
    return np.stack([along, y, z], axis=-1)


def _end(column: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Nose or tail (ROWS, A, 3) between the side's last column (ROWS, 3) and the top's last line (A, 3)."""
    down = ((column[:, 2] - column[-1, 2]) / (column[0, 2] - column[-1, 2]))[:, None]
    x = column[:, None, 0] + (line[None, :, 0] - line[-1, 0]) * down
    z = column[:, None, 2] + (line[None, :, 2] - line[-1, 2]) * down
    y = line[None, :, 1] + (column[:, 1] - column[0, 1])[:, None] * ACROSS[None] ** 6  # lamps' edges stay upright
    return np.stack([x, y, z], axis=-1)


def _warped(shape: VehicleShape, grid: np.ndarray) -> np.ndarray:
    """Round the ends: bumpers stand out, corners lie back. From x backwards to the mesh's x forwards."""
    x, y, z = np.moveaxis(grid, -1, 0)
    half, far = shape.width / 2, min(0.5, 0.9 * (overhang(shape) - shape.wheel - shape.gap))
    for end, sign in ((0.0, 1.0), (shape.length, -1.0)):
        first = sign > 0
        up = (z - shape.sill) / ((shape.profile[0] if first else shape.profile[-1])[1] - shape.sill)
        back = np.interp(up, [0, 0.2, 0.45, 0.6, 0.9, 1.0, 1.5], [0.06, 0.0, 0.0, 0.045, 0.065, 0.1, 0.1])
        corner = shape.sweep[0 if first else 1] * (np.abs(y) / half) ** 2.6
        fade = np.clip(1 - np.abs(x - end) / far, 0, 1) ** 1.6
        x = x + sign * fade * np.minimum(corner + back * min(1.0, shape.sweep[0] / 0.12), 0.55 * far)  # no folds
    return np.stack([shape.length / 2 - x, y, z], axis=-1)


def _side_cells(shape: VehicleShape, x: np.ndarray) -> np.ndarray:
    middle = (x[1:] + x[:-1]) / 2
    cells = np.full((len(middle), ROWS - 1), "paint", dtype=object)
    cells[(middle > shape.profile[2][0]) & (middle < shape.profile[5][0]), :2] = shape.top
    for low, high in shape.panes:
        cells[(middle > low) & (middle < high), 1] = "window"
    if shape.panes:
        pillars = (middle > shape.panes[0][0]) & (middle < shape.panes[-1][1]) & (cells[:, 1] != "window")
        cells[pillars, 1] = "rubber"  # black, between two panes
    for seam in shape.seams:
        cells[np.abs(middle - seam - SEAM / 2) < SEAM / 2, 2 : ROWS - 1] = "underbody"
    cells[:, ROWS - 2] = shape.cladding
    for patches, away in ((shape.front, middle), (shape.rear, shape.length - middle)):
        for patch in patches:
            cells[away < patch.wrap, slice(max(1, patch.rows[0]), patch.rows[1])] = patch.material
    return cells


def _top_cells(shape: VehicleShape, x: np.ndarray) -> np.ndarray:
    middle = (x[1:] + x[:-1]) / 2
    cells = np.full((len(middle), len(ACROSS) - 1), "paint", dtype=object)
    front, back = screens(shape)
    cells[(middle > front[1]) & (middle < shape.profile[4][0])] = shape.top
    cells[(middle > front[0] - 0.045) & (middle < front[0])] = "underbody"  # where the wipers lie
    glass = (middle > front[0]) & (middle < front[1])
    glass |= (middle > back[0]) & (middle < back[1]) & shape.rear_screen
    cells[glass, : len(ACROSS) - 2] = "window"
    return cells


def _skin(grids: list[np.ndarray], cells: list[np.ndarray], outwards: list[tuple[int, int, int]], tint: Tint) -> Mesh:
    """Grids (n, m, 3) and the material names of their cells as one mesh; smooth, but not from glass to metal."""
    points, faces, names, start = [], [], [], 0
    for grid, cell, outward in zip(grids, cells, outwards, strict=True):
        flat = grid.reshape(-1, 3)
        tri = quads_of(np.arange(len(flat)).reshape(grid.shape[:2]))
        a, b, c = (flat[tri[:, corner]] for corner in range(3))
        normal = np.cross(b - a, c - a)
        tri = tri[:, ::-1] if normal.sum(0) @ np.array(outward) < 0 else tri
        keep = np.linalg.norm(normal, axis=1) > 2e-6
        points.append(flat)
        faces.append(tri[keep] + start)
        names.append(np.tile(cell.ravel(), 2)[keep])
        start += len(flat)
    name, tri = np.concatenate(names), np.concatenate(faces)
    place = np.round(np.concatenate(points) * 5000).astype(np.int64)
    glass = (name == "window").astype(np.int64)
    # One vertex for each place and side of the glass's edge.
    key = ((place[tri] + (1 << 18)) * np.array([1 << 40, 1 << 20, 1])).sum(-1) * 2 + glass[:, None]
    _, first, corner = np.unique(key.ravel(), return_index=True, return_inverse=True)
    vertices = np.concatenate(points)[tri.ravel()[first]].astype(np.float32)
    tri = corner.reshape(-1, 3).astype(np.int32)
    normals = smooth_normals(vertices, tri)
    # In the plane of symmetry the other half's share of the normal is missing.
    normals[np.abs(vertices[:, 1]) < 1e-6, 1] = 0
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    tints = np.array([tint if n == "paint" else TINTS.get(n, (1.0, 1.0, 1.0)) for n in name], dtype=np.float32)
    material = np.array([MATERIAL_IDS[n] for n in name], dtype=np.uint8)
    return replace(mesh(vertices, tri, "paint", normals=normals), material=material, tint=tints)


def _lining(shape: VehicleShape, side: np.ndarray, x: np.ndarray, bottom: np.ndarray) -> Mesh:
    """The lower surfaces of the left half: the wheel arches' insides, and the underside."""
    edge = side[:, -1]
    inner = shape.width / 2 - 0.34
    deep = np.stack([edge[:, 0], np.full(len(edge), inner), edge[:, 2]], axis=1)
    parts = []
    for axle in shape.axles:
        near = np.flatnonzero(np.abs(x - axle) < shape.wheel + shape.gap + 1e-4)
        near = near[bottom[near] > shape.wheel - 0.01]
        arch = np.stack([edge[near], deep[near]], axis=1)
        tri = quads_of(np.arange(2 * len(near)).reshape(-1, 2))
        parts.append(mesh(arch.reshape(-1, 3), tri[:, ::-1], "underbody"))
    wall = np.array([(-1, 0.0), (1, 0.0), (1, 1), (-1, 1)]) * np.array([shape.length / 2 - 0.3, 0.0])
    low, high = shape.sill + 0.06, shape.wheel * 2 + shape.gap + 0.03
    plate = np.stack([wall[:, 0], np.full(4, inner), [low, low, high, high]], axis=1)
    floor = np.stack([wall[:, 0], [inner, inner, 0.0, 0.0], np.full(4, low)], axis=1)
    parts.append(polygons(plate, [[1, 0, 3, 2]], "underbody"))
    parts.append(polygons(floor, [[3, 2, 1, 0]], "underbody"))
    return merged(parts)
