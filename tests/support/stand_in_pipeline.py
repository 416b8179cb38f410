"""A pipeline that is fast and has no networks: its panorama depends on the scan's points and labels alone."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from lidar2pano.calibration import Calibration
from lidar2pano.errors import InputError
from lidar2pano.geometry.stitching import Camera
from lidar2pano.hardware import Timer
from lidar2pano.labels import COMMON15
from lidar2pano.memory import Memory
from lidar2pano.panorama import Panorama
from lidar2pano.scan import Scan
from lidar2pano.views import VIEWS

VIEW = VIEWS["panorama"].scaled(1 / 16)  # 24 x 288


@dataclass(frozen=True, kw_only=True)
class StandIn:
    """What `Pipeline` is to those who translate single scans.

    seconds  that each panorama takes;  offset: of the camera, from `at`.
    A scan whose first point has x > 1000 is refused; one with y > 1000 meets a bug.
    """

    seconds: float = 0.0
    offset: float = 0.0
    device: torch.device = torch.device("cpu")
    cards: dict[str, Any] = field(default_factory=dict)

    def __call__(self) -> StandIn:
        """The factory of itself."""
        return self

    def at(self, calibration: Calibration) -> StandIn:
        """See Pipeline."""
        return replace(self, offset=float(calibration.T_camera_lidar[0, 3]))

    def step(
        self,
        memory: Memory,
        scan: Scan,
        pose: None,
        timer: Timer,
        labels: np.ndarray | None = None,
        cameras: Sequence[Camera] = (),
    ) -> tuple[Memory, Panorama]:
        """See Pipeline."""
        if scan.xyz[0, 0] > 1000:
            raise InputError(f"{scan.name}: no point is in view; turn the scan")
        if scan.xyz[0, 1] > 1000:
            raise RuntimeError("a bug")
        with timer("translate"):
            ids = np.full(len(scan), 9) if labels is None else labels
        with timer("paint"):
            time.sleep(self.seconds)
            generator = np.random.default_rng(abs(int(1e6 * (scan.xyz.sum() + self.offset))) + int(ids.sum()))
            size = (VIEW.rows, VIEW.columns)
        return memory, Panorama(
            name=scan.name,
            frame=0,
            view=VIEW,
            colour=generator.integers(0, 256, (*size, 3), dtype=np.uint8),
            segments=generator.integers(0, len(COMMON15), size, dtype=np.uint8),
            depth_m=generator.uniform(1, 99, size).astype(np.float32),
            labels=ids,
        )
