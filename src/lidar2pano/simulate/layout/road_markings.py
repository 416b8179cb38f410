"""Road markings: lines, stop lines and zebra crossings, as thin strips over the carriageway."""

from __future__ import annotations

import numpy as np

from lidar2pano.simulate.layout.ground import Terrain
from lidar2pano.simulate.layout.roads import Road, locate
from lidar2pano.simulate.layout.town import Town
from lidar2pano.simulate.scene.mesh import Mesh, merged, mesh

LIFT = 0.006  # metres above the carriageway
LINE = 0.12  # metres: width of a line in towns
PIECE = 1.5  # metres: length of the straight pieces of a strip


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
    return merged(parts)


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
    clear = _clear_of_others(town, index, middle)
    left, right = road.at(s, d + width / 2)[0], road.at(s, d - width / 2)[0]
    pieces = np.flatnonzero(clear[:-1] & clear[1:])
    quads = np.stack([right[pieces], right[pieces + 1], left[pieces + 1], left[pieces]], axis=1)
    return _painted(quads, town.terrain)


def _clear_of_others(town: Town, index: int, xy: np.ndarray) -> np.ndarray:
    """Whether no other carriageway is within two metres: (N,) bool."""
    others = [road for number, road in enumerate(town.roads) if number != index]
    return locate(others, xy, reach=30.0).kerb_distance > 2.0 if others else np.ones(len(xy), dtype=bool)


def _painted(quads: np.ndarray, terrain: Terrain) -> Mesh:
    """Paint over quads (N, 4, 2), counter-clockwise from above."""
    if not len(quads):
        return merged([])
    xy = quads.reshape(-1, 2)
    points = np.column_stack([xy, terrain.height(xy) + LIFT])
    corner = np.arange(len(xy)).reshape(-1, 4)
    faces = np.concatenate([corner[:, [0, 1, 2]], corner[:, [0, 2, 3]]])
    return mesh(points, faces, "paint-white", "lane-marking", normals=terrain.normal(xy), uv=xy)


def _junction(town: Town, index: int, s: float, side: int, low: np.ndarray, high: np.ndarray) -> list[Mesh]:
    """Stop or give-way line of a side road, and a zebra crossing across the main road beside some junctions."""
    main, road = town.roads[0], town.roads[index]
    mouth = main.half_width + 1.2
    parts = [_bar(town, road, mouth + 0.4, (road.half_width / 2, road.half_width - 0.2), 0.4)]
    if main.sidewalk and (index % 3 == 0 or town.place.light_share > 0.3):
        at = s + side * (road.half_width + 5.5)
        for d in np.arange(-main.half_width + 0.5, main.half_width - 0.4, 1.0):
            parts.append(_bar(town, main, at, (d + 0.25, 0.5), 3.0))
    return [part for part in parts if len(part) and _inside(part, low, high)]


def _inside(part: Mesh, low: np.ndarray, high: np.ndarray) -> bool:
    xy = part.vertices[:, :2]
    return bool(((xy > low) & (xy < high)).all())


def _bar(town: Town, road: Road, s: float, across: tuple[float, float], long: float) -> Mesh:
    """A bar around `s`, `long` metres along the road; `across`: its middle and width."""
    middle, width = across
    ends = np.array([s - long / 2, s + long / 2])
    left, right = road.at(ends, middle + width / 2)[0], road.at(ends, middle - width / 2)[0]
    return _painted(np.stack([right[0], right[1], left[1], left[0]])[None], town.terrain)
