"""Bicycles, motorcycles and scooters, parked or with their riders."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lidar2pano.simulate.assets.motor_vehicles import colour
from lidar2pano.simulate.assets.people import Arm, Human, Leg, Pose, figure, middle_joint, random_human, shoulder_of
from lidar2pano.simulate.assets.vehicle_body import both_sides, lathe
from lidar2pano.simulate.scene.mesh import PLAIN, Mesh, Point, Points, Tint, box, ellipsoid, merged, polygons, tube
from lidar2pano.simulate.scene.random_streams import pick


class Mount(NamedTuple):
    """A two-wheeler and its rider's contact points, metres; grips and pedals left and right."""

    mesh: Mesh
    saddle: np.ndarray
    grips: tuple[np.ndarray, np.ndarray]
    pedals: tuple[np.ndarray, np.ndarray]


def bicycle(rng: np.random.Generator) -> Mesh:
    """A city or touring bicycle, upright."""
    return merged([_bicycle(rng).mesh], "bicycle")


def motorcycle(rng: np.random.Generator) -> Mesh:
    """A motorcycle or a scooter, upright."""
    return merged([_motorcycle(rng).mesh], "motorcycle")


def bicyclist(rng: np.random.Generator) -> Mesh:
    """A bicycle with its rider, pedalling."""
    mount = _bicycle(rng)
    human = random_human(rng, child=False)
    human = replace(human, height=float(np.clip(human.height, 1.58, 1.92)), hat=False)
    helmet = _helmet(rng) if rng.uniform() < 0.35 else None
    return merged([mount.mesh, _rider(mount, human, "bicyclist", helmet, rng.uniform(0.15, 0.4))], "ridden-bicycle")


def motorcyclist(rng: np.random.Generator) -> Mesh:
    """A motorcycle or a scooter with its rider, who wears a helmet."""
    mount = _motorcycle(rng)
    human = random_human(rng, child=False)
    height = float(np.clip(human.height, 1.62, 1.95))
    human = replace(human, height=height, legs="trousers", short_sleeves=False, build=human.build * 1.06)
    rider = _rider(mount, human, "motorcyclist", _helmet(rng), rng.uniform(0.1, 0.3))
    return merged([mount.mesh, rider], "ridden-motorcycle")


def _helmet(rng: np.random.Generator) -> Tint:
    return pick(rng, ((0.05, 0.05, 0.05), (1.8, 1.8, 1.8), (1.2, 0.1, 0.1), (0.1, 0.25, 0.9), (0.7, 0.7, 0.7)))


def _rider(mount: Mount, human: Human, object_type: str, helmet: Tint | None, lean: float) -> Mesh:
    """The pose of a rider with hands on the grips and feet on the pedals."""
    k = human.size
    pelvis = mount.saddle + np.array([0.0, 0, 0.1 * k])
    neck = pelvis
    for angle in np.arange(lean, 1.2, 0.05):
        neck = pelvis + 0.56 * k * np.array([np.sin(angle), 0, np.cos(angle)])
        if np.linalg.norm(shoulder_of(human, pelvis, neck, 1) - mount.grips[0]) < 0.53 * k:
            break
    legs, arms = [], []
    for side, grip, pedal in zip((1, -1), mount.grips, mount.pedals, strict=True):
        hip, ankle = pelvis + np.array([0, side * 0.095, -0.02]) * k, pedal + np.array([-0.07, 0, 0.085]) * k
        knee = middle_joint(hip, ankle, 0.43 * k, 0.42 * k, (1, side * 0.12, 0.2))
        legs.append(Leg(hip, knee, ankle, 0.15))
        shoulder, hand = shoulder_of(human, pelvis, neck, side), grip + np.array([-0.03, 0, 0.02])
        arms.append(Arm(shoulder, middle_joint(shoulder, hand, 0.29 * k, 0.26 * k, (-0.2, side * 0.6, -1)), hand))
    return figure(human, Pose(pelvis, neck, (legs[0], legs[1]), (arms[0], arms[1])), object_type, helmet)


def _bar(points: Points, radius: float, material: str, tint: Tint = PLAIN) -> Mesh:
    return tube(points, radius, material, tint, sides=6, closed=False)


def _ring(radius: float, thick: float, material: str, round_: int = 6) -> Mesh:
    """A torus around the y axis; `radius` to its outside."""
    turn = np.linspace(-np.pi / 2, 1.5 * np.pi, round_ + 1)
    outline = np.stack([-np.cos(turn) * thick, radius - thick + np.sin(turn) * thick], axis=1)
    return lathe(outline, material, 24)


