"""Ground: rolling terrain, cut along kerbs into carriageway, sidewalk, bays and land, and the markings on it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from lidar2pano.simulate.layout.roads import Road, Terrain, locate
from lidar2pano.simulate.layout.town import LAND_USES, Town
from lidar2pano.simulate.scene.mesh import Mesh, merged, mesh, quads_of

CELL, FAR_CELL = 1.0, 10.0  # metres: cells of the grid, and of the rim around it
FAR = 420.0  # metres: width of the rim
KERBSTONE = 0.14  # metres
OBJECT_TYPE_OF_COVER = {"cobbles": "sidewalk", "gravel": "other-ground"}  # forecourts and yards; others are terrain
LIFT = 0.006  # metres above the carriageway
LINE = 0.12  # metres: width of a line in towns
PIECE = 1.5  # metres: length of the straight pieces of a strip


def split_triangles(corners: np.ndarray, value: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut triangles (T, 3, C) along the zero of their column `value`; all columns are interpolated linearly.

    Returns the negative and the other parts, and the cuts (K, 2, C) with the positive side on their left.
    """
    positive = corners[:, :, value] >= 0
    count = positive.sum(axis=1)
    negatives, positives, cuts = [corners[count == 0]], [corners[count == 3]], []
    for many, lone_is_positive in ((1, True), (2, False)):
        mixed = corners[count == many]
        if not len(mixed):
            continue
        lone = (positive[count == many] == lone_is_positive).argmax(axis=1)
        order = (lone[:, None] + np.arange(3)) % 3
        a, b, c = (np.take_along_axis(mixed, order[:, i, None, None], axis=1)[:, 0] for i in range(3))
        ab, ac = _crossing(a, b, value), _crossing(a, c, value)
        tip, rest = np.stack([a, ab, ac], 1), [np.stack([ab, b, c], 1), np.stack([ab, c, ac], 1)]
        (positives if lone_is_positive else negatives).append(tip)
        (negatives if lone_is_positive else positives).extend(rest)
        cuts.append(np.stack([ab, ac] if lone_is_positive else [ac, ab], 1))
    none = np.zeros((0, 2, corners.shape[2]))
    return np.concatenate(negatives), np.concatenate(positives), np.concatenate([none, *cuts])


def _crossing(a: np.ndarray, b: np.ndarray, value: int) -> np.ndarray:
    part = a[:, value] / (a[:, value] - b[:, value])
    out = a + (b - a) * part[:, None]
    out[:, value] = 0
    return out


X, Y, BEYOND_KERB, S, D, CARRIAGEWAY, SIDEWALK, MEDIAN, BEYOND, COVER = range(10)  # columns of the corners


