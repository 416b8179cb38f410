"""People: random bodies and clothes, poses from joint angles, and the mesh of a person in a pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lidar2pano.simulate.scene.mesh import PLAIN, Mesh, Point, Tint, ellipsoid, loft, merged, tube

# Linear RGB albedo of clothes: tops are of all colours, the rest mostly dark.
TOPS = (
    (0.02, 0.02, 0.022), (0.05, 0.05, 0.055), (0.03, 0.04, 0.09), (0.05, 0.10, 0.28), (0.62, 0.61, 0.58),
    (0.30, 0.30, 0.31), (0.42, 0.04, 0.04), (0.18, 0.02, 0.04), (0.05, 0.12, 0.06), (0.45, 0.36, 0.24),
    (0.55, 0.33, 0.06), (0.40, 0.16, 0.24), (0.10, 0.30, 0.38), (0.10, 0.09, 0.05),
)  # fmt: skip
BOTTOMS = (
    (0.02, 0.02, 0.022), (0.035, 0.05, 0.10), (0.06, 0.10, 0.20), (0.10, 0.15, 0.25), (0.12, 0.12, 0.125),
    (0.28, 0.23, 0.15), (0.05, 0.05, 0.05), (0.07, 0.05, 0.03),
)  # fmt: skip
HAIR = ((0.6, 0.6, 0.6), (1, 1, 1), (1.6, 1.5, 1.3), (3.2, 3.4, 3.0), (5.5, 6.0, 5.5), (5, 7.5, 11), (2.4, 1.5, 1.0))
SKIN = ((1.05, 1.05, 1.05), (1.15, 1.2, 1.25), (0.9, 0.88, 0.85), (0.55, 0.5, 0.48), (0.28, 0.25, 0.25))


@dataclass(frozen=True, slots=True, kw_only=True)
class Human:
    """Body and clothes of a person. `height` in metres, `build`: factor of girth; tints multiply materials' albedo."""

    height: float
    build: float
    woman: bool
    legs: str  # "trousers", "shorts", "skirt" or "coat"
    short_sleeves: bool
    long_hair: bool
    bag: str  # "", "backpack" or "shoulder"
    hat: bool
    skin: Tint
    hair: Tint
    top: Tint
    bottom: Tint
    tights: Tint | None
    leather: Tint

    @property
    def size(self) -> float:
        """Height relative to 1.75 m."""
        return self.height / 1.75


class Leg(NamedTuple):
    """Joints (3,) in metres; `pitch` of the foot in radians, positive with the toes down."""

    hip: np.ndarray
    knee: np.ndarray
    ankle: np.ndarray
    pitch: float


class Arm(NamedTuple):
    """Joints (3,) in metres."""

    shoulder: np.ndarray
    elbow: np.ndarray
    hand: np.ndarray


class Pose(NamedTuple):
    """Positions of the joints, metres: pelvis and neck (3,), left and right legs and arms."""

    pelvis: np.ndarray
    neck: np.ndarray
    legs: tuple[Leg, Leg]
    arms: tuple[Arm, Arm]


def shoulder_of(human: Human, pelvis: np.ndarray, neck: np.ndarray, side: int) -> np.ndarray:
    """The shoulder's joint (3,), left for side = 1 and right for -1."""
    wide = (0.16 if human.woman else 0.185) * human.size * (0.8 + 0.2 * human.build)
    return neck + (pelvis - neck) * 0.17 + np.array([0, side * wide, 0])


def lowest(human: Human, leg: Leg) -> float:
    """How far the shoe's sole reaches down, as z in metres."""
    sole = np.array([[-0.07, 0, -0.075], [0.18, 0, -0.075], [0.06, 0, -0.075]])
    return float((leg.ankle + sole * human.size @ _foot_turn(leg))[:, 2].min())


def figure(human: Human, pose: Pose, object_type: str, helmet: Tint | None = None) -> Mesh:
    """A person in a pose; `helmet`: its tint over plastic's grey, None for a bare head."""
    parts = [_trunk(human, pose), *_head(human, pose, object_type, helmet)]
    for leg in pose.legs:
        parts += [*_leg(human, leg, object_type), _shoe(human, leg)]
    for arm in pose.arms:
        parts += _arm(human, arm)
    if human.legs in ("skirt", "coat") and pose.pelvis[2] > 0.45 * human.height and object_type == "person":
        parts.append(_hem(human, pose))
    return merged([*parts, *_bag(human, pose, object_type)], object_type)