def _wheel(radius: float, tyre: float, spokes: int, wide: float) -> Mesh:
    """Tyre, rim, hub and flat spokes `wide` metres wide, around the y axis."""
    inner = radius - 2 * tyre
    turn = np.arange(spokes) * 2 * np.pi / spokes
    out = np.stack([np.cos(turn), 0 * turn, np.sin(turn)], axis=1)
    side = np.stack([-np.sin(turn), 0 * turn, np.cos(turn)], axis=1) * wide / 2
    slant = np.array([0, 0.6 * tyre, 0]) * np.where(np.arange(spokes) % 2, 1, -1)[:, None]
    ends = [0.03 * out - side + slant, 0.03 * out + side + slant, inner * out + side, inner * out - side]
    fan = polygons(np.stack(ends, 1).reshape(-1, 3), np.arange(4 * spokes).reshape(-1, 4), "rim")
    hub = lathe([(-0.045, 0.018), (-0.04, 0.028), (0.04, 0.028), (0.045, 0.018)], "rim", 8)
    rim = _ring(inner + 0.3 * tyre, 0.4 * tyre + 0.003, "rim", round_=4)
    return merged([_ring(radius, tyre, "rubber"), rim, fan, hub])


def _guard(centre: Point, radius: float, wide: float, turn: tuple[float, float], tint: Tint) -> Mesh:
    """A mudguard: an arc around a wheel between two angles from ahead upwards."""
    angle = np.linspace(*turn, 9)
    line = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1) * radius + np.array(centre)
    points = np.concatenate([line - (0, wide / 2, 0), line + (0, wide / 2, 0)])
    i = np.arange(8)
    outside = np.stack([i, i + 9, i + 10, i + 1], axis=1)
    return polygons(points, np.concatenate([outside, outside[:, [0, 3, 2, 1]]]), "paint", tint)


def _bicycle(rng: np.random.Generator) -> Mount:
    tint, draw = colour(rng), rng.uniform(size=7)
    radius = 0.345 if draw[0] < 0.8 else 0.33
    low = draw[1] < 0.45  # a step-through frame
    back, ahead = np.array([-0.53, 0, radius]), np.array([0.54, 0, radius])
    crank, seat = (-0.1, 0.0, 0.28), (-0.25, 0.0, 0.76)
    top, neck = (0.33, 0.0, 0.92), (0.375, 0.0, 0.72)
    rise, wide = 0.1 + 0.08 * draw[2], 0.26 + 0.05 * draw[3]
    bars = (top[0] - 0.02, 0.0, top[2] + rise)
    side = [_bar([seat, (back[0], 0.055, radius)], 0.008, "paint", tint)]
    side.append(_bar([crank, (back[0], 0.055, radius)], 0.009, "paint", tint))
    side.append(_bar([neck, (0.4, 0.05, 0.66), (0.47, 0.055, 0.48), (ahead[0], 0.055, radius)], 0.012, "paint", tint))
    elbow = (bars[0] + 0.02, 0.7 * wide, bars[2] + 0.02)
    end, grip = (bars[0] - 0.05, wide, bars[2] + 0.015), np.array([bars[0] - 0.16, wide, bars[2] + 0.01])
    side.append(_bar([bars, elbow, end], 0.011, "metal"))
    side.append(_bar([end, grip], 0.016, "rubber"))
    parts = [
        *(_wheel(radius, 0.019, 16, 0.004).placed(hub) for hub in (back, ahead)),
        _bar([crank, neck], 0.019, "paint", tint),
        _bar([(-0.15, 0, 0.44), neck] if low else [seat, top], 0.016, "paint", tint),
        _bar([crank, seat], 0.017, "paint", tint),
        _bar([neck, top, bars], 0.018, "paint", tint),
        _bar([seat, (-0.3, 0, 0.93)], 0.013, "metal"),
        ellipsoid((-0.33, 0, 0.955), (0.11, 0.09, 0.035), "rubber", detail=5),
        ellipsoid((-0.22, 0, 0.955), (0.1, 0.03, 0.025), "rubber", detail=4),
        lathe([(-0.06, 0.01), (-0.06, 0.098), (-0.052, 0.098), (-0.05, 0.01)], "metal", 12).placed((-0.1, 0, 0.28)),
        ellipsoid((0.43, 0, 0.83), (0.04, 0.035, 0.035), "headlamp", detail=4),
        *(mesh for part in side for mesh in both_sides(part)),
    ]
    if draw[4] < 0.75:
        dark: Tint = (0.05, 0.05, 0.05)
        parts.append(_guard(back, radius + 0.02, 0.05, (0.9, 3.3), dark))
        parts.append(_guard(ahead, radius + 0.02, 0.05, (0.7, 2.9), dark))
    if draw[5] < 0.7:
        parts += _rack(radius)
    if draw[6] < 0.25:
        parts.append(box((0.5, 0, 0.94), (0.28, 0.36, 0.22), "wood", open_sides=("top",)))
    turn = float(rng.uniform(0, 2 * np.pi))
    (left, left_foot), (right, right_foot) = _pedal(turn, 1), _pedal(turn + np.pi, -1)
    grips = (grip, grip * (1, -1, 1))
    return Mount(merged([*parts, left, right]), np.array([-0.31, 0, 0.98]), grips, (left_foot, right_foot))


