"""People: their looks are drawn from a random stream, their poses follow from angles at the joints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidar2pano.simulate.figures import Arm, Leg, Looks, Pose, figure, lowest, over, shoulder_of
from lidar2pano.simulate.mesh import Mesh

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


def person(rng: np.random.Generator, phase: float | None = None) -> Mesh:
    """Someone standing, or walking along +x at the place `phase` (0..1) of a cycle of two steps."""
    looks = looks_of(rng)
    return figure(looks, standing(looks, rng) if phase is None else walking(looks, phase), "person")


def looks_of(rng: np.random.Generator, child: bool | None = None) -> Looks:
    """Draw a person; always the same number of draws from the stream."""
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
    return Looks(
        height=height,
        build=float(0.9 + 0.32 * pick[5] ** 1.5),
        woman=woman,
        legs=legs,
        short_sleeves=not coat and pick[6] < 0.45,
        long_hair=woman and pick[7] < 0.7,
        bag=bag,
        hat=pick[8] < 0.12,
        skin=over(SKIN[int(pick[9] ** 2.2 * len(SKIN))], 1.0, shade[0] * 0.5 + 0.5),
        hair=hair,
        top=over(TOPS[int(pick[10] * len(TOPS))], 0.4, shade[1]),
        bottom=over(BOTTOMS[int(pick[11] * len(BOTTOMS))], 0.4, shade[2]),
        tights=(0.08, 0.08, 0.09) if woman and shade[3] < 1 else None,
        leather=over(BOTTOMS[int(pick[4] * len(BOTTOMS))], 0.4, shade[3]),
    )


def standing(looks: Looks, rng: np.random.Generator) -> Pose:
    """On both feet, arms down; a little different each time."""
    sway, lift = rng.uniform(0.02, 0.2, 2), rng.uniform(0.0, 0.6, 2)
    legs = [(0.05 * (rng.uniform() - 0.5) * 2, 0.06, 0.0) for _ in range(2)]
    return _upright(looks, legs, [(float(s) - 0.08, float(e)) for s, e in zip(sway, lift, strict=True)], 0.02)


def walking(looks: Looks, phase: float) -> Pose:
    """The gait's cycle: at phase 0 the left heel touches the ground, at 0.5 the right one."""
    legs, arms = [], []
    for place in (phase % 1, (phase + 0.5) % 1):
        swing = np.cos(2 * np.pi * place)
        knee = 0.08 + 0.14 * _hump(place, 0.14, 0.08) + 0.95 * _hump(place, 0.73, 0.12)
        pitch = np.interp(place, [0, 0.1, 0.42, 0.6, 0.75, 0.9, 1], [-0.3, 0, 0, 0.6, 0.7, 0, -0.3])
        legs.append((0.06 + 0.37 * swing, float(knee), float(pitch)))
        arms.append((0.03 - 0.36 * swing, 0.3 - 0.18 * swing))
    return _upright(looks, legs, arms, 0.06)


def _hump(place: float, at: float, wide: float) -> float:
    away = abs(place - at)
    return float(np.exp(-((min(away, 1 - away) / wide) ** 2)))


def _upright(
    looks: Looks, legs: Sequence[tuple[float, float, float]], arms: Sequence[tuple[float, float]], lean: float
) -> Pose:
    """From angles in radians: hip, knee and foot of each leg, shoulder and elbow of each arm; `lean` of the trunk."""
    k = looks.size
    pelvis = np.array([0.0, 0.0, 0.0])
    made = []
    for (hip, knee, pitch), side in zip(legs, (1, -1), strict=True):
        top = pelvis + np.array([0, side * 0.095, -0.02]) * k
        middle = top + 0.43 * k * _down(hip)
        made.append(Leg(top, middle, middle + 0.42 * k * _down(hip - knee) - (0, side * 0.015 * k, 0), pitch))
    lift = np.array([0, 0, -min(lowest(looks, leg) for leg in made)])
    made = [Leg(leg.hip + lift, leg.knee + lift, leg.ankle + lift, leg.pitch) for leg in made]
    pelvis = pelvis + lift
    neck = pelvis + 0.56 * k * np.array([np.sin(lean), 0, np.cos(lean)])
    hands = []
    for (shoulder, elbow), side in zip(arms, (1, -1), strict=True):
        top = shoulder_of(looks, pelvis, neck, side)
        middle = top + 0.29 * k * (_down(shoulder) + (0, side * 0.13, 0))
        hands.append(Arm(top, middle, middle + 0.26 * k * (_down(shoulder + elbow) + (0, side * 0.03, 0))))
    return Pose(pelvis, neck, (made[0], made[1]), (hands[0], hands[1]))


def _down(angle: float) -> np.ndarray:
    return np.array([np.sin(angle), 0.0, -np.cos(angle)])


def bent(start: np.ndarray, end: np.ndarray, upper: float, lower: float, towards: Sequence[float]) -> np.ndarray:
    """The joint (3,) between two bones of given lengths from start to end, pushed `towards` a direction."""
    way = end - start
    far = min(float(np.linalg.norm(way)), 0.999 * (upper + lower))
    along = way / np.linalg.norm(way)
    on = (upper**2 - lower**2 + far**2) / (2 * far)
    aside = np.asarray(towards, dtype=float) - along * float(np.dot(towards, along))
    return start + along * on + aside / np.linalg.norm(aside) * np.sqrt(max(upper**2 - on**2, 0.0))