def _rings(spine: np.ndarray, wide: np.ndarray, deep: np.ndarray) -> np.ndarray:
    """Elliptic sections (n, 13, 3) around a spine (n, 3) in the plane y = const; `wide` along y."""
    way = np.gradient(spine, axis=0)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    ahead = np.stack([way[:, 2], np.zeros(len(way)), -way[:, 0]], axis=1)
    turn = np.linspace(0, 2 * np.pi, 13)
    aside = np.sin(turn)[None, :, None] * wide[:, None, None] * np.array([0.0, 1.0, 0.0])
    return spine[:, None] + np.cos(turn)[None, :, None] * (deep[:, None, None] * ahead[:, None]) + aside


def _wrapped(rings: np.ndarray, tint: Tint) -> Mesh:
    """Cloth over closed sections (n, m, 3), without a crease where they close."""
    cloth = loft(rings, "cloth", tint)
    normals = cloth.normals.reshape(rings.shape).copy()
    seam = normals[:, 0] + normals[:, -1]
    normals[:, 0] = normals[:, -1] = seam / np.maximum(np.linalg.norm(seam, axis=1, keepdims=True), 1e-9)
    return replace(cloth, normals=normals.reshape(-1, 3))


def _trunk(human: Human, pose: Pose) -> Mesh:
    k, b = human.size, human.size * human.build
    up = np.array([-0.17, -0.1, 0.0, 0.2, 0.45, 0.7, 0.87, 0.965, 1.04])
    wide = np.array([0.06, 0.155, 0.168, 0.145, 0.155, 0.175, 0.172, 0.095, 0.05])
    if human.woman:
        wide = wide * np.array([1, 1.04, 1.06, 0.93, 0.88, 0.9, 0.9, 0.9, 0.9])
    deep = np.array([0.06, 0.115, 0.122, 0.108, 0.115, 0.122, 0.098, 0.07, 0.05])
    bow = np.array([0, -0.01, -0.015, 0.01, 0.01, 0.0, -0.02, -0.01, 0.0]) * k
    spine = pose.pelvis + up[:, None] * (pose.neck - pose.pelvis)
    spine[:, 0] += bow
    rings = _rings(spine, wide * b, deep * b)
    shirt = rings[2:].copy()  # its lower edge is at the waist; below it are trousers
    shirt[0] += (shirt[0] - spine[2]) * 0.06
    trousers = _wrapped(rings[:4], human.top if human.legs == "coat" else human.bottom)
    return merged([trousers, _wrapped(shirt, human.top)])


def _head(human: Human, pose: Pose, object_type: str, helmet: Tint | None) -> list[Mesh]:
    k = human.size**0.45  # children have large heads
    base = pose.neck + np.array([0.012, 0, 0.0]) * k
    middle = base + np.array([0.02, 0, 0.155]) * k

    def ball(offset: Point, radii: Point, material: str, tint: Tint = PLAIN, detail: int = 6) -> Mesh:
        return ellipsoid(middle + np.array(offset) * k, np.array(radii) * k, material, tint, detail=detail)

    throat = np.stack([base - (0, 0, 0.05 * k), middle - (0.01, 0, 0.04)])
    neck = tube(throat, 0.053 * k, "skin", human.skin, closed=False)
    if helmet is not None and object_type == "motorcyclist":  # it covers the face, but for a visor
        shell = ball((-0.01, 0, 0.005), (0.14, 0.12, 0.15), "plastic", helmet, 7)
        return [neck, shell, ball((0.045, 0, 0.02), (0.1, 0.1, 0.06), "window")]
    parts = [neck, ball((0, 0, 0), (0.092, 0.074, 0.115), "skin", human.skin)]
    parts.append(ball((0.09, 0, -0.012), (0.018, 0.014, 0.022), "skin", human.skin, 3))
    if helmet is not None:
        return [*parts, ball((-0.012, 0, 0.035), (0.135, 0.105, 0.105), "plastic", helmet)]
    parts.append(ball((-0.022, 0, 0.026), (0.093, 0.083, 0.103), "hair", human.hair))
    if human.long_hair:
        parts.append(ball((-0.05, 0, -0.075), (0.058, 0.082, 0.14), "hair", human.hair, 5))
    if human.hat:
        parts.append(ball((-0.01, 0, 0.065), (0.108, 0.093, 0.075), "cloth", human.bottom, 5))
        brim = middle + np.array([-0.01, 0, 0.065]) * k + np.array([0.085, 0, -0.012]) * k
        parts.append(ellipsoid(brim, np.array([0.075, 0.07, 0.012]) * k, "cloth", human.bottom, detail=4))
    return parts


