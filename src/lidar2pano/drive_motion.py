"""The motion of a drive's sensor: as it was recorded, else estimated from the scans; and scans without its skew."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano.data.poses import Poses, odometry
from lidar2pano.errors import InputError
from lidar2pano.formats.interpretation import FORWARD, Interpretation, Overrides
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.geometry.motion import SensorMotion, Trajectory, deskewed
from lidar2pano.recordings.drive_scans import drive_scans
from lidar2pano.recordings.recorded_scans import recorded_motion, recording_reader
from lidar2pano.scan import Scan

# (scan file or recording, scan, how it was read) -> scan without skew, T_world_sensor or None
Motion = Callable[[Path, Scan, Interpretation], tuple[Scan, np.ndarray | None]]
CITY_POSES = "city_SE3_egovehicle.feather"  # of an Argoverse 2 log, above sensors/lidar/
CITY_COLUMNS = ("timestamp_ns", "tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw")
MOST_STEP_S = 1.0  # between scans whose motion tells how the next one is skewed


class DriveMotion:
    """The motion of the sensor of one drive, requested scan after scan.

    origin  where it is from: a topic or "tf from ... to ...", a file, "KISS-ICP", or "" where it is unknown.
    """

    def __init__(self, recorded: SensorMotion | None, origin: str, estimate: bool) -> None:
        """Estimate where nothing is recorded and `estimate` is true; InputError where KISS-ICP is missing then."""
        self._recorded = recorded
        self._estimated: Any = odometry() if recorded is None and estimate else None
        self._stamp_s: float | None = None
        self.origin = "KISS-ICP" if self._estimated else origin if recorded else ""

    @classmethod
    def of_recording(cls, path: Path, options: ReadOptions, frame: str, estimate: bool) -> DriveMotion:
        """The motion of the scans of a recording, which are in the coordinate frame `frame`; InputError at damage."""
        recorded = recorded_motion(path, options, frame)
        return cls(*recorded, estimate) if recorded else cls(None, "", estimate)

    def step(self, scan: Scan, found: Interpretation, stamp_s: float) -> tuple[Scan, np.ndarray | None]:
        """The scan as a sensor at rest at its stamp would have measured it, and T_world_sensor (4, 4) float64 then.

        found  how the scan was read from its cloud.
        A scan without times stays as it is. The pose is None where the motion is unknown at that time.
        """
        if self._recorded is not None:
            motion, pose = _of_scan(self._recorded, found), self.pose(found, stamp_s)
            return (self._without_skew(scan, stamp_s, motion) if pose is not None else scan), pose
        if self._estimated is None:
            return scan, None
        scan = self._without_skew(scan, stamp_s, self._last_motion(stamp_s))
        self._estimated.register_frame(scan.xyz[np.isfinite(scan.xyz).all(1)].astype(np.float64), np.empty(0))
        self._stamp_s = stamp_s
        return scan, self._estimated.last_pose.copy()

    def pose(self, found: Interpretation, stamp_s: float) -> np.ndarray | None:
        """T_world_sensor (4, 4) float64 of a scan, as it was recorded; None where that is unknown."""
        return None if self._recorded is None else _of_scan(self._recorded, found).pose(stamp_s)

    def _last_motion(self, stamp_s: float) -> SensorMotion | None:
        """The motion if it goes on as between the two scans before; None at the beginning and after a gap."""
        if self._stamp_s is None or not 0 < (step_s := stamp_s - self._stamp_s) < MOST_STEP_S:
            return None
        delta = np.asarray(self._estimated.last_delta)
        poses = np.stack([np.linalg.inv(delta), np.eye(4), delta])
        stamps = stamp_s + step_s * np.array([-1.0, 0.0, 1.0])
        return SensorMotion((Trajectory.of_poses(stamps, poses),))

    @staticmethod
    def _without_skew(scan: Scan, stamp_s: float, motion: SensorMotion | None) -> Scan:
        if scan.time_s is None or motion is None:
            return scan
        return replace(scan, xyz=deskewed(scan.xyz, scan.time_s, stamp_s, motion))


def motion_of(stream: Path, scan: Scan, found: Interpretation, options: ReadOptions, smooth: bool) -> Motion | None:
    """The motion of the sensor through a stream, by its first scan; None where it is unknown or of no use.

    stream  a recording, or a folder of scan files.
    smooth  whether poses are wanted: they are estimated where none are recorded. Otherwise the motion is of use only
            where the points have times, and a recording holds poses.
    Raises InputError where poses are damaged, or none are recorded and KISS-ICP is missing.
    """
    if recording_reader(stream):
        if not smooth and scan.time_s is None:
            return None
        drive = DriveMotion.of_recording(stream, options, found.frame, estimate=smooth)
    elif not smooth:
        return None
    elif city := city_motion(stream):
        drive = DriveMotion(*city, estimate=False)
    else:
        poses = Poses(stream)
        return lambda file, scan, _: (scan, poses.of(file, scan))
    return (lambda _, scan, found: drive.step(scan, found, found.stamp_s or 0.0)) if drive.origin else None


def posed_scans(
    path: str | Path,
    *,
    topic: str = "",
    every: int = 1,
    start_s: float | None = None,
    end_s: float | None = None,
    overrides: Overrides | None = None,
) -> Iterator[tuple[Scan, np.ndarray | None]]:
    """The scans of a recording or of a folder of scan files, without skew, each with T_world_sensor (4, 4) float64.

    topic, every, start_s, end_s  which scans, as in `scans`;  overrides: as in `read`.
    A pose is None where the sensor's motion is unknown at that time. Raises InputError as `scans`, and where poses are
    damaged, or none are recorded and KISS-ICP (extra `odometry`) is missing.
    """
    options = ReadOptions(topic=topic, every=every, start_s=start_s, end_s=end_s)
    stream, motion = None, None
    for one in drive_scans(path, options, overrides):
        if one.stream != stream:
            stream, motion = one.stream, motion_of(one.stream, one.scan, one.found, options, smooth=True)
        yield motion(one.file, one.scan, one.found) if motion else (one.scan, None)


def _of_scan(recorded: SensorMotion, found: Interpretation) -> SensorMotion:
    """The motion of a scan's own frame, by that of its cloud's frame."""
    return SensorMotion((*recorded.links, np.linalg.inv(T_scan_cloud(found))))


def T_scan_cloud(found: Interpretation) -> np.ndarray:
    """(4, 4) float64 pose of a cloud's own frame in its scan's frame, metres."""
    cosine, sine = FORWARD[found.forward]
    T = np.eye(4)
    T[:2, :2] = [[cosine, sine], [-sine, cosine]]
    T[:3, 3] = -T[:3, :3] @ np.asarray(found.viewpoint_m)
    return T


def city_motion(folder: Path) -> tuple[SensorMotion, str] | None:
    """The motion of the vehicle of an Argoverse 2 log whose sweeps are in `folder`; None for any other folder.

    Raises InputError where the file of the poses is damaged, or pyarrow (extra `arrow`) is missing.
    """
    path = folder.resolve().parent.parent / CITY_POSES
    if not path.is_file():
        return None
    try:
        from pyarrow import feather
    except ImportError as error:
        raise InputError(f"{path}: needs the extra 'arrow': pip install 'lidar2pano[arrow]'") from error
    try:
        table = feather.read_table(path, columns=list(CITY_COLUMNS))
        rows = np.stack([table[name].to_numpy() * (1e-9 if name == "timestamp_ns" else 1) for name in CITY_COLUMNS], 1)
        return SensorMotion((Trajectory.of(rows),)), str(path)
    except Exception as error:  # of Arrow, by what is broken
        said = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: holds no poses that can be read ({said}); take it from the data set") from error
