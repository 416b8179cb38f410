"""Calibration: a pinhole camera and where it stands relative to the LiDAR; KITTI's calib.txt."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidar2pano.errors import InputError

ROTATION_TOLERANCE = 1e-3  # of R R^T from 1; KITTI writes 7 to 13 digits


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibration:
    """A rectified pinhole camera. pixel (u, v, 1) ~ K (R x + t), with u to the right and v down, centres at integers.

    K                (3, 3) float64, pixels.
    T_camera_lidar   (4, 4) float64: LiDAR coordinates -> camera (x right, y down, z ahead), metres.
    size             (width, height) of the image in pixels.
    """

    K: np.ndarray
    T_camera_lidar: np.ndarray
    size: tuple[int, int]

    def __post_init__(self) -> None:
        """Refuse matrices of another shape, and images without pixels (ValueError)."""
        if self.K.shape != (3, 3) or self.T_camera_lidar.shape != (4, 4):
            raise ValueError(f"Calibration: K (3, 3), T (4, 4), got {self.K.shape}, {self.T_camera_lidar.shape}")
        if min(self.size) < 1:
            raise ValueError(f"Calibration.size must be positive, got {self.size}")

    @property
    def centre(self) -> tuple[float, float, float]:
        """The optical centre in the LiDAR frame, metres."""
        R, t = self.T_camera_lidar[:3, :3], self.T_camera_lidar[:3, 3]
        x, y, z = (-np.linalg.inv(R) @ t).tolist()
        return x, y, z

    def scaled(self, factor: float) -> Calibration:
        """The same camera with an image `factor` times as wide and high (pixel centres kept at integers)."""
        K = self.K.copy()
        K[:2, 2] += 0.5
        K[:2] *= factor
        K[:2, 2] -= 0.5
        width, height = round(self.size[0] * factor), round(self.size[1] * factor)
        return Calibration(K=K, T_camera_lidar=self.T_camera_lidar, size=(width, height))


def read_calib(path: str | Path, size: tuple[int, int] = (1242, 375)) -> Calibration:
    """Read KITTI odometry's calib.txt: P2 (3x4) and Tr (3x4, LiDAR -> rectified camera 0).

    pixel ~ P2 [Tr; 0 0 0 1] [x y z 1]^T. P2 = K [I | b]: the colour camera stands b away from camera 0.
    Raises InputError where the file, P2 or Tr is missing, not numbers, or no camera matrix and rotation.
    """
    path = Path(path)
    rows = _rows(path)
    P2, Tr = (_matrix(path, rows, name) for name in ("P2", "Tr"))
    K, R = P2[:, :3], Tr[:, :3]
    if abs(np.linalg.det(K)) < 1e-9 or K[2, 2] == 0:
        raise InputError(f"{path}: row P2: is no camera matrix (it cannot be inverted); take the row from KITTI's file")
    if np.linalg.det(R) < 0 or not np.allclose(R @ R.T, np.eye(3), atol=ROTATION_TOLERANCE):
        raise InputError(f"{path}: row Tr: holds no rotation (LiDAR -> camera 0); take the row from KITTI's file")
    T = np.eye(4)
    T[:3] = Tr
    T[:3, 3] += np.linalg.solve(K, P2[:, 3])
    return Calibration(K=K / K[2, 2], T_camera_lidar=T, size=size)


def _rows(path: Path) -> dict[str, str]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as calib.txt ({_reason(error)}); name KITTI's file") from error
    parts = (line.partition(":") for line in text.splitlines())
    return {name.strip(): numbers for name, _, numbers in parts}


def _reason(error: Exception) -> str:
    return error.strerror or "no reason given" if isinstance(error, OSError) else "not text"


def _matrix(path: Path, rows: dict[str, str], name: str) -> np.ndarray:
    if name not in rows:
        raise InputError(f"{path}: has no row {name}:; KITTI's odometry calib.txt has P2: and Tr:")
    try:
        numbers = np.array([float(word) for word in rows[name].split()])
    except ValueError as error:
        raise InputError(f"{path}: row {name}: holds something that is no number ({error})") from error
    if numbers.size != 12 or not np.isfinite(numbers).all():
        raise InputError(f"{path}: row {name}: must hold 12 finite numbers (3x4), it has {numbers.size}")
    return numbers.reshape(3, 4)