def _course(points: Sequence[np.ndarray], places: Sequence[float]) -> np.ndarray:
    """Places (n, 3) along a bent limb: 0 its first joint, 1 its second, 2 its third."""
    return np.stack([np.interp(places, np.arange(len(points)), [p[axis] for p in points]) for axis in range(3)], axis=1)


def _leg(human: Human, leg: Leg, object_type: str) -> list[Mesh]:
    b = human.size * (0.5 + 0.5 * human.build)
    joints = leg[:3]
    whole = human.legs in ("trousers", "coat")
    bare = [0.085, 0.075, 0.055, 0.052, 0.057, 0.034]
    loose = [0.092, 0.085, 0.066, 0.063, 0.062, 0.055]
    places = [0, 0.45, 0.9, 1.08, 1.35, 1.98]
    radius = np.array(loose if whole else bare) * b
    cloth = human.bottom if whole else human.tights if human.tights is not None and human.legs == "skirt" else None
    material, tint = ("skin", human.skin) if cloth is None else ("cloth", cloth)
    parts = [tube(_course(joints, places), radius, material, tint)]
    if human.legs == "shorts" or (human.legs == "skirt" and object_type != "person"):
        parts.append(tube(_course(joints, [0, 0.4, 0.85]), np.array([0.1, 0.095, 0.082]) * b, "cloth", human.bottom))
    return parts


def _arm(human: Human, arm: Arm) -> list[Mesh]:
    b = human.size * (0.55 + 0.45 * human.build)
    shoulder = ellipsoid(arm.shoulder, np.array([0.06, 0.056, 0.058]) * b, "cloth", human.top, detail=5)
    palm = arm.hand + (arm.hand - arm.elbow) * 0.14
    hand = ellipsoid(palm, np.array([0.045, 0.03, 0.055]) * b, "skin", human.skin, detail=4)
    places, radius = [0, 0.5, 0.92, 1.08, 1.4, 2], np.array([0.06, 0.053, 0.045, 0.043, 0.041, 0.032]) * b
    if not human.short_sleeves:
        return [shoulder, hand, tube(_course(arm, places), radius * 1.08, "cloth", human.top)]
    bare = tube(_course(arm, places), radius * 0.85, "skin", human.skin)
    sleeve = tube(_course(arm, [0.04, 0.3, 0.62]), np.array([0.052, 0.059, 0.06]) * b, "cloth", human.top)
    return [shoulder, hand, bare, sleeve]


def _foot_turn(leg: Leg) -> np.ndarray:
    """The rotation (3, 3) from the foot frame to the body frame, for rows."""
    c, s = np.cos(leg.pitch), np.sin(leg.pitch)
    return np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])


def _shoe(human: Human, leg: Leg) -> Mesh:
    shape = ellipsoid((0.055, 0, -0.035), (0.135, 0.05, 0.065), "rubber", tint_for(human.leather, 0.06, 0.4), detail=5)
    points = shape.vertices.astype(np.float64)
    points[:, 2] = np.clip(points[:, 2] - 0.25 * np.maximum(points[:, 0] - 0.03, 0), -0.075, None)
    turn = _foot_turn(leg)
    vertices = leg.ankle + points * human.size @ turn
    return replace(shape, vertices=vertices.astype(np.float32), normals=(shape.normals @ turn).astype(np.float32))


