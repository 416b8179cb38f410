"""Rigid poses in general position: products in another order, or with another inverse, are other poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def pose_of(yaw_deg: float, pitch_deg: float, roll_deg: float, place: Sequence[float]) -> np.ndarray:
    """(4, 4) float64: turned about x by the roll, then about y by the pitch and about z by the yaw; at a place."""
    T = np.eye(4)
    for axis, degrees in enumerate((roll_deg, pitch_deg, yaw_deg)):
        second, third = (axis + 1) % 3, (axis + 2) % 3
        cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        turn = np.eye(4)
        turn[second, second], turn[second, third], turn[third, second], turn[third, third] = cos, -sin, sin, cos
        T = turn @ T
    T[:3, 3] = place
    return T


def somewhere() -> np.ndarray:
    """(4, 4) float64: a pose far from the origin that is turned about each axis."""
    return pose_of(110, 7, -4, (400, -30, 12))


def fields_of(T: np.ndarray) -> tuple[float, ...]:
    """The x y z qx qy qz qw of a pose (4, 4), as messages and tables have them."""
    from scipy.spatial.transform import Rotation

    return tuple(map(float, (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat())))
