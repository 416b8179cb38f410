"""Where the sensor was: a sequence's poses.txt (KITTI odometry's form)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from lidar2pano.calibration import read_calib
from lidar2pano.data.sequences import Frame
from lidar2pano.errors import InputError


def motion(now: Frame, before: Frame) -> np.ndarray | None:
    """(4, 4) float64: LiDAR coordinates at `now` -> those at `before`, a frame of the same sequence; metres.

    None where the sequence has no poses.txt. Raises InputError as LidarPoses does.
    """
    poses = LidarPoses.of(now.folder)
    return None if poses is None else np.linalg.inv(poses.at(before.stem)) @ poses.at(now.stem)


@dataclass(frozen=True, slots=True, eq=False)
class LidarPoses:
    """A sequence's poses.txt, read once. Its lines are poses of camera 0; line n is frame n, from 0.

    path  the file;  rows: (N, 3, 4) float64, metres;  Tr: (4, 4), the LiDAR's coordinates -> those of camera 0.
    """

    path: Path
    rows: np.ndarray
    Tr: np.ndarray

    @classmethod
    def of(cls, sequence: Path) -> Self | None:
        """Those of the folder ROOT/sequences/<seq>; None without poses.txt; InputError where it or calib.txt is damaged."""
        path = sequence / "poses.txt"
        return cls(path, _read(path), _lidar_to_camera0(sequence)) if path.is_file() else None

    def at(self, stem: str) -> np.ndarray:
        """(4, 4) float64: LiDAR coordinates at a frame -> those of camera 0 at the sequence's first one, metres.

        Raises InputError where the file has no line for the frame.
        """
        if not stem.isdecimal() or int(stem) >= len(self.rows):
            raise InputError(f"{self.path}: has {len(self.rows)} lines, none for frame {stem}; line n is frame n, from 0")
        pose = np.eye(4)
        pose[:3] = self.rows[int(stem)]
        return pose @ self.Tr


def _read(path: Path) -> np.ndarray:
    try:
        poses = np.loadtxt(path, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: cannot be read as poses ({error}); write 12 numbers a line, as KITTI does"
        ) from error
    if poses.shape[1:] != (12,) or not np.isfinite(poses).all():
        raise InputError(f"{path}: its lines must hold 12 finite numbers each (3x4), as KITTI's do")
    return poses.reshape(-1, 3, 4)


def _lidar_to_camera0(sequence: Path) -> np.ndarray:
    """Tr of calib.txt; a Calibration knows it only together with the way from camera 0 to the colour camera."""
    read_calib(sequence / "calib.txt", (1, 1))  # complains about whatever is wrong with the file
    lines = (sequence / "calib.txt").read_text(encoding="utf-8").splitlines()
    (row,) = [line.partition(":")[2] for line in lines if line.partition(":")[0].strip() == "Tr"]
    Tr = np.eye(4)
    Tr[:3] = np.array(row.split(), dtype=np.float64).reshape(3, 4)
    return Tr