def _hem(human: Human, pose: Pose) -> Mesh:
    """A skirt, or a coat's tails: from the waist around both legs."""
    b, coat = human.size * human.build, human.legs == "coat"
    tail = 0.72 if coat else 0.95
    ends = np.stack([_course(leg[:3], [0.6, tail]) for leg in pose.legs])
    foot = np.array([(ends[..., 0].min() + ends[..., 0].max()) / 2, 0.0, ends[..., 2].min()])
    deep = np.ptp(ends[..., 0]) / 2 + 0.11 * b
    spine = np.linspace(pose.pelvis + (0, 0, 0.1 * human.size), foot, 5)
    wide = np.array([0.15, 0.18, 0.19, 0.2, 0.21]) * b
    rings = _rings(spine, wide, np.linspace(0.118 * b, deep, 5) + np.array([0.0, 0.015, 0.012, 0.006, 0.0]))
    return _wrapped(rings[::-1], human.top if coat else human.bottom)


def _bag(human: Human, pose: Pose, object_type: str) -> list[Mesh]:
    k, trunk = human.size, pose.neck - pose.pelvis
    if human.bag == "backpack":
        back = np.array([-trunk[2], 0, trunk[0]]) / np.linalg.norm(trunk)
        middle = pose.pelvis + 0.62 * trunk + 0.16 * k * back
        return [ellipsoid(middle, np.array([0.11, 0.15, 0.22]) * k, "cloth", human.leather, detail=5)]
    if human.bag == "shoulder" and object_type == "person":
        hip = pose.pelvis + np.array([-0.02, -0.25, 0.02]) * k
        bag = ellipsoid(hip, np.array([0.15, 0.055, 0.12]) * k, "cloth", human.leather, detail=5)
        strap = np.stack([hip + (0, 0, 0.1 * k), pose.arms[1].shoulder + (0, 0.03, 0.06 * k)])
        return [bag, tube(strap, 0.012, "cloth", human.leather, sides=5, closed=False)]
    return []


def tint_for(colour: Sequence[float], base: float, shade: float) -> Tint:
    """The tint of a material of the grey `base` for a linear RGB albedo, times `shade`."""
    r, g, b = (float(c) * float(shade) / base for c in colour)
    return r, g, b


def person(rng: np.random.Generator, phase: float | None = None) -> Mesh:
    """A person standing, or walking along +x at `phase` (0..1) of the gait cycle of two steps."""
    human = random_human(rng)
    return figure(human, standing(human, rng) if phase is None else walking(human, phase), "person")


def random_human(rng: np.random.Generator, child: bool | None = None) -> Human:
    """A random person; the number of draws from `rng` is constant."""
    woman, young = rng.uniform() < 0.5, rng.uniform() < 0.14
    pick = rng.uniform(size=12)
    young = young if child is None else child
    height = 1.0 + 0.5 * pick[0] if young else (1.66 if woman else 1.79) + 0.065 * float(rng.normal())
    height = float(np.clip(height, 0.98, 2.0))
    coat, bare = pick[1] < 0.2 and not young, pick[2] < 0.3
    legs = "coat" if coat else "shorts" if bare and not woman else "skirt" if woman and pick[2] < 0.3 else "trousers"
    bag = "backpack" if pick[3] < 0.22 else "shoulder" if woman and pick[3] < 0.6 else ""
    hair = HAIR[int(pick[4] * len(HAIR))]
    shade = 0.8 + 0.4 * rng.uniform(size=4)
    return Human(
        height=height,
        build=float(0.9 + 0.32 * pick[5] ** 1.5),
        woman=woman,
        legs=legs,
        short_sleeves=not coat and pick[6] < 0.45,
        long_hair=woman and pick[7] < 0.7,
        bag=bag,
        hat=pick[8] < 0.12,
        skin=tint_for(SKIN[int(pick[9] ** 2.2 * len(SKIN))], 1.0, shade[0] * 0.5 + 0.5),
        hair=hair,
        top=tint_for(TOPS[int(pick[10] * len(TOPS))], 0.4, shade[1]),
        bottom=tint_for(BOTTOMS[int(pick[11] * len(BOTTOMS))], 0.4, shade[2]),
        tights=(0.08, 0.08, 0.09) if woman and shade[3] < 1 else None,
        leather=tint_for(BOTTOMS[int(pick[4] * len(BOTTOMS))], 0.4, shade[3]),
    )