def _rack(radius: float) -> list[Mesh]:
    """A luggage rack over the rear wheel, with its lamp."""
    z = 2 * radius + 0.07
    bar = _bar([(-0.3, 0.05, z), (-0.7, 0.05, z), (-0.53, 0.06, radius)], 0.006, "dark-metal")
    lamp = box((-0.72, 0, z - 0.04), (0.03, 0.07, 0.05), "tail-lamp")
    return [*both_sides(bar), box((-0.5, 0.0, z), (0.38, 0.11, 0.008), "dark-metal"), lamp]


def _pedal(turn: float, side: int) -> tuple[Mesh, np.ndarray]:
    """A crank with its pedal, and the pedal's position."""
    end = np.array([-0.1 + 0.17 * np.cos(turn), side * 0.09, 0.28 + 0.17 * np.sin(turn)])
    arm = _bar([(-0.1, side * 0.075, 0.28), end], 0.01, "metal")
    foot = end + np.array([0, side * 0.06, 0])
    return merged([arm, box(foot, (0.09, 0.1, 0.025), "rubber")]), foot


def _motorcycle(rng: np.random.Generator) -> Mount:
    return _scooter(rng) if rng.uniform() < 0.4 else _roadster(rng)


def _roadster(rng: np.random.Generator) -> Mount:
    tint, draw = colour(rng), rng.uniform(size=3)
    radius, back, ahead = 0.31, (-0.72, 0.0, 0.31), (0.72, 0.0, 0.31)
    grip = np.array([0.28, 0.34 + 0.04 * draw[0], 1.03])
    side = [
        _bar([ahead, (0.6, 0.1, 0.55), (0.44, 0.1, 0.95)], 0.026, "metal"),
        _bar([(0.4, 0, 0.98), (0.39, 0.2, 1.04), (0.28, grip[1], 1.03)], 0.014, "dark-metal"),
        _bar([(0.3, grip[1] - 0.08, 1.03), (0.25, grip[1] + 0.04, 1.03)], 0.02, "rubber"),
        _bar([(0.36, 0.25, 1.05), (0.34, 0.36, 1.2)], 0.008, "dark-metal"),
        ellipsoid((0.33, 0.38, 1.21), (0.015, 0.07, 0.045), "dark-metal", detail=4),
        _bar([back, (-0.1, 0.12, 0.4)], 0.03, "dark-metal"),
        _bar([(-0.6, 0.13, 0.35), (-0.4, 0.13, 0.72)], 0.025, "metal"),
        _bar([(0.35, 0.06, 0.85), (0.15, 0.13, 0.45), (-0.2, 0.13, 0.4), (-0.4, 0.11, 0.72)], 0.02, "dark-metal"),
        box((-0.12, 0.24, 0.32), (0.08, 0.1, 0.03), "rubber"),
    ]
    parts = [
        _wheel(radius, 0.055, 10, 0.03).placed(ahead),
        _wheel(radius, 0.065, 10, 0.03).placed(back),
        box((0.05, 0, 0.45), (0.46, 0.28, 0.36), "dark-metal"),
        box((-0.16, 0, 0.62), (0.4, 0.16, 0.2), "dark-metal"),
        tube([(0.08, 0, 0.5), (0.2, 0, 0.76)], 0.1, "metal", sides=10),
        ellipsoid((0.16, 0, 0.83), (0.3, 0.15, 0.14), "paint", tint, detail=7),
        ellipsoid((-0.3, 0, 0.8), (0.36, 0.14, 0.06), "rubber", detail=6),
        ellipsoid((-0.62, 0, 0.79), (0.2, 0.09, 0.07), "paint", tint, detail=5),
        _guard(ahead, radius + 0.03, 0.12, (0.8, 2.6), tint),
        _bar([(0.25, -0.14, 0.4), (0.1, -0.17, 0.24), (-0.3, -0.18, 0.26)], 0.03, "metal"),
        tube([(-0.3, -0.19, 0.26), (-0.8, -0.21, 0.36)], 0.055, "metal", sides=8),
        *_lights((0.56, 0.93), (-0.82, 0.8)),
        *(mesh for part in side for mesh in both_sides(part)),
    ]
    if draw[1] < 0.4:  # a fairing with its screen
        parts.append(ellipsoid((0.45, 0, 0.92), (0.24, 0.22, 0.2), "paint", tint, detail=6))
        parts.append(ellipsoid((0.42, 0, 1.1), (0.12, 0.17, 0.17), "window", detail=5))
    if draw[2] < 0.25:
        parts.append(box((-0.76, 0, 0.99), (0.36, 0.4, 0.28), "dark-metal"))
    right, pedal = grip * (1, -1, 1), np.array([-0.1, 0.24, 0.33])
    return Mount(merged(parts), np.array([-0.24, 0, 0.84]), (grip, right), (pedal, pedal * (1, -1, 1)))


