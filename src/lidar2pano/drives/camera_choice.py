"""The choice of a scan's cameras: by the user, or beside the scan in the layout of a data set.

Scans without cameras go no further than this file.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path
from typing import NamedTuple

from lidar2pano.errors import InputError

SISTERS = ("image_2", "image_3")  # KITTI odometry's colour cameras
RAW = ("image_02", "image_03")  # and those of a raw drive
NUSCENES = "LIDAR_TOP"  # folder of its sweeps


class NamedCamera(NamedTuple):
    """A camera of --camera: an image, or a folder with an image of each scan, by its name; calibration and pose."""

    image: Path
    calibration: Path
    pose: Path | None = None


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """Choice of a scan's cameras: those named, or else those found beside it, if `auto`.

    topics     of a recording's cameras; none: those with a CameraInfo.
    masks      of the vehicle: one for all of them, or one each, in their order.
    viewpoint  whether the panorama stands at the optical centre of a scan's only camera: without parallax.
    """

    named: tuple[NamedCamera, ...] = ()
    auto: bool = True
    topics: tuple[str, ...] = ()
    masks: tuple[Path, ...] = ()
    viewpoint: bool = True


def may_have_cameras(scan_file: Path) -> bool:
    """Return whether a scan's file lies in a layout of a data set with cameras, by names of folders alone."""
    folder = scan_file.resolve().parent
    if folder.name == "velodyne":
        sequence = folder.parent
        family = sequence.name.rpartition("-")[0]
        sisters = sequence.parent.glob(f"{family}-*") if family else ()
        images = (place / name for place in (sequence, *sisters) for name in SISTERS)
        return (sequence / "calib").is_dir() or any(map(Path.is_dir, images))
    if folder.parent.name == "velodyne" or folder.parts[-2:] == ("velodyne_points", "data"):  # tracking, raw
        return any((folder.parents[1] / name).is_dir() for name in RAW)
    return folder.name == NUSCENES or (folder / "info.json").is_file()


def parse_camera(text: str) -> NamedCamera:
    """Return the camera of "IMAGE:CALIB" or "IMAGE:CALIB:POSE"; InputError unless all are files or folders."""
    words = text.split(":")
    if len(words) < len(NamedCamera._fields) - 1:
        raise InputError(f"--camera {text}: has no calibration; name its calibration behind a colon, IMAGE:CALIB")
    for colons in (1, 2):
        for cuts in combinations(range(1, len(words)), colons):  # the others are parts of paths
            parts = [":".join(words[start:end]) for start, end in pairwise((0, *cuts, len(words)))]
            if all(part and Path(part).exists() for part in parts):
                return NamedCamera(*map(Path, parts))
    missing = next((word for word in words if not Path(word).exists()), text)
    raise InputError(f"--camera {text!r}: is not of the form IMAGE:CALIB[:POSE], or {missing!r} is missing; name files")