def standing(human: Human, rng: np.random.Generator) -> Pose:
    """On both feet, arms down; a little different each time."""
    sway, lift = rng.uniform(0.02, 0.2, 2), rng.uniform(0.0, 0.6, 2)
    legs = [(0.05 * (rng.uniform() - 0.5) * 2, 0.06, 0.0) for _ in range(2)]
    return _upright(human, legs, [(float(s) - 0.08, float(e)) for s, e in zip(sway, lift, strict=True)], 0.02)


def walking(human: Human, phase: float) -> Pose:
    """The gait cycle: at phase 0 the left heel strikes, at 0.5 the right one."""
    legs, arms = [], []
    for place in (phase % 1, (phase + 0.5) % 1):
        swing = np.cos(2 * np.pi * place)
        knee = 0.08 + 0.14 * _hump(place, 0.14, 0.08) + 0.95 * _hump(place, 0.73, 0.12)
        pitch = np.interp(place, [0, 0.1, 0.42, 0.6, 0.75, 0.9, 1], [-0.3, 0, 0, 0.6, 0.7, 0, -0.3])
        legs.append((0.06 + 0.37 * swing, float(knee), float(pitch)))
        arms.append((0.03 - 0.36 * swing, 0.3 - 0.18 * swing))
    return _upright(human, legs, arms, 0.06)


def _hump(place: float, centre: float, wide: float) -> float:
    away = abs(place - centre)
    return float(np.exp(-((min(away, 1 - away) / wide) ** 2)))


def _upright(
    human: Human, legs: Sequence[tuple[float, float, float]], arms: Sequence[tuple[float, float]], lean: float
) -> Pose:
    """The pose of joint angles in radians: hip, knee and foot of each leg, shoulder and elbow of each arm, `lean`."""
    k = human.size
    pelvis = np.array([0.0, 0.0, 0.0])
    made = []
    for (hip, knee, pitch), side in zip(legs, (1, -1), strict=True):
        top = pelvis + np.array([0, side * 0.095, -0.02]) * k
        middle = top + 0.43 * k * _down(hip)
        made.append(Leg(top, middle, middle + 0.42 * k * _down(hip - knee) - (0, side * 0.015 * k, 0), pitch))
    lift = np.array([0, 0, -min(lowest(human, leg) for leg in made)])
    made = [Leg(leg.hip + lift, leg.knee + lift, leg.ankle + lift, leg.pitch) for leg in made]
    pelvis = pelvis + lift
    neck = pelvis + 0.56 * k * np.array([np.sin(lean), 0, np.cos(lean)])
    hands = []
    for (shoulder, elbow), side in zip(arms, (1, -1), strict=True):
        top = shoulder_of(human, pelvis, neck, side)
        middle = top + 0.29 * k * (_down(shoulder) + (0, side * 0.13, 0))
        hands.append(Arm(top, middle, middle + 0.26 * k * (_down(shoulder + elbow) + (0, side * 0.03, 0))))
    return Pose(pelvis, neck, (made[0], made[1]), (hands[0], hands[1]))


def _down(angle: float) -> np.ndarray:
    return np.array([np.sin(angle), 0.0, -np.cos(angle)])


def middle_joint(
    start: np.ndarray, end: np.ndarray, upper: float, lower: float, towards: Sequence[float]
) -> np.ndarray:
    """Two-bone inverse kinematics: the joint (3,) between bones of given lengths, bent `towards` a direction."""
    way = end - start
    far = min(float(np.linalg.norm(way)), 0.999 * (upper + lower))
    along = way / np.linalg.norm(way)
    on = (upper**2 - lower**2 + far**2) / (2 * far)
    aside = np.asarray(towards, dtype=float) - along * float(np.dot(towards, along))
    return start + along * on + aside / np.linalg.norm(aside) * np.sqrt(max(upper**2 - on**2, 0.0))
