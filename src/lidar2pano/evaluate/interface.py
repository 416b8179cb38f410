"""Input and prediction of a system under evaluation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from lidar2pano.calibration import Calibration
from lidar2pano.panorama import Panorama
from lidar2pano.scan import Scan


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SystemInput:
    """Input of a system for one frame: the scan, and the requested viewpoints.

    calibration    the camera of the requested image, at its size; None: no camera.
    origin         the centre of the requested panorama in the scan's frame, metres; None: no panorama.
    camera_labels  (h, w) uint8 ids of COMMON15, unknown: 0; ground truth, for the oracle only.
    colours        whether colours are requested, or only classes and depths.
    pose           (4, 4) float64 T_world_sensor, metres; None if unknown.
    """

    scan: Scan
    calibration: Calibration | None = None
    origin: tuple[float, float, float] | None = None
    camera_labels: np.ndarray | None = None
    colours: bool = True
    pose: np.ndarray | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prediction:
    """Output of a system for one frame; missing parts are None.

    point_labels   (N,) integer ids of SEMANTIC_KITTI of the scan's points.
    camera_labels  (h, w) integer ids of COMMON15 in the camera's image.
    image          (h, w, 3) uint8 RGB, the camera's image.
    depth_m        (h, w) float32 metres along the ray in the camera's image; 0 = none.
    panorama       the 360-degree panorama;  painted: whether its colours are predicted, not only classes and depths.
    milliseconds   time per stage of the camera's image, or of the panorama if no camera was requested.
    """

    point_labels: np.ndarray | None = None
    camera_labels: np.ndarray | None = None
    image: np.ndarray | None = None
    depth_m: np.ndarray | None = None
    panorama: Panorama | None = None
    painted: bool = True
    milliseconds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class SystemInfo:
    """Name, weights and card entries of a system.

    name      as the user gave it;  files: weight files by role;  networks: per role, entries of its card.
    """

    name: str
    files: Mapping[str, Path] = field(default_factory=dict)
    networks: Mapping[str, dict[str, Any]] = field(default_factory=dict)


class System(Protocol):
    """A predictor of images from a scan."""

    @property
    def info(self) -> SystemInfo:
        """Name and weights."""
        ...

    @property
    def uses_ground_truth(self) -> bool:
        """True for the oracle, with ground-truth labels as input."""
        ...

    def predict(self, inputs: SystemInput, memory: Any = None) -> tuple[Any, Prediction]:  # noqa: ANN401
        """Predict one frame; returns the memory for the next frame, and the prediction.

        memory  its memory of the previous frame; None at the beginning of a sequence.
        Raises InputError for a scan without usable points.
        """
        ...
