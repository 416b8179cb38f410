"""PandaSet as files: Pandar64 scans, six cameras, hand-made point classes (Xiao et al. 2021, CC BY 4.0).

ROOT/sequences/<seq>/{velodyne/NNNNNN.bin, calib/NNNNNN.json, labels_pandaset/NNNNNN.label, <camera>/NNNNNN.jpg};
ROOT/classes.json (id -> name). Its frame has x to the right and y forward, and its origin is not the LiDAR: it lies
below, near the road.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano.bounded_files import read_input
from lidar2pano.data.camera_files import camera_matrix, read_motion
from lidar2pano.data.frames import Frame, FrameList, scan_names
from lidar2pano.data.surround import FROM_RIGHT_FORWARD, SurroundFrame, moved, read_camera
from lidar2pano.errors import InputError, closest
from lidar2pano.formats.json_files import read_json
from lidar2pano.formats.scan_files import MOST_BYTES, read_bin
from lidar2pano.geometry.stitching import Camera
from lidar2pano.labels import SEMANTIC_KITTI
from lidar2pano.name_order import sort_names
from lidar2pano.scan import Scan
from lidar2pano.views import View

LAST_CLASS = 0xFFFF
CAMERAS = ("front_camera", "front_left_camera", "left_camera", "back_camera", "right_camera", "front_right_camera")
# From the front camera's optical centre to the LiDAR's, in PandaSet's axes, metres. Fitted: seen from there the points
# of a standing car's scans lie on 64 sharp cones (to about 2 cm), from the frame's own origin on none.
LIDAR_FROM_FRONT = np.array([0.0, -0.047, 0.053])
# The trunk and the roof in the backward image, (u, v) of 960 x 540: unchanged along the drive.
VEHICLE_LINES = {"back_camera": ((0, 428), (240, 416), (480, 410), (720, 418), (959, 438))}
# PandaSet's classes by the name of the nearest of SemanticKITTI; its vegetation holds trunks, its ground everything
# but roads. Classes without a counterpart, poles included (they are among the static objects), are unlabeled.
CLASSES = {
    "Smoke": "unlabeled", "Exhaust": "unlabeled", "Spray or rain": "unlabeled", "Reflection": "unlabeled",
    "Vegetation": "vegetation", "Ground": "other-ground", "Road": "road", "Lane Line Marking": "road",
    "Stop Line Marking": "road", "Other Road Marking": "road", "Sidewalk": "sidewalk", "Driveway": "sidewalk",
    "Car": "car", "Pickup Truck": "truck", "Medium-sized Truck": "truck", "Semi-truck": "truck",
    "Towed Object": "other-vehicle", "Motorcycle": "motorcycle",
    "Other Vehicle - Construction Vehicle": "other-vehicle", "Other Vehicle - Uncommon": "other-vehicle",
    "Other Vehicle - Pedicab": "other-vehicle", "Emergency Vehicle": "other-vehicle", "Bus": "other-vehicle",
    "Personal Mobility Device": "other-vehicle", "Motorized Scooter": "motorcycle", "Bicycle": "bicycle",
    "Train": "other-vehicle", "Trolley": "other-vehicle", "Tram / Subway": "other-vehicle", "Pedestrian": "person",
    "Pedestrian with Object": "person", "Animals - Bird": "unlabeled", "Animals - Other": "unlabeled",
    "Pylons": "unlabeled", "Road Barriers": "fence", "Signs": "traffic-sign", "Cones": "unlabeled",
    "Construction Signs": "traffic-sign", "Temporary Construction Barriers": "fence", "Rolling Containers": "unlabeled",
    "Building": "building", "Other Static Object": "unlabeled",
}  # fmt: skip


class PandasetFrame(SurroundFrame):
    """A frame by its root and its name, "<seq>/NNNNNN"."""

    front = CAMERAS[0]

    def __init__(self, root: Path, view: View, name: str) -> None:
        super().__init__(name, view)
        self.root: Path = root
        sequence, _, self.stem = name.partition("/")
        self.folder = root / "sequences" / sequence

    @cached_property
    def calib(self) -> tuple[Path, Mapping[str, Any]]:
        """The file of calibrations and pose, and its content."""
        path = self.folder / "calib" / f"{self.stem}.json"
        content = read_json(path)
        cameras = content.get("cameras") if isinstance(content, dict) else None
        if not isinstance(cameras, dict) or self.front not in cameras:
            raise InputError(f"{path}: has no cameras with {self.front!r}; take the file from the data set")
        return path, content

    @cached_property
    def T_sensor_file(self) -> np.ndarray:
        """(4, 4): PandaSet's frame -> ours, whose origin is the LiDAR."""
        path, content = self.calib
        mount = read_motion(path, content["cameras"][self.front], "cam_from_lidar")
        to_lidar = np.eye(4)
        to_lidar[:3, 3] = mount[:3, :3].T @ mount[:3, 3] - LIDAR_FROM_FRONT
        return FROM_RIGHT_FORWARD @ to_lidar

    @cached_property
    def camera_names(self) -> tuple[str, ...]:
        """See SurroundFrame."""
        _, content = self.calib
        return tuple(name for name in CAMERAS if name in content["cameras"])

    def camera_file(self, name: str) -> Path:
        """See SurroundFrame."""
        return self.folder / name / f"{self.stem}.jpg"

    def camera(self, name: str) -> Camera:
        """See SurroundFrame."""
        calib, content = self.calib
        camera, path = content["cameras"][name], self.camera_file(name)
        if not isinstance(camera, dict):
            raise InputError(f"{calib}: camera {name} is no object; take the file from the data set")
        T_camera_sensor = read_motion(calib, camera, "cam_from_lidar") @ np.linalg.inv(self.T_sensor_file)
        image = read_camera(path, camera_matrix(calib, camera)[0], T_camera_sensor, VEHICLE_LINES.get(name, ()))
        if list(image.calibration.size) != camera.get("size"):
            raise InputError(f"{path}: is not of the size that {calib.name} gives; take both from the data set")
        return image

    @cached_property
    def whole_scan(self) -> Scan:
        """See SurroundFrame."""
        scan = read_bin(self.folder / "velodyne" / f"{self.stem}.bin")
        return replace(scan, xyz=moved(scan.xyz, self.T_sensor_file), name=self.name)

    @cached_property
    def pose(self) -> np.ndarray:
        """See Frame."""
        path, content = self.calib
        return read_motion(path, content, "world_from_lidar") @ np.linalg.inv(self.T_sensor_file)

    @cached_property
    def point_labels(self) -> np.ndarray:
        """See Frame."""
        path = self.folder / "labels_pandaset" / f"{self.stem}.label"
        data = read_input(path, "complete the data set", MOST_BYTES)
        ids = np.frombuffer(data[: len(data) // 4 * 4], "<u4")
        if len(ids) != len(self.whole_scan):
            points = len(self.whole_scan)
            raise InputError(f"{path}: has {len(ids)} labels, but its scan {points} points; pair them again")
        table = class_table(self.root / "classes.json")
        if ids.max(initial=0) >= len(table):
            raise InputError(f"{path}: holds class {ids.max()}, which classes.json does not name; complete that file")
        return table[ids]


def frames(root: Path, split: str, view: View) -> FrameList[Frame]:
    """Return frames of a split, in time: "all", or the name of a sequence. InputError if there is none."""
    folder = root / "sequences"
    sequences = sort_names(path.name for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
    if not sequences:
        raise InputError(f"{root}: has no sequences/; name the root of a PandaSet in this layout")
    if split not in ("all", *sequences):
        raise InputError(f"{root}: has no split {split!r}" + closest(split, ("all", *sequences)))
    open_frame = partial(PandasetFrame, root, view)
    names = scan_names(sequences if split == "all" else [split], lambda sequence: folder / sequence / "velodyne")
    if not names:
        raise InputError(f"{root}: split {split!r} has no scan (sequences/*/velodyne/*.bin); complete the data")
    return FrameList((name, open_frame) for name in names)


def class_table(path: Path) -> np.ndarray:
    """Return look-up table (K,) int64 from ids of classes.json to those of SEMANTIC_KITTI; 0 for ids without a name.

    InputError if the file is missing or damaged, or names a class not in CLASSES.
    """
    content = read_json(path)
    try:
        names = {int(index): str(name) for index, name in content.items()}
    except (AttributeError, ValueError) as error:
        raise InputError(f"{path}: must be an object of class id -> name; take the file from the data set") from error
    if strange := [index for index in names if not 0 <= index <= LAST_CLASS]:
        raise InputError(
            f"{path}: class {strange[0]} is out of range (0 to {LAST_CLASS}); take the file from the data set"
        )
    table = np.zeros(max(names, default=0) + 1, dtype=np.int64)
    for index, name in names.items():
        if name not in CLASSES:
            raise InputError(f"{path}: class {name!r} is not known" + closest(name, CLASSES))
        table[index] = SEMANTIC_KITTI.id_of(CLASSES[name])
    return table
