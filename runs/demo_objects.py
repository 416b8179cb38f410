"""What stands in the street of the demonstration scan: vehicles, people, trees, walls, as solids that a ray can meet.

Every object is a list of solids in its own frame (x forward, z up, ground at z = 0); `placed` puts it into the street.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np


class Matter(NamedTuple):
    """What a surface does to a beam."""

    albedo: float  # remission at normal incidence, 10 m away
    spread: float  # deviation of remission from point to point
    gloss: float = 0.0  # 1: returns only what falls on it squarely
    loss: float = 0.0  # probability that nothing returns


LEAF, BARK, GRASS = Matter(0.40, 0.11), Matter(0.38, 0.11), Matter(0.40, 0.07)
ASPHALT, PAVING, SLABS = Matter(0.265, 0.045), Matter(0.335, 0.045), Matter(0.345, 0.045)
LINE = Matter(0.46, 0.08)
GLASS, PANE = Matter(0.03, 0.03, 1.0, 0.8), Matter(0.22, 0.12, 0.4, 0.2)  # of cars, of houses behind curtains
RUBBER, CHROME, STEEL = Matter(0.07, 0.05, 0.0, 0.35), Matter(0.5, 0.3, 0.3), Matter(0.32, 0.14, 0.4)
PLATE, SIGN = Matter(1.6, 0.2), Matter(1.0, 0.35)  # they send light back to where it came from
CLOTH, SKIN, TIMBER = Matter(0.36, 0.10), Matter(0.42, 0.05), Matter(0.36, 0.08)
# Dark paint returns almost nothing unless hit squarely; half of the real cars' points have remission 0.
PAINTS = (
    Matter(0.02, 0.04, 0.6, 0.05), Matter(0.06, 0.06, 0.6, 0.04), Matter(0.22, 0.10, 0.9, 0.04),
    Matter(0.40, 0.14, 0.9, 0.02), Matter(0.55, 0.10, 0.7, 0.0),
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """A convex body: `axes` (3, 3) and `centre` (3,) take local coordinates to the street's, in metres.

    planes  (K, 4) rows (n, d): local points with n . q <= d are inside; None: the unit ball.
    reach   metres from `centre` to the farthest point.
    pores   mean path in metres that a beam goes inside before it is returned; 0: returned by the surface.
    skin    pattern on the surface: "facade", "cabin", "panels", "pickets", "spokes" or "" (demo_scan.pattern).
    salt    tells the pores of one solid from those of the next.
    """

    matter: Matter
    label: str
    axes: np.ndarray
    centre: np.ndarray
    reach: float
    planes: np.ndarray | None = None
    drum: bool = False  # the unit cylinder instead of the unit ball
    pores: float = 0.0
    skin: str = ""
    salt: int = 0


def placed(solids: list[Solid], x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> list[Solid]:
    """The solids turned by `yaw` radians about z and moved."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    move = np.array([x, y, z])
    return [replace(s, axes=turn @ s.axes, centre=turn @ s.centre + move) for s in solids]


def ball(matter: Matter, label: str, centre: tuple, radii: tuple, **more) -> Solid:
    """An ellipsoid."""
    return Solid(matter, label, np.diag(radii), np.array(centre, float), max(radii), **more)


def drum(matter: Matter, label: str, ends: tuple, radius: float, **more) -> Solid:
    """A cylinder from the first of `ends` to the second."""
    first, last = np.array(ends, float)
    along = (last - first) / 2
    half = float(np.linalg.norm(along))
    across = np.cross(along, [1.0, 0.0, 0.0] if abs(along[0]) < 0.9 * half else [0.0, 1.0, 0.0])
    across *= radius / np.linalg.norm(across)
    axes = np.stack([across, np.cross(along, across) / half, along], axis=1)
    return Solid(matter, label, axes, (first + last) / 2, float(np.hypot(radius, half)), drum=True, **more)


def box(matter: Matter, label: str, low: tuple, high: tuple, **more) -> Solid:
    """A box with sides along the axes; its local frame is the cube -1 .. 1."""
    low, high = np.array(low, float), np.array(high, float)
    half, planes = (high - low) / 2, np.concatenate([np.eye(3), -np.eye(3)])
    cube = np.concatenate([planes, np.ones((6, 1))], axis=1)
    return Solid(matter, label, np.diag(half), (low + high) / 2, float(np.linalg.norm(half)), planes=cube, **more)


