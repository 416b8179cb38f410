"""One bare LiDAR scan in, a 360-degree colour picture of the place out.

The public names below are imported on first use (PEP 562), so that `import lidar2pano` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lidar2pano.calibration import Calibration, LensCalibration, read_calib
    from lidar2pano.drives.reading import posed_scans, scans
    from lidar2pano.drives.viewpoints import Place, scans_at
    from lidar2pano.errors import InputError
    from lidar2pano.geometry.projection import RangeImage, project
    from lidar2pano.geometry.stitching import Camera
    from lidar2pano.labels import CITYSCAPES, COMMON14, COMMON15, SEMANTIC_KITTI, LabelSet
    from lidar2pano.memory import Memory
    from lidar2pano.panorama import Panorama
    from lidar2pano.pipeline import Pipeline, load
    from lidar2pano.recordings.recorded_scans import read
    from lidar2pano.scan import Scan
    from lidar2pano.views import VIEWS, View

__version__ = "0.1.0"

# public name -> module of this package that holds it
_HOME = {
    "CITYSCAPES": "labels",
    "COMMON14": "labels",
    "COMMON15": "labels",
    "SEMANTIC_KITTI": "labels",
    "VIEWS": "views",
    "Calibration": "calibration",
    "Camera": "geometry.stitching",
    "InputError": "errors",
    "LabelSet": "labels",
    "LensCalibration": "calibration",
    "Memory": "memory",
    "Panorama": "panorama",
    "Pipeline": "pipeline",
    "Place": "drives.viewpoints",
    "RangeImage": "geometry.projection",
    "Scan": "scan",
    "View": "views",
    "load": "pipeline",
    "posed_scans": "drives.reading",
    "project": "geometry.projection",
    "read": "recordings.recorded_scans",
    "read_calib": "calibration",
    "scans": "drives.reading",
    "scans_at": "drives.viewpoints",
}

__all__ = [
    "CITYSCAPES",
    "COMMON14",
    "COMMON15",
    "SEMANTIC_KITTI",
    "VIEWS",
    "Calibration",
    "Camera",
    "InputError",
    "LabelSet",
    "LensCalibration",
    "Memory",
    "Panorama",
    "Pipeline",
    "Place",
    "RangeImage",
    "Scan",
    "View",
    "__version__",
    "load",
    "posed_scans",
    "project",
    "read",
    "read_calib",
    "scans",
    "scans_at",
]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
