"""Poses of a sequence's frames: its poses.txt (KITTI odometry's form), else estimated from the scans (KISS-ICP)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano.bounded_files import read_lines
from lidar2pano.calibration import ROTATION_TOLERANCE, read_camera0
from lidar2pano.data.cache import cached_by_files
from lidar2pano.errors import InputError, require_extra

FAR_M = 100.0  # points beyond are not used to estimate poses
MOST_POSES_BYTES = 1 << 25  # two hundred thousand lines, six hours
FARTHEST_M = 1e8  # a place is at most so far from any origin


@dataclass(frozen=True, slots=True, eq=False)
class LidarPoses:
    """The poses of a sequence's poses.txt. Its lines are poses of camera 0; line n is frame n, from 0.

    path  the file;  rows: (N, 3, 4) float64, metres, NaN if the pose is unknown;  Tr: (4, 4) T_camera0_lidar.
    """

    path: Path
    rows: np.ndarray
    Tr: np.ndarray

    def at(self, stem: str) -> np.ndarray | None:
        """Return (4, 4) float64 T_world_sensor of a frame, metres; the world is camera 0's frame at the start.

        None if the frame's line is NaN: its pose is unknown. Raises InputError if the file has no line for the frame.
        """
        if not stem.isdecimal() or int(stem) >= len(self.rows):
            raise InputError(
                f"{self.path}: has {len(self.rows)} lines, none for frame {stem}; line n is frame n, from 0"
            )
        pose = np.eye(4)
        pose[:3] = self.rows[int(stem)]
        return None if np.isnan(pose).any() else pose @ self.Tr

    def first(self) -> np.ndarray:
        """Return the same of the first frame whose pose is known."""
        stems = (str(index) for index in range(len(self.rows)))
        return next(pose for stem in stems if (pose := self.at(stem)) is not None)


def lidar_poses(sequence: Path) -> LidarPoses | None:
    """Return the poses of the folder ROOT/sequences/<seq>; None without poses.txt.

    Raises InputError if poses.txt or calib.txt is damaged.
    """
    return _read_poses(sequence) if (sequence / "poses.txt").is_file() else None


@cached_by_files(lambda sequence: (sequence / "poses.txt", sequence / "calib.txt"))
def _read_poses(sequence: Path) -> LidarPoses:
    path = sequence / "poses.txt"
    rows = read_poses(path, 12, "12 numbers a line, as KITTI does").reshape(-1, 3, 4)
    return LidarPoses(path, rows, read_camera0(sequence / "calib.txt"))


def read_poses(path: Path, numbers: int, form: str) -> np.ndarray:
    """Return the lines (N, numbers) float64 of a text file; the last twelve of each are a pose (3x4), metres, or NaN.

    form  of its lines, for the message.
    Raises InputError if the file is missing or damaged, or a line holds no pose.
    """
    try:
        rows = [line for line in read_lines(path, MOST_POSES_BYTES) if line.partition("#")[0].strip()]
        lines = np.loadtxt(rows, ndmin=2) if rows else np.empty((0, 0))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as poses ({error}); write {form}") from error
    poses = lines[:, -12:]
    unknown = np.atleast_1d(np.isnan(poses).all(axis=-1))
    finite = np.isfinite(lines[~unknown]).all() and np.isfinite(lines[:, :-12]).all()
    if lines.shape[1:] != (numbers,) or not finite or unknown.all():
        raise InputError(f"{path}: its lines must hold {numbers} finite numbers each; write {form}")
    if (far := (np.abs(poses) > FARTHEST_M).any(1)).any():
        raise InputError(f"{path}: line {far.argmax() + 1} is on no planet; write metres")
    R = np.where(unknown[:, None, None], np.eye(3), poses.reshape(-1, 3, 4)[:, :, :3])
    wrong = (np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)) > ROTATION_TOLERANCE).any((1, 2)) | (np.linalg.det(R) < 0)
    if wrong.any():
        raise InputError(f"{path}: line {wrong.argmax() + 1} holds no rotation; take the file from the data set")
    return lines


def odometry() -> Any:  # noqa: ANN401 KISS-ICP has no types
    """KISS-ICP, ready for the first scan; InputError if the extra `recordings` is not installed."""
    with require_extra("recordings", "--steady without poses.txt beside velodyne/"):
        from kiss_icp.config import KISSConfig
        from kiss_icp.kiss_icp import KissICP
    config = KISSConfig()
    config.data.max_range, config.data.deskew = FAR_M, False  # scans carry no times
    config.mapping.voxel_size = FAR_M / 100  # as KISS-ICP's own command does
    return KissICP(config)