def prism(matter: Matter, label: str, profile: tuple, half: float, lean: tuple = (), **more) -> Solid:
    """A convex profile of (x, z), counter-clockwise, drawn out over |y| <= half.

    lean  (slope, z0): above z0 the sides lean inwards; (slope, z0, x0): beyond |x| = x0 they are cut off as well.
    """
    points = np.array(profile, float)
    edges = np.roll(points, -1, axis=0) - points
    normals = np.stack([edges[:, 1], np.zeros(len(edges)), -edges[:, 0]], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    depth = normals[:, 0] * points[:, 0] + normals[:, 2] * points[:, 1]
    rows = [*np.column_stack([normals, depth]), *([0, side, 0, half] for side in (1, -1))]
    if lean:
        slope, z0 = lean[:2]
        rows += [[0, side, slope, half + slope * z0] for side in (1, -1)]
    for x0 in lean[2:]:
        rows += [[0.4 * end, side, 0, half + 0.4 * x0] for side in (1, -1) for end in (1, -1)]
    reach = float(np.sqrt((points**2).sum(axis=1).max() + half**2))
    return Solid(matter, label, np.eye(3), np.zeros(3), reach, planes=np.array(rows, float), **more)


# Profiles (x, z) of body and cabin, half width, wheel positions and radius.
VEHICLES = {
    "hatchback": (
        ((-1.95, 0.3), (-1.7, 0.2), (1.8, 0.2), (2.0, 0.32), (2.0, 0.55), (1.85, 0.74), (1.05, 0.95), (-1.8, 0.98),
         (-1.97, 0.8)),
        ((-1.85, 0.9), (1.15, 0.9), (0.3, 1.42), (-0.3, 1.49), (-1.35, 1.44)),
        0.86, (-1.25, 1.25), 0.31,
    ),
    "saloon": (
        ((-2.3, 0.34), (-2.05, 0.2), (2.05, 0.2), (2.3, 0.34), (2.3, 0.55), (2.15, 0.74), (1.2, 0.95), (-1.7, 1.0),
         (-2.28, 0.94)),
        ((-1.75, 0.9), (1.2, 0.9), (0.4, 1.38), (-0.25, 1.44), (-1.0, 1.4)),
        0.9, (-1.4, 1.38), 0.32,
    ),
    "estate": (
        ((-2.3, 0.34), (-2.05, 0.2), (2.05, 0.2), (2.28, 0.34), (2.28, 0.55), (2.1, 0.76), (1.15, 0.97), (-2.2, 1.0),
         (-2.32, 0.8)),
        ((-2.2, 0.9), (1.2, 0.9), (0.35, 1.4), (-0.3, 1.48), (-1.85, 1.45)),
        0.9, (-1.4, 1.4), 0.32,
    ),
    "van": (
        ((-2.45, 0.4), (-2.2, 0.25), (2.2, 0.25), (2.45, 0.4), (2.45, 0.75), (2.25, 0.98), (1.6, 1.15), (-2.45, 1.2)),
        ((-2.45, 1.1), (1.75, 1.1), (0.95, 1.85), (0.5, 1.95), (-2.38, 1.95)),
        0.96, (-1.5, 1.55), 0.33,
    ),
}  # fmt: skip


def vehicle(kind: str, paint: Matter) -> list[Solid]:
    """A car or van: body, cabin with glass, four wheels, lamps, number plates, mirrors, bumpers."""
    profile, cabin, half, wheels, radius = VEHICLES[kind]
    front, rear = max(x for x, _ in profile), min(x for x, _ in profile)
    parts = [
        prism(paint, "car", profile, half, (0.25, 0.62, front - 0.5)),
        prism(paint, "car", cabin, half - 0.06, (0.34, 0.95, front - 0.4), skin="panels" if kind == "van" else "cabin"),
    ]
    for x in wheels:
        for side in (1, -1):
            ends = ((x, side * (half - 0.2), radius), (x, side * (half + 0.01), radius))
            parts.append(drum(RUBBER, "car", ends, radius))
            ends = ((x, side * half, radius), (x, side * (half + 0.02), radius))
            parts.append(drum(CHROME, "car", ends, 0.6 * radius))
    for end, x in ((1, front), (-1, rear)):
        x0, x1 = sorted((x - 0.04 * end, x + 0.012 * end))
        low = 0.42 if end > 0 or kind == "van" else 0.62
        parts.append(box(PLATE, "car", (x0, -0.26, low), (x1, 0.26, low + 0.11)))
        for side in (1, -1):
            parts.append(ball(CHROME, "car", (x - 0.17 * end, side * (half - 0.2), 0.68), (0.12, 0.15, 0.1)))
    for side in (1, -1):
        parts.append(ball(paint, "car", (0.75, side * (half + 0.07), 1.02), (0.07, 0.1, 0.07)))
    return parts


def person(cloth: float, stride: float) -> list[Solid]:
    """Somebody 1.75 m tall, walking along x."""
    matter, name = Matter(cloth, 0.1), "person"
    parts = [
        ball(matter, name, (0, 0, 1.18), (0.14, 0.22, 0.36)),
        ball(SKIN, name, (0.02, 0, 1.63), (0.11, 0.09, 0.13)),
    ]
    for side in (1, -1):
        foot, knee, hip = (
            (side * stride, side * 0.1, 0.05),
            (side * stride * 0.7, side * 0.1, 0.48),
            (0, side * 0.09, 0.9),
        )
        parts += [drum(CLOTH, name, (foot, knee), 0.06), drum(CLOTH, name, (knee, hip), 0.085)]
        parts.append(drum(matter, name, ((0, side * 0.23, 1.42), (-side * stride * 0.8, side * 0.27, 0.88)), 0.05))
    return parts


def bicycle(label: str = "bicycle") -> list[Solid]:
    """A bicycle along x: two wheels, frame, saddle, handlebar."""
    parts = []
    for x in (-0.52, 0.52):
        parts.append(drum(CHROME, label, ((x, -0.02, 0.34), (x, 0.02, 0.34)), 0.34, skin="spokes"))
    tubes = (
        ((-0.52, 0, 0.34), (-0.05, 0, 0.3)), ((-0.05, 0, 0.3), (-0.2, 0, 0.9)), ((-0.05, 0, 0.3), (0.35, 0, 0.78)),
        ((-0.15, 0, 0.75), (0.35, 0, 0.82)), ((0.52, 0, 0.34), (0.33, 0, 0.98)), ((0.3, -0.27, 1.0), (0.3, 0.27, 1.0)),
    )  # fmt: skip
    parts += [drum(STEEL, label, ends, 0.025) for ends in tubes]
    return [*parts, ball(CLOTH, label, (-0.22, 0, 0.94), (0.14, 0.08, 0.05))]


def cyclist() -> list[Solid]:
    """A bicycle with its rider; both carry the rider's label, as in SemanticKITTI."""
    name = "bicyclist"
    parts = bicycle(name)
    parts += [
        drum(CLOTH, name, ((-0.18, 0, 0.98), (0.1, 0, 1.42)), 0.17),
        ball(SKIN, name, (0.2, 0, 1.66), (0.12, 0.1, 0.14)),
    ]
    for side, foot in ((1, (0.08, 0.12, 0.2)), (-1, (-0.1, -0.12, 0.45))):
        knee, hip = (0.22, side * 0.12, 0.62 + 0.1 * (side < 0)), (-0.18, side * 0.1, 0.95)
        parts += [drum(CLOTH, name, (foot, knee), 0.06), drum(CLOTH, name, (knee, hip), 0.08)]
        parts.append(drum(CLOTH, name, ((0.08, side * 0.2, 1.4), (0.32, side * 0.25, 1.03)), 0.05))
    return parts


def post(height: float, radius: float) -> list[Solid]:
    """A lamp post, or the post of a sign."""
    foot = drum(STEEL, "pole", ((0, 0, 0), (0, 0, min(1.0, height))), 1.3 * radius)
    return [drum(STEEL, "pole", ((0, 0, -0.2), (0, 0, height)), radius), foot]


def sign(shape: str, size: float) -> list[Solid]:
    """A traffic sign on its post, facing -x: "round", "triangle" or "board"."""
    corners = {"round": 12, "triangle": 3, "board": 4}[shape]
    turn = {"round": 0.0, "triangle": np.pi / 2, "board": np.pi / 4}[shape] + 2 * np.pi * np.arange(corners) / corners
    profile = tuple(zip(size * np.cos(turn), size * np.sin(turn), strict=True))
    plates = [prism(matter, "traffic-sign", profile, 0.01) for matter in (SIGN, STEEL)]
    sides = [*placed(plates[:1], 0, 0.03), *placed(plates[1:], 0, 0.0)]  # grey from behind
    return post(2.9, 0.035) + placed(sides, -0.06, 0, 2.45, np.pi / 2)
