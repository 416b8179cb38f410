"""PandaSet as files: Pandar64 scans, six cameras, hand-made point classes (Xiao et al. 2021, CC BY 4.0).

ROOT/sequences/<seq>/{velodyne/NNNNNN.bin, calib/NNNNNN.json, labels_pandaset/NNNNNN.label, <camera>/NNNNNN.jpg};
ROOT/classes.json (id -> name). Its frame has x to the right and y forward, and its origin is not the LiDAR: it lies
below, near the road.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lidar2pano.data.surround import FROM_RIGHT_FORWARD, SurroundFrame, matrix, moved, read_json, read_photo
from lidar2pano.errors import InputError, closest
from lidar2pano.formats.scan_files import read_bin
from lidar2pano.geometry.compose import Photo
from lidar2pano.labels import SEMANTIC_KITTI

CAMERAS = ("front_camera", "front_left_camera", "left_camera", "back_camera", "right_camera", "front_right_camera")
FRONT = CAMERAS[0]
# From the front camera's optical centre to the LiDAR's, in PandaSet's axes, metres. Fitted: seen from there the points
# of a standing car's scans lie on 64 sharp cones (to about 2 cm), from the frame's own origin on none.
LIDAR_FROM_FRONT = np.array([0.0, -0.047, 0.053])
# The trunk and the roof in the backward picture, (u, v) of 960 x 540: what never changes along the drive.
OWN_CAR = {"back_camera": ((0, 428), (240, 416), (480, 410), (720, 418), (959, 438))}
# PandaSet's classes by the name of the nearest of SemanticKITTI; its vegetation holds trunks, its ground what is no
# road. What has no counterpart, poles included (they are among the static objects), is unlabeled.
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


@dataclass(frozen=True, slots=True, kw_only=True)
class PandasetFrame:
    """Files of one moment: `root`, its sequence and the stem NNNNNN."""

    root: Path
    sequence: str
    stem: str

    @property
    def name(self) -> str:
        """For messages and outputs: "seq/NNNNNN"."""
        return f"{self.sequence}/{self.stem}"

    def read(self) -> SurroundFrame:
        """Read everything; InputError where a file is missing, damaged or does not fit the others."""
        folder = self.root / "sequences" / self.sequence
        calib = folder / "calib" / f"{self.stem}.json"
        told = read_json(calib)
        cameras = told.get("cameras") if isinstance(told, dict) else None
        if not isinstance(cameras, dict) or FRONT not in cameras:
            raise InputError(f"{calib}: has no cameras with {FRONT!r}; take the file from the data set")
        mounts = {name: matrix(calib, cameras[name], "cam_from_lidar", (4, 4)) for name in CAMERAS if name in cameras}
        to_ours = _to_ours(mounts[FRONT])
        back = np.linalg.inv(to_ours)
        photos: dict[str, Photo] = {}
        for name, mount in mounts.items():
            K = _camera_matrix(calib, cameras[name])
            path = folder / name / f"{self.stem}.jpg"
            photos[name] = read_photo(path, K, mount @ back, OWN_CAR.get(name, ()))
            if list(photos[name].calibration.size) != cameras[name].get("size"):
                raise InputError(f"{path}: is not of the size that {calib.name} gives; take both from the data set")
        scan = read_bin(folder / "velodyne" / f"{self.stem}.bin")
        label = self._labels(folder / "labels_pandaset" / f"{self.stem}.label", len(scan))
        scan = replace(scan, xyz=moved(scan.xyz, to_ours), label=label, name=self.name)
        pose = matrix(calib, told, "world_from_lidar", (4, 4)) @ back
        return SurroundFrame(name=self.name, scan=scan, photos=photos, front=FRONT, pose=pose)

    def _labels(self, path: Path, points: int) -> np.ndarray:
        """Point labels (N,) int64 of SEMANTIC_KITTI."""
        try:
            ids = np.fromfile(path, dtype="<u4")
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}); complete the data set") from error
        if len(ids) != points:
            raise InputError(f"{path}: has {len(ids)} labels, but its scan {points} points; pair them again")
        table = class_table(self.root / "classes.json")
        if ids.max(initial=0) >= len(table):
            raise InputError(f"{path}: holds class {ids.max()}, which classes.json does not name; complete that file")
        return table[ids]


def pandaset_frames(root: Path, split: str = "all") -> list[PandasetFrame]:
    """Frames of a split, in time: "all", or the name of a sequence. InputError where there is none."""
    folder = root / "sequences"
    sequences = sorted(path.name for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
    if not sequences:
        raise InputError(f"{root}: has no sequences/; name the root of a PandaSet in this layout")
    if split not in ("all", *sequences):
        raise InputError(f"{root}: has no split {split!r}" + closest(split, ("all", *sequences)))
    found = [
        PandasetFrame(root=root, sequence=sequence, stem=path.stem)
        for sequence in sequences
        if split in ("all", sequence)
        for path in sorted((folder / sequence / "velodyne").glob("*.bin"))
    ]
    if not found:
        raise InputError(f"{root}: split {split!r} has no scan (sequences/*/velodyne/*.bin); complete the data")
    return found


def class_table(path: Path) -> np.ndarray:
    """Look-up table (K,) int64 from the ids of classes.json to those of SEMANTIC_KITTI; 0 for ids without a name.

    InputError where the file is missing or damaged, or names a class that CLASSES does not.
    """
    told = read_json(path)
    try:
        names = {int(index): str(name) for index, name in told.items()}
    except (AttributeError, ValueError) as error:
        raise InputError(f"{path}: must be an object of class id -> name; take the file from the data set") from error
    table = np.zeros(max(names, default=0) + 1, dtype=np.int64)
    for index, name in names.items():
        if name not in CLASSES:
            raise InputError(f"{path}: class {name!r} is not known" + closest(name, CLASSES))
        table[index] = SEMANTIC_KITTI.id_of(CLASSES[name])
    return table


def _to_ours(front_mount: np.ndarray) -> np.ndarray:
    """(4, 4): PandaSet's frame -> ours, whose origin is the LiDAR."""
    centre = -front_mount[:3, :3].T @ front_mount[:3, 3] + LIDAR_FROM_FRONT
    to_lidar = np.eye(4)
    to_lidar[:3, 3] = -centre
    return FROM_RIGHT_FORWARD @ to_lidar


def _camera_matrix(path: Path, camera: dict[str, object]) -> np.ndarray:
    K = camera.get("K")
    try:
        fx, fy, cx, cy = (float(K[name]) for name in ("fx", "fy", "cx", "cy"))  # pyright: ignore
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: a camera's K must hold fx, fy, cx and cy; take the file from the data set"
        ) from error
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
