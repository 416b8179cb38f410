"""Motion of a sensor: poses between recorded ones, and scans without the skew of a moving sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

BIN_S = 2.5e-4  # points of a scan within so many seconds share a pose: less than 4 mm at 30 m/s
LONGEST_SWEEP_S = 2.0  # times of points that lie further from the stamp are no times of one turn
FAR_S = 0.5  # a pose is not taken from further beyond the first or last recorded one
SAME_ROTATION = 1 - 1e-9  # cosine between quaternions above which they are interpolated linearly


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Recorded poses of a frame in another one, in the order of their stamps.

    stamp_s      (N,) float64, N >= 1, ascending.
    translation  (N, 3) float64, metres.
    rotation     (N, 4) float64 unit quaternions x y z w.
    """

    stamp_s: np.ndarray
    translation: np.ndarray
    rotation: np.ndarray

    @classmethod
    def of(cls, rows: ArrayLike) -> Trajectory:
        """The trajectory of rows (stamp_s, x, y, z, qx, qy, qz, qw) in any order; of equal stamps the last counts.

        Raises ValueError where there is no row, or one holds no pose.
        """
        table = np.asarray(rows, dtype=np.float64).reshape(-1, 8)
        norm = np.linalg.norm(table[:, 4:], axis=1, keepdims=True)
        if not len(table) or not np.isfinite(table).all() or (np.abs(norm - 1) > 0.01).any():
            raise ValueError("not a pose: translation and unit quaternion must be finite")
        table[:, 4:] /= norm
        table = table[np.argsort(table[:, 0], kind="stable")]
        table = table[np.append(np.diff(table[:, 0]) > 0, True)]
        return cls(table[:, 0], table[:, 1:4], table[:, 4:])

    @classmethod
    def of_poses(cls, stamp_s: np.ndarray, T: np.ndarray) -> Trajectory:
        """The trajectory of rigid poses (N, 4, 4) at ascending stamps (N,)."""
        return cls(stamp_s, T[:, :3, 3], np.array([quaternion(R) for R in T[:, :3, :3]]))

    def at(self, stamp_s: np.ndarray) -> np.ndarray:
        """(M, 4, 4) float64 poses at stamps (M,); beyond the first and last recorded one these themselves."""
        later = np.clip(np.searchsorted(self.stamp_s, stamp_s), 1, max(len(self.stamp_s) - 1, 1))
        earlier, later = later - 1, np.minimum(later, len(self.stamp_s) - 1)
        span_s = np.where(later > earlier, self.stamp_s[later] - self.stamp_s[earlier], 1.0)
        share = np.clip((stamp_s - self.stamp_s[earlier]) / span_s, 0, 1)[:, None]
        T = np.zeros((len(share), 4, 4))
        T[:, :3, 3] = self.translation[earlier] * (1 - share) + self.translation[later] * share
        T[:, :3, :3] = rotation_matrices(_slerp(self.rotation[earlier], self.rotation[later], share))
        T[:, 3, 3] = 1
        return T


@dataclass(frozen=True, slots=True, eq=False)
class SensorMotion:
    """The way of a sensor through the world: the product of its links from the world down to the sensor.

    links  trajectories, and (4, 4) float64 poses of what is mounted rigidly.
    """

    links: tuple[Trajectory | np.ndarray, ...]

    def at(self, stamp_s: np.ndarray) -> np.ndarray:
        """(M, 4, 4) float64 T_world_sensor at stamps (M,)."""
        T = np.broadcast_to(np.eye(4), (len(stamp_s), 4, 4))
        for link in self.links:
            T = T @ (link.at(stamp_s) if isinstance(link, Trajectory) else link)
        return T

    def pose(self, stamp_s: float) -> np.ndarray | None:
        """(4, 4) float64 T_world_sensor; None further than FAR_S from what was recorded."""
        for link in self.links:
            if isinstance(link, Trajectory) and not (link.stamp_s[0] - FAR_S <= stamp_s <= link.stamp_s[-1] + FAR_S):
                return None
        return self.at(np.array([stamp_s]))[0]


def deskewed(xyz: np.ndarray, time_s: np.ndarray, stamp_s: float, motion: SensorMotion) -> np.ndarray:
    """(N, 3) points where a sensor that had stood still at the stamp would have measured them; dtype of `xyz`.

    xyz     (N, 3) as measured by the moving sensor, metres;  time_s: (N,) when, in seconds relative to `stamp_s`.
    motion  of the sensor. Points without a time within LONGEST_SWEEP_S of the stamp stay where they are.
    """
    timed = np.abs(time_s) < LONGEST_SWEEP_S
    if not timed.any():
        return xyz
    steps = np.zeros(len(time_s), np.int64)
    steps[timed] = np.round(time_s[timed] / BIN_S)
    first = steps.min()
    stamps = stamp_s + np.arange(first, steps.max() + 1) * BIN_S
    T = np.linalg.inv(motion.at(np.array([stamp_s])))[0] @ motion.at(stamps)
    own = T[steps - first]
    return (np.einsum("nij,nj->ni", own[:, :3, :3], xyz) + own[:, :3, 3]).astype(xyz.dtype)


def rotation_matrices(rotation: np.ndarray) -> np.ndarray:
    """(N, 3, 3) of unit quaternions (N, 4) x y z w."""
    x, y, z, w = rotation.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def quaternion(R: np.ndarray) -> np.ndarray:
    """Unit quaternion (4,) x y z w of a rotation (3, 3): the eigenvector of Bar-Itzhack 2000, equation 2."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R
    K = np.array(
        [
            [xx - yy - zz, yx + xy, zx + xz, zy - yz],
            [yx + xy, yy - xx - zz, zy + yz, xz - zx],
            [zx + xz, zy + yz, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    return np.linalg.eigh(K)[1][:, 3]


def _slerp(start: np.ndarray, end: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Unit quaternions (M, 4) at a share (M, 1) of the shorter way from `start` to `end` (Shoemake 1985)."""
    cosine = np.einsum("mi,mi->m", start, end)[:, None]
    end, cosine = np.where(cosine < 0, -end, end), np.abs(cosine)
    angle = np.arccos(np.minimum(cosine, SAME_ROTATION))
    curved = (np.sin((1 - share) * angle) * start + np.sin(share * angle) * end) / np.sin(angle)
    mixed = np.where(cosine < SAME_ROTATION, curved, start * (1 - share) + end * share)
    return mixed / np.linalg.norm(mixed, axis=1, keepdims=True)