def _corners(roads: Sequence[Road], low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (T, 3, 10) of the grid, and the index (T,) of their road."""
    xs, ys = np.arange(low[0], high[0] + CELL / 2, CELL), np.arange(low[1], high[1] + CELL / 2, CELL)
    x, y = np.meshgrid(xs, ys, indexing="ij")
    at = locate(roads, np.stack([x, y], -1))
    half = np.array([road.half_width for road in roads])[at.road]
    walk = np.array([road.sidewalk for road in roads])[at.road]
    median = np.array([road.median for road in roads])[at.road]
    fields = [x.ravel(), y.ravel(), at.kerb_distance, at.s, at.d]
    # At junctions the rounded corner is carriageway, not a bay.
    bay = np.where(at.other_road < 2.0, -1.0, np.abs(at.d) - half)
    fields += [bay, at.kerb_distance - walk, np.abs(at.d) - median, at.kerb_distance - 14.0, np.zeros(x.size)]
    table = np.stack(fields, axis=1)
    faces = quads_of(np.arange(x.size).reshape(x.shape))
    return table[faces], at.road[faces[:, 0]]


def ground(town: Town, low: np.ndarray, high: np.ndarray) -> Mesh:
    """The ground between the corners low and high (2,), metres, and a coarse rim around it."""
    corners, owner = _corners(town.roads, low, high)
    terrain, covers, parts = town.terrain, list(LAND_USES.values()), list[Mesh]()
    for index, road in enumerate(town.roads):
        own = corners[owner == index]
        if len(own):
            # The first corner belongs to the road; between two roads the others may belong to another one.
            own[:, :, COVER] = town.land_use_ids(index, own[:, 0, S], own[:, 0, D])[:, None]
            beyond, surfaces = _street(own, road, terrain)
            number = beyond[:, 0, COVER].astype(np.int64)
            parts += surfaces
            for cover in np.unique(number):
                near, far, _ = split_triangles(beyond[number == cover], BEYOND)
                for part, material in ((near, covers[cover].near), (far, covers[cover].far)):
                    object_type = OBJECT_TYPE_OF_COVER.get(material, "terrain")
                    parts.append(_surface(part, terrain, road.kerb, material, object_type, (X, Y)))
    return merged([*parts, *_rim(terrain, low, high, covers[0].far)])


def _street(corners: np.ndarray, road: Road, terrain: Terrain) -> tuple[np.ndarray, list[Mesh]]:
    """Surfaces of one road from the middle outwards, and the triangles beyond its sidewalk."""
    along = (S, D)
    level, beyond, cuts = split_triangles(corners, BEYOND_KERB)
    carriageway, bays, _ = split_triangles(level, CARRIAGEWAY)
    parts = []
    if road.median:
        strip, carriageway, _ = split_triangles(carriageway, MEDIAN)
        parts.append(_surface(strip, terrain, 0.04, "grass", "terrain", (X, Y)))
    parts.append(_surface(carriageway, terrain, 0.0, road.surface, "road", along))
    parts.append(_surface(bays, terrain, 0.0, "cobbles" if road.kerb else road.surface, "parking", along))
    if road.sidewalk:
        beyond[:, :, BEYOND_KERB] -= KERBSTONE
        stone, beyond, _ = split_triangles(beyond, BEYOND_KERB)
        walk, beyond, _ = split_triangles(beyond, SIDEWALK)
        parts.append(_surface(stone, terrain, road.kerb, "kerb", "sidewalk", along))
        parts.append(_surface(walk, terrain, road.kerb, road.paving, "sidewalk", along))
        parts.append(_kerb(cuts, terrain, road.kerb))
    return beyond, parts


def _surface(
    corners: np.ndarray, terrain: Terrain, rise: float, material: str, object_type: str, texture: tuple[int, int]
) -> Mesh:
    a, b = corners[:, 1, :2] - corners[:, 0, :2], corners[:, 2, :2] - corners[:, 0, :2]
    corners = corners[a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] > 1e-9].reshape(-1, corners.shape[-1])
    xy = corners[:, :2]
    points = np.column_stack([xy, terrain.height(xy) + rise])
    return _mesh(points, terrain.normal(xy), corners[:, list(texture)], material, object_type)


def _mesh(vertices: np.ndarray, normals: np.ndarray, uv: np.ndarray, material: str, object_type: str) -> Mesh:
    return merged([mesh(vertices, np.arange(len(vertices)), material, normals=normals, uv=uv)], object_type)


def _kerb(cuts: np.ndarray, terrain: Terrain, height: float) -> Mesh:
    """Upright faces along the cuts (K, 2, C), from the carriageway up to the sidewalk on their left."""
    a, b = cuts[:, 0, :2], cuts[:, 1, :2]
    run = b - a
    length = np.linalg.norm(run, axis=1, keepdims=True)
    a, b, run, along = (part[length[:, 0] > 1e-6] for part in (a, b, run / np.maximum(length, 1e-9), cuts[:, :, S]))
    outwards = np.column_stack([run[:, 1], -run[:, 0], np.zeros(len(run))])
    low_a, low_b = (np.column_stack([end, terrain.height(end) - 0.02]) for end in (a, b))
    high_a, high_b = low_a + (0, 0, height + 0.02), low_b + (0, 0, height + 0.02)
    corners = np.stack([low_a, low_b, high_b, low_a, high_b, high_a], axis=1).reshape(-1, 3)
    u = along[:, [0, 1, 1, 0, 1, 0]]
    v = np.tile([0.0, 0.0, height, 0.0, height, height], (len(a), 1))
    uv = np.stack([u, v], -1).reshape(-1, 2)
    return _mesh(corners, np.repeat(outwards, 6, axis=0), uv, "kerb", "sidewalk")


def _rim(terrain: Terrain, low: np.ndarray, high: np.ndarray, material: str) -> Iterator[Mesh]:
    """Four coarse pieces of land around the grid."""
    (west, south), (east, north) = low, high
    sides = [((west - FAR, east + FAR), part) for part in ((south - FAR, south), (north, north + FAR))]
    sides += [(part, (south, north)) for part in ((west - FAR, west), (east, east + FAR))]
    for side in sides:
        xs, ys = (np.linspace(*span, max(int((span[1] - span[0]) / FAR_CELL), 1) + 1) for span in side)
        grid = np.stack(np.meshgrid(xs, ys, indexing="ij"), -1)
        corners = grid.reshape(-1, 2)[quads_of(np.arange(grid.size // 2).reshape(grid.shape[:2]))]
        yield _surface(corners, terrain, 0.0, material, "terrain", (0, 1))


def markings(town: Town, low: np.ndarray, high: np.ndarray) -> Mesh:
    """All road markings between the corners low and high (2,), metres."""
    parts: list[Mesh] = []
    for index, road in enumerate(town.roads):
        if road.marking == "none":
            continue
        for d, width, dash, gap in _lines(road, index == 0):
            starts = np.arange(0.0, road.length, dash + gap)
            parts += [_strip(town, index, (s, min(s + dash, road.length)), d, width, low, high) for s in starts]
    for number, (s, side) in enumerate(town.junctions):
        parts += _junction(town, number + 1, s, side, low, high)
    return merged(parts, "lane-marking")


def _lines(road: Road, main: bool) -> list[tuple[float, float, float, float]]:
    """Lines along a road: offset from the centreline, width, dash and gap, in metres."""
    edge = road.half_width - 0.25
    if road.marking == "motorway":
        inner = road.median + 2.5 + 1.875
        out = [(side * (road.median + 0.5), 0.15, 40.0, 0.0) for side in (-1, 1)]
        out += [(side * inner, 0.15, 6.0, 12.0) for side in (-1, 1)]
        return out + [(side * (inner + 3.75), 0.3, 40.0, 0.0) for side in (-1, 1)]
    if road.marking == "country":
        return [(0.0, LINE, 4.0, 8.0), (edge, LINE, 40.0, 0.0), (-edge, LINE, 40.0, 0.0)]
    return [(0.0, LINE, 3.0, 6.0)] if main else []


def _strip(
    town: Town, index: int, span: tuple[float, float], d: float, width: float, low: np.ndarray, high: np.ndarray
) -> Mesh:
    """A line from span[0] to span[1] metres along a road, interrupted at other roads."""
    road = town.roads[index]
    count = max(int(np.ceil((span[1] - span[0]) / PIECE)), 1) + 1
    s = np.linspace(*span, count)
    middle, _ = road.at(s, d)
    if not ((middle > low) & (middle < high)).all(axis=1).any():
        return merged([])
    neighbours = [road for number, road in enumerate(town.roads) if number != index]
    clear = locate(neighbours, middle, reach=30.0).kerb_distance > 2.0  # metres from other carriageways
    left, right = road.at(s, d + width / 2)[0], road.at(s, d - width / 2)[0]
    pieces = np.flatnonzero(clear[:-1] & clear[1:])
    quads = np.stack([right[pieces], right[pieces + 1], left[pieces + 1], left[pieces]], axis=1)
    return _painted(quads, town.terrain)


def _painted(quads: np.ndarray, terrain: Terrain) -> Mesh:
    """Paint over quads (N, 4, 2), counter-clockwise from above."""
    xy = quads.reshape(-1, 2)
    points = np.column_stack([xy, terrain.height(xy) + LIFT])
    corner = np.arange(len(xy)).reshape(-1, 4)
    faces = np.concatenate([corner[:, [0, 1, 2]], corner[:, [0, 2, 3]]])
    return mesh(points, faces, "paint-white", normals=terrain.normal(xy), uv=xy)


def _junction(town: Town, index: int, s: float, side: int, low: np.ndarray, high: np.ndarray) -> list[Mesh]:
    """Stop or give-way line of a side road, and a zebra crossing across the main road beside some junctions."""
    main, road = town.roads[0], town.roads[index]
    mouth = main.half_width + 1.2
    parts = [_bar(town, road, mouth + 0.4, (road.half_width / 2, road.half_width - 0.2), 0.4)]
    if main.sidewalk and (index % 3 == 0 or town.place.light_share > 0.3):
        at = s + side * (road.half_width + 5.5)
        for d in np.arange(-main.half_width + 0.5, main.half_width - 0.4, 1.0):
            parts.append(_bar(town, main, at, (d + 0.25, 0.5), 3.0))
    return [part for part in parts if ((part.vertices[:, :2] > low) & (part.vertices[:, :2] < high)).all()]


def _bar(town: Town, road: Road, s: float, across: tuple[float, float], long: float) -> Mesh:
    """A bar around `s`, `long` metres along the road; `across`: its middle and width."""
    middle, width = across
    ends = np.array([s - long / 2, s + long / 2])
    left, right = road.at(ends, middle + width / 2)[0], road.at(ends, middle - width / 2)[0]
    return _painted(np.stack([right[0], right[1], left[1], left[0]])[None], town.terrain)
