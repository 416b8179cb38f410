"""One bare LiDAR scan in, a 360-degree colour picture of the place out.

The public names below are imported on first use (PEP 562), so that `import lidar2pano` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lidar2pano.calibration import Calibration
    from lidar2pano.errors import InputError
    from lidar2pano.formats import read
    from lidar2pano.geometry.images import RangeImage, SegmentMap
    from lidar2pano.geometry.projection import back_project, project
    from lidar2pano.labels import CITYSCAPES, COMMON14, COMMON15, SEMANTIC_KITTI, LabelSet
    from lidar2pano.panorama import Panorama
    from lidar2pano.pipeline import Pipeline, load
    from lidar2pano.scan import Scan
    from lidar2pano.sensors import VIEWS, View
    from lidar2pano.sources import scans

__version__ = "0.1.0"

__all__ = [
    "CITYSCAPES",
    "COMMON14",
    "COMMON15",
    "SEMANTIC_KITTI",
    "VIEWS",
    "Calibration",
    "InputError",
    "LabelSet",
    "Panorama",
    "Pipeline",
    "RangeImage",
    "Scan",
    "SegmentMap",
    "View",
    "__version__",
    "back_project",
    "load",
    "project",
    "read",
    "scans",
]

# public name -> module of this package that holds it
_HOME = {
    "CITYSCAPES": "labels",
    "COMMON14": "labels",
    "COMMON15": "labels",
    "SEMANTIC_KITTI": "labels",
    "VIEWS": "sensors",
    "Calibration": "calibration",
    "InputError": "errors",
    "LabelSet": "labels",
    "Panorama": "panorama",
    "Pipeline": "pipeline",
    "RangeImage": "geometry.images",
    "Scan": "scan",
    "SegmentMap": "geometry.images",
    "View": "sensors",
    "back_project": "geometry.projection",
    "load": "pipeline",
    "project": "geometry.projection",
    "read": "formats",
    "scans": "sources",
}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