def _lights(front: tuple[float, float], rear: tuple[float, float]) -> list[Mesh]:
    """Headlamp, tail lamp and a small number plate at (x, z)."""
    (x, z), (back, low) = front, rear
    return [
        ellipsoid((x, 0, z), (0.07, 0.09, 0.09), "headlamp", detail=6),
        box((back, 0, low), (0.04, 0.16, 0.05), "tail-lamp"),
        box((back - 0.02, 0, low - 0.16), (0.012, 0.2, 0.18), "plate"),
    ]


def _scooter(rng: np.random.Generator) -> Mount:
    tint, black = colour(rng), rng.uniform() < 0.3
    radius, back, ahead = 0.23, (-0.62, 0.0, 0.23), (0.66, 0.0, 0.23)
    grip = np.array([0.36, 0.31, 1.03])
    shield = np.array([
        (0.42, 0.21, 0.36), (0.38, 0.24, 0.6), (0.44, 0.17, 0.92), (0.55, 0.0, 0.94), (0.6, 0.0, 0.6),
        (0.62, 0.0, 0.36),
    ])  # fmt: skip
    quads = np.array([(0, 1, 4, 5), (1, 2, 3, 4)])
    panels = [polygons(shield, quads, "paint", tint)]
    panels.append(polygons(shield - (0.01, 0, 0), quads[:, [0, 3, 2, 1]], "dark-metal"))
    side = [
        *panels,
        _bar([(0.42, 0, 0.98), (0.42, 0.18, 1.02), (0.36, 0.3, 1.03)], 0.016, "dark-metal"),
        _bar([(0.38, 0.23, 1.03), (0.34, 0.34, 1.03)], 0.021, "rubber"),
        _bar([(0.4, 0.22, 1.04), (0.4, 0.28, 1.2)], 0.008, "dark-metal"),
        ellipsoid((0.39, 0.29, 1.21), (0.015, 0.06, 0.045), "dark-metal", detail=4),
        _bar([ahead, (0.6, 0.08, 0.5)], 0.022, "dark-metal"),
        ellipsoid((-0.45, 0.12, 0.52), (0.4, 0.13, 0.2), "paint", tint, detail=6),
    ]
    parts = [
        _wheel(radius, 0.05, 8, 0.04).placed(ahead),
        _wheel(radius, 0.05, 8, 0.04).placed(back),
        box((0.12, 0, 0.33), (0.66, 0.34, 0.08), "dark-metal"),
        box((-0.48, 0, 0.53), (0.7, 0.2, 0.46), "dark-metal"),
        ellipsoid((-0.36, 0, 0.77), (0.38, 0.15, 0.07), "rubber", detail=6),
        ellipsoid((0.5, 0, 0.98), (0.13, 0.14, 0.12), "paint", tint, detail=6),
        _guard(ahead, radius + 0.03, 0.14, (0.3, 2.7), tint),
        tube([(-0.45, -0.17, 0.24), (-0.85, -0.17, 0.3)], 0.05, "dark-metal", sides=8),
        *_lights((0.6, 0.98), (-0.86, 0.6)),
        *(mesh for part in side for mesh in both_sides(part)),
    ]
    if black:
        parts.append(box((-0.8, 0, 0.93), (0.34, 0.38, 0.28), "dark-metal"))
    right, pedal = grip * (1, -1, 1), np.array([0.22, 0.12, 0.4])
    return Mount(merged(parts), np.array([-0.3, 0, 0.83]), (grip, right), (pedal, pedal * (1, -1, 1)))
