"""Poses of scans that follow each other: from the sequence's poses.txt, else from the scans themselves (KISS-ICP)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano.data.poses import LidarPoses
from lidar2pano.errors import InputError
from lidar2pano.scan import Scan

FAR_M = 100.0  # points beyond do not tell where the sensor is


class Poses:
    """Poses of the scan files of one folder, asked for in their order.

    A folder `velodyne` of a sequence that has a poses.txt has them there. Of any other they are estimated scan after
    scan by KISS-ICP (Vizzo et al. 2023), which the extra `odometry` installs; InputError where it is not, and where
    poses.txt or calib.txt is damaged.
    """

    def __init__(self, folder: Path) -> None:
        self._told = LidarPoses.of(folder.parent) if folder.name == "velodyne" else None
        self._estimate: Any = None if self._told else _odometry()

    def of(self, file: Path, scan: Scan) -> np.ndarray:
        """(4, 4) float64: the sensor's coordinates -> coordinates that stand still, metres.

        Raises InputError where poses.txt has no line for the scan.
        """
        if self._told:
            return self._told.at(file.stem)
        self._estimate.register_frame(scan.xyz[np.isfinite(scan.xyz).all(1)].astype(np.float64), np.empty(0))
        return self._estimate.last_pose.copy()


def _odometry() -> Any:  # noqa: ANN401 KISS-ICP has no types
    try:
        from kiss_icp.config import KISSConfig
        from kiss_icp.kiss_icp import KissICP
    except ImportError as error:
        raise InputError(
            "--steady needs the sensor's poses: write poses.txt beside velodyne/, or let them be estimated: "
            "pip install 'lidar2pano[odometry]'"
        ) from error
    config = KISSConfig()
    config.data.max_range, config.data.deskew = FAR_M, False  # scans carry no times
    config.mapping.voxel_size = FAR_M / 100  # as KISS-ICP's own command does
    return KissICP(config)
