"""Motion of a drive's sensor, recorded or else estimated from the scans; scans without its skew."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano.bounded_files import MOST_CALIBRATION_BYTES, open_regular, read_text
from lidar2pano.calibration import read_mount
from lidar2pano.data.poses import lidar_poses, odometry
from lidar2pano.drives.folders import times
from lidar2pano.errors import InputError, require_extra
from lidar2pano.formats.file_contents import stem_of
from lidar2pano.formats.interpretation import Interpretation
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.geometry.motion import SensorMotion, Trajectory, deskewed, rotation_matrices
from lidar2pano.recordings.reading_process import recorded_motion
from lidar2pano.recordings.recorded_scans import recording_reader
from lidar2pano.scan import Scan

# (scan file or recording, scan, how it was read) -> scan without skew, T_world_sensor or None
Motion = Callable[[Path, Scan, Interpretation], tuple[Scan, np.ndarray | None]]
CITY_POSES = "city_SE3_egovehicle.feather"  # of an Argoverse 2 log, above sensors/lidar/
CITY_COLUMNS = ("timestamp_ns", "tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw")
OXTS_NUMBERS = 30  # a line of oxts/data/*.txt, of which the first are latitude, longitude, altitude, roll, pitch, yaw
EARTH_M = 6378137.0
MOST_STEP_S = 1.0  # between scans from whose motion the skew of the next one is predicted


class DriveMotion:
    """The motion of the sensor of one drive, requested scan after scan.

    origin  of the motion: a topic or "tf from ... to ...", a file, "KISS-ICP", or "" for an unknown motion.
    """

    def __init__(self, recorded: SensorMotion | None, origin: str, estimate: bool) -> None:
        """Estimate an unrecorded motion, if `estimate`; InputError if KISS-ICP is missing then."""
        self._recorded = recorded
        self._estimated: Any = odometry() if recorded is None and estimate else None
        self._stamp_s: float | None = None
        self.origin = "KISS-ICP" if self._estimated else origin if recorded else ""

    def __call__(self, _: Path, scan: Scan, interpretation: Interpretation) -> tuple[Scan, np.ndarray | None]:
        """Return the scan as measured by a sensor at rest at its stamp, and T_world_sensor (4, 4) float64 then.

        interpretation  how the scan was read from its cloud.
        A scan without times stays as it is. The pose is None at times of unknown motion.
        """
        stamp_s = interpretation.stamp_s or 0.0
        if self._recorded is not None:
            motion, pose = _of_scan(self._recorded, interpretation), self.pose(interpretation, stamp_s)
            return (_without_skew(scan, stamp_s, motion) if pose is not None else scan), pose
        if self._estimated is None:
            return scan, None
        scan = _without_skew(scan, stamp_s, self._last_motion(stamp_s))
        self._estimated.register_frame(scan.xyz[np.isfinite(scan.xyz).all(1)].astype(np.float64), np.empty(0))
        self._stamp_s = stamp_s
        return scan, self._estimated.last_pose.copy()

    def pose(self, interpretation: Interpretation, stamp_s: float) -> np.ndarray | None:
        """Return T_world_sensor (4, 4) float64 of a scan, as recorded; None if unknown."""
        return None if self._recorded is None else _of_scan(self._recorded, interpretation).pose(stamp_s)

    def _last_motion(self, stamp_s: float) -> SensorMotion | None:
        """Return the motion, continued from the two previous scans; None at the beginning and after a gap."""
        if self._stamp_s is None or not 0 < (step_s := stamp_s - self._stamp_s) < MOST_STEP_S:
            return None
        delta = np.asarray(self._estimated.last_delta)
        poses = np.stack([np.linalg.inv(delta), np.eye(4), delta])
        stamps = stamp_s + step_s * np.array([-1.0, 0.0, 1.0])
        return SensorMotion((Trajectory.of_poses(stamps, poses),))


def _without_skew(scan: Scan, stamp_s: float, motion: SensorMotion | None) -> Scan:
    if scan.time_s is None or motion is None:
        return scan
    return replace(scan, xyz=deskewed(scan.xyz, scan.time_s, stamp_s, motion))


def motion_of(
    stream: Path, scan: Scan, interpretation: Interpretation, options: ReadOptions, estimate: bool
) -> Motion | None:
    """Return the motion of the sensor through a stream, by its first scan; None for an unknown or a useless one.

    stream    a recording, or a folder of scan files.
    estimate  whether poses are wanted: they are estimated unless recorded. Otherwise motion is of use only for points
              with times, in a recording with poses.
    Raises InputError for damaged poses, and without recorded ones if KISS-ICP is missing.
    """
    if recording_reader(stream):
        if not estimate and scan.time_s is None:
            return None
        recorded = recorded_motion(stream, options, interpretation.frame)
        drive = DriveMotion(*(recorded or (None, "")), estimate)
    elif not estimate:
        return None
    elif city := city_motion(stream):
        drive = DriveMotion(*city, estimate=False)
    elif stream.absolute().name == "velodyne" and (poses := lidar_poses(stream.absolute().parent)):
        return lambda file, scan, _: (scan, poses.at(stem_of(file)))
    else:
        drive = DriveMotion(None, "", estimate)
    return drive if drive.origin else None


def _of_scan(recorded: SensorMotion, interpretation: Interpretation) -> SensorMotion:
    """Return the motion of a scan's own frame, from the motion of its cloud's frame."""
    return SensorMotion((*recorded.links, np.linalg.inv(T_scan_cloud(interpretation))))


def T_scan_cloud(interpretation: Interpretation) -> np.ndarray:
    """Return the (4, 4) float64 pose of a cloud's own frame in its scan's frame, metres."""
    T = np.eye(4)
    T[:3, :3] = interpretation.rotation
    T[:3, 3] = -T[:3, :3] @ np.asarray(interpretation.viewpoint_m)
    return T


def city_motion(folder: Path) -> tuple[SensorMotion, str] | None:
    """Return the motion of the vehicle of an Argoverse 2 log with sweeps in `folder`; None for any other folder.

    Raises InputError if the file of the poses is damaged, or pyarrow (extra `formats`) is missing.
    """
    path = folder.resolve().parent.parent / CITY_POSES
    if not path.is_file():
        return None
    with require_extra("formats", f"{path}:"):
        from pyarrow import feather
    try:
        with open_regular(path) as file:
            table = feather.read_table(file, columns=list(CITY_COLUMNS))
        rows = np.stack([table[name].to_numpy() * (1e-9 if name == "timestamp_ns" else 1) for name in CITY_COLUMNS], 1)
        return SensorMotion((Trajectory.of(rows),)), str(path)
    except Exception as error:  # of Arrow, depending on the damage
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: holds no poses that can be read ({reason}); take it from the data set") from error


def oxts_motion(scan_file: Path) -> SensorMotion | None:
    """Return the motion of the LiDAR around a scan of a KITTI raw drive, by the poses before, at and behind it.

    None for any other file, and for a drive without oxts/ or calib_imu_to_velo.txt. InputError if these are damaged.
    """
    drive, stem = scan_file.parents[2], stem_of(scan_file)
    mounts = [folder / "calib_imu_to_velo.txt" for folder in (drive, drive.parent)]
    mount = next((path for path in mounts if path.is_file()), None)
    if scan_file.parts[-3:-1] != ("velodyne_points", "data") or mount is None or not stem.isdecimal():
        return None
    names = (drive / "oxts" / "data" / f"{int(stem) + step:0{len(stem)}d}.txt" for step in (-1, 0, 1))
    files = [path for path in names if path.is_file()]
    stamps_s = times(files) if files else None
    if stamps_s is None:
        return None
    lines = [_oxts_numbers(path) for path in files]
    T_world_imu = np.stack([_oxts_pose(line, latitude=lines[0][0]) for line in lines])
    T_imu_velo = np.linalg.inv(read_mount(mount))
    return SensorMotion((Trajectory.of_poses(np.array(stamps_s), T_world_imu), T_imu_velo))


def _oxts_numbers(path: Path) -> np.ndarray:
    """Return latitude and longitude in degrees, altitude in metres, roll, pitch and yaw in radians."""
    try:
        numbers = np.array(read_text(path, MOST_CALIBRATION_BYTES).split(), dtype=np.float64)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as a pose ({error}); take it from the data set") from error
    if numbers.size != OXTS_NUMBERS or not np.isfinite(numbers[:6]).all() or abs(numbers[0]) > 89:
        raise InputError(f"{path}: must hold {OXTS_NUMBERS} numbers, latitude first; take it from the data set")
    return numbers[:6]


def _oxts_pose(numbers: np.ndarray, latitude: float) -> np.ndarray:
    """Return T_world_imu (4, 4): Mercator's metres as at a latitude, as in the data set's devkit."""
    scale_m = EARTH_M * np.cos(np.radians(latitude))
    north = np.log(np.tan(np.radians(45 + numbers[0] / 2)))
    T = np.eye(4)
    T[:3, 3] = scale_m * np.radians(numbers[1]), scale_m * north, numbers[2]
    half = numbers[3:] / 2
    about_x, about_y, about_z = rotation_matrices(np.column_stack([np.diag(np.sin(half)), np.cos(half)]))
    T[:3, :3] = about_z @ about_y @ about_x
    return T
