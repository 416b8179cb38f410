"""Where the sensor was: a sequence's poses.txt (KITTI odometry's form), or as its scans tell."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lidar2pano.data.sequences import Frame
from lidar2pano.errors import InputError


def motion(now: Frame, before: Frame) -> np.ndarray | None:
    """(4, 4) float64: LiDAR coordinates at `now` -> those at `before`, a frame of the same sequence; metres.

    None where the sequence has no poses.txt. Its lines are poses of camera 0 relative to the first frame; line n is
    frame n, from 0. Raises InputError where the file or calib.txt is damaged or a frame has no line.
    """
    here, there = lidar_pose(now), lidar_pose(before)
    return None if here is None or there is None else np.linalg.inv(there) @ here


def lidar_pose(frame: Frame) -> np.ndarray | None:
    """(4, 4) float64: LiDAR coordinates at `frame` -> those of camera 0 at the sequence's first frame, metres.

    None and InputError as `motion` has them.
    """
    path = frame.folder / "poses.txt"
    return _pose(path, _read(path), frame) @ _lidar_to_camera0(frame) if path.is_file() else None


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


def _pose(path: Path, poses: np.ndarray, frame: Frame) -> np.ndarray:
    if not frame.stem.isdecimal() or int(frame.stem) >= len(poses):
        raise InputError(f"{path}: has {len(poses)} lines, none for frame {frame.stem}; line n is frame n, from 0")
    pose = np.eye(4)
    pose[:3] = poses[int(frame.stem)]
    return pose


def _lidar_to_camera0(frame: Frame) -> np.ndarray:
    """Tr of calib.txt; a Calibration knows it only together with the way from camera 0 to the colour camera."""
    frame.calibration((1, 1))  # complains about whatever is wrong with the file
    lines = (frame.folder / "calib.txt").read_text(encoding="utf-8").splitlines()
    (row,) = [line.partition(":")[2] for line in lines if line.partition(":")[0].strip() == "Tr"]
    Tr = np.eye(4)
    Tr[:3] = np.array(row.split(), dtype=np.float64).reshape(3, 4)
    return Tr
