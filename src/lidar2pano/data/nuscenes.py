"""nuScenes in its official layout (Caesar et al. 2020, CC BY-NC-SA 4.0), with nuScenes-lidarseg if it is there.

ROOT/v1.0-{mini,trainval,test}/*.json (tables), samples/LIDAR_TOP/*.pcd.bin, samples/CAM_*/*.jpg and
lidarseg/<version>/<token>_lidarseg.bin (uint8 a point), whose ids category.json names. Frames are the samples, two a
second, "<scene>/NNNNNN" by their number in the scene. ROOT/splits.json may list splits of scenes or of frames.
Or single samples: ROOT/info.json lists them in the form of mmdetection3d's info files (`data_list`), images and sweeps
lie beside it. The LiDAR has 32 beams, x to the right and y forward.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano.bounded_files import read_input
from lidar2pano.calibration import Calibration
from lidar2pano.data.cache import cached_by_files
from lidar2pano.data.camera_files import camera_matrix, read_motion
from lidar2pano.data.frames import Frame, FrameList, listed_names, listed_splits
from lidar2pano.data.nuscenes_tables import CAMERAS, CHANNELS, LIDAR, NuscenesIndex, nuscenes_index, versions
from lidar2pano.data.surround import FROM_RIGHT_FORWARD, SurroundFrame, moved, read_camera
from lidar2pano.errors import InputError, closest
from lidar2pano.formats.image_files import image_size
from lidar2pano.formats.json_files import read_json
from lidar2pano.formats.scan_files import MOST_BYTES
from lidar2pano.geometry.stitching import Camera
from lidar2pano.labels import SEMANTIC_KITTI
from lidar2pano.scan import Scan
from lidar2pano.views import View

VALUES = 5  # float32 a point: x y z intensity ring
BRIGHTEST = 255  # intensity
# The lid of the boot in the backward image, (u, v) of 1600 x 900.
VEHICLE_LINES = {"CAM_BACK": ((0, 900), (184, 888), (800, 850), (1420, 888), (1599, 900))}
FROM_OURS = np.linalg.inv(FROM_RIGHT_FORWARD)
MINI, TRAINVAL, TEST = "v1.0-mini", "v1.0-trainval", "v1.0-test"
# Numbers of scenes, first to last, of the devkit's splits (python-sdk/nuscenes/utils/splits.py). The 700 scenes of
# `train` are the others of v1.0-trainval.
VAL = (
    (3, 3), (12, 18), (35, 36), (38, 39), (92, 110), (221, 221), (268, 278), (329, 332), (344, 346), (519, 524),
    (552, 565), (625, 627), (629, 630), (632, 638), (770, 771), (775, 775), (777, 778), (780, 784), (794, 800),
    (802, 802), (904, 917), (919, 931), (962, 963), (966, 969), (971, 972), (1059, 1073),
)  # fmt: skip
MINI_VAL = ((103, 103), (916, 916))
# split -> version, numbers of scenes, whether it has those or the others
SPLITS = {
    "train": (TRAINVAL, VAL, False),
    "val": (TRAINVAL, VAL, True),
    "mini_train": (MINI, MINI_VAL, False),
    "mini_val": (MINI, MINI_VAL, True),
    "test": (TEST, (), False),
}
# lidarseg's classes (docs/instructions_lidarseg.md of the devkit) by the name of the nearest of SemanticKITTI; what the
# benchmark ignores (the devkit's eval/lidarseg/utils.py) is unlabeled. Its man-made things are buildings for the most
# part, but also walls, poles and signs; its bicycles and motorcycles have their riders on them.
CLASSES = {
    "noise": "unlabeled", "animal": "unlabeled", "human.pedestrian.adult": "person", "human.pedestrian.child": "person",
    "human.pedestrian.construction_worker": "person", "human.pedestrian.personal_mobility": "unlabeled",
    "human.pedestrian.police_officer": "person", "human.pedestrian.stroller": "unlabeled",
    "human.pedestrian.wheelchair": "unlabeled", "movable_object.barrier": "fence",
    "movable_object.debris": "unlabeled", "movable_object.pushable_pullable": "unlabeled",
    "movable_object.trafficcone": "unlabeled", "static_object.bicycle_rack": "unlabeled", "vehicle.bicycle": "bicycle",
    "vehicle.bus.bendy": "other-vehicle", "vehicle.bus.rigid": "other-vehicle", "vehicle.car": "car",
    "vehicle.construction": "other-vehicle", "vehicle.emergency.ambulance": "unlabeled",
    "vehicle.emergency.police": "unlabeled", "vehicle.motorcycle": "motorcycle", "vehicle.trailer": "other-vehicle",
    "vehicle.truck": "truck", "flat.driveable_surface": "road", "flat.other": "other-ground",
    "flat.sidewalk": "sidewalk", "flat.terrain": "terrain", "static.manmade": "building", "static.other": "unlabeled",
    "static.vegetation": "vegetation", "vehicle.ego": "unlabeled",
}  # fmt: skip
SCENE = re.compile(r"scene-\d{4}(/\d{6})?")


class NuscenesSample(SurroundFrame):
    """A sample of nuScenes by its name, "<scene>/NNNNNN".

    Cameras measure up to 50 ms before or after the LiDAR; how far the vehicle drove meanwhile is in their calibrations,
    so static surfaces agree with the scan.
    """

    front, camera_names = CAMERAS[0], CAMERAS

    def __init__(self, index: NuscenesIndex, view: View, name: str) -> None:
        super().__init__(name, view)
        scene, _, number = name.partition("/")
        self.index, self.row, self.root = index, index.samples(scene)[int(number)], index.root

    def file(self, channel: str) -> Path:
        """Return the file of a sensor."""
        return self.index.root / self.index.files[self.row, CHANNELS.index(channel)].decode()

    @property
    def scan_file(self) -> Path:
        """The file of the scan."""
        return self.file(LIDAR)

    @property
    def labels_file(self) -> Path:
        """The file of the points' labels; it may be missing."""
        token = self.index.tokens[self.row].decode()
        return self.index.root / "lidarseg" / self.index.version / f"{token}_lidarseg.bin"

    @cached_property
    def pose(self) -> np.ndarray:
        """See Frame."""
        return self.index.T_world_sensor(self.row, CHANNELS.index(LIDAR)) @ FROM_OURS

    @cached_property
    def calibration(self) -> Calibration:
        """See Frame; no image is read for it beyond its header."""
        K, T_camera_lidar = self._mount(self.front)
        return Calibration(K=K, T_camera_lidar=T_camera_lidar, size=image_size(self.file(self.front)))

    def camera_file(self, name: str) -> Path:
        """See SurroundFrame."""
        return self.file(name)

    def camera(self, name: str) -> Camera:
        """See SurroundFrame."""
        return read_camera(self.file(name), *self._mount(name), VEHICLE_LINES.get(name, ()))

    def _mount(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """K and T_camera_lidar of a camera: from the scan to the world, and to the camera when it took its image."""
        channel = CHANNELS.index(name)
        T_world_camera = self.index.T_world_sensor(self.row, channel)
        return self.index.K[self.index.sensors[self.row, channel]], np.linalg.inv(T_world_camera) @ self.pose

    @cached_property
    def whole_scan(self) -> Scan:
        """See SurroundFrame."""
        return read_sweep(self.scan_file, self.name)

    @cached_property
    def point_labels(self) -> np.ndarray | None:
        """See Frame; None if nuScenes-lidarseg is not there."""
        path = self.labels_file
        if not path.is_file():
            return None
        ids = np.frombuffer(read_input(path, "complete the data set", MOST_BYTES), np.uint8)
        if len(ids) != (points := len(self.whole_scan)):
            raise InputError(f"{path}: has {len(ids)} labels, but its scan {points} points; pair them again")
        categories = self.index.root / self.index.version / "category.json"
        table = class_table(categories)
        if (strange := table[ids] < 0).any():
            raise InputError(
                f"{path}: holds class {ids[strange][0]}, which {categories.name} does not name; replace it"
            )
        return table[ids]

    def missing(self, part: str) -> str:
        """See Frame."""
        if part in ("point_labels", "panorama_labels"):
            return f"{self.labels_file}: is missing; download nuScenes-lidarseg into the data set's folder"
        return super().missing(part)


class InfoFrame(SurroundFrame):
    """An entry of `data_list` in the file `info`; its name is "nuscenes/NNNNNN", by the sample's number."""

    front = "CAM_FRONT"

    def __init__(self, info: Path, view: View, entries: Mapping[str, Mapping[str, Any]], name: str) -> None:
        super().__init__(name, view)
        self.info, self.entry, self.root = info, entries[name], info.parent

    @cached_property
    def camera_names(self) -> tuple[str, ...]:
        """See SurroundFrame."""
        cameras = self._part("images")
        if self.front not in cameras:
            raise InputError(
                f"{self.info}: sample {self.name} has no camera {self.front}; take the file from the data set"
            )
        return tuple(cameras)

    def camera_file(self, name: str) -> Path:
        """See SurroundFrame."""
        return self._file(self._part("images")[name], "img_path")

    def camera(self, name: str) -> Camera:
        """See SurroundFrame."""
        camera = self._part("images")[name]
        return read_camera(
            self.camera_file(name),
            camera_matrix(self.info, camera)[0],
            read_motion(self.info, camera, "lidar2cam") @ FROM_OURS,
            VEHICLE_LINES.get(name, ()),
        )

    @property
    def scan_file(self) -> Path:
        """The file of the scan."""
        return self._file(self._part("lidar_points"), "lidar_path")

    @cached_property
    def whole_scan(self) -> Scan:
        """See SurroundFrame."""
        return read_sweep(self.scan_file, self.name)

    @cached_property
    def pose(self) -> np.ndarray:
        """See Frame."""
        ego = read_motion(self.info, self.entry, "ego2global")
        return ego @ read_motion(self.info, self._part("lidar_points"), "lidar2ego") @ FROM_OURS

    def _part(self, name: str) -> Mapping[str, Any]:
        part = self.entry.get(name)
        if not isinstance(part, dict):
            raise InputError(f"{self.info}: sample {self.name} has no {name!r}; take the file from the data set")
        return part

    def _file(self, part: Any, name: str) -> Path:  # noqa: ANN401 of a JSON file
        if not isinstance(part, dict) or not isinstance(part.get(name), str):
            raise InputError(f"{self.info}: sample {self.name} has no {name!r}; take the file from the data set")
        return self.info.parent / part[name]


def frames(root: Path, split: str, view: View) -> FrameList[Frame]:
    """Return frames of a split, scene by scene in time. InputError if there is none.

    split  of splits.json, one of SPLITS, a version's name or if there is only one version, "all", or a scene's name.
    """
    samples = _listed(root, split) if split in listed_splits(root / "splits.json") else _official(root, split)
    if not samples:
        raise InputError(f"{root}: split {split!r} has no sample; complete the data set")
    return FrameList(
        (f"{scene}/{number:06d}", partial(NuscenesSample, index, view))
        for index, scene, numbers in samples
        for number in numbers
    )


def info_frames(root: Path, split: str, view: View) -> FrameList[InfoFrame]:
    """Return the samples of info.json, in its order; InputError for a split other than "all"."""
    info = root / "info.json"
    content = read_json(info, nan=True)
    entries = content.get("data_list") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"{info}: has no list 'data_list' of samples; name a folder with nuScenes' info file")
    if split != "all":
        raise InputError(f"{root}: has no split {split!r}" + closest(split, ("all",)))
    if not entries:
        raise InputError(f"{info}: lists no sample; complete the data set")
    try:
        named = {f"nuscenes/{int(entry['sample_idx']):06d}": entry for entry in entries}
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{info}: has a sample without a number 'sample_idx'; take the file from the data set"
        ) from error
    open_frame = partial(InfoFrame, info, view, named)
    return FrameList((name, open_frame) for name in named)


def frame_of(scan_file: Path, view: View) -> NuscenesSample | InfoFrame | None:
    """Return the sample of a sweep, by its file's place in the data set; None if it belongs to none."""
    if (scan_file.parent / "info.json").is_file():
        entries = info_frames(scan_file.parent, "all", view)
        return next((frame for frame in entries if frame.scan_file.name == scan_file.name), None)
    root = scan_file.parents[min(2, len(scan_file.parents) - 1)]
    if scan_file.parent.name != LIDAR:
        return None
    name = os.fsencode(scan_file.relative_to(root).as_posix())
    for version in versions(root):
        index = nuscenes_index(root, version)
        for row in (index.files[:, CHANNELS.index(LIDAR)] == name).nonzero()[0].tolist():
            scene = int(np.searchsorted(index.first, row, "right")) - 1
            return NuscenesSample(index, view, f"{index.scenes[scene]}/{row - int(index.first[scene]):06d}")
    return None


def read_sweep(path: Path, name: str) -> Scan:
    """Read a .pcd.bin (x y z intensity ring, float32) in our sensor frame, remission in [0, 1].

    InputError if the file is missing, empty or not a whole number of points.
    """
    data = read_input(path, "complete the data set", MOST_BYTES)
    if not data or len(data) % (4 * VALUES):
        raise InputError(f"{path}: {len(data)} bytes are no whole number of points ({4 * VALUES} each); replace it")
    points = np.frombuffer(data, dtype="<f4").reshape(-1, VALUES)
    remission = (points[:, 3] / np.float32(BRIGHTEST)).clip(0, 1)
    return Scan(xyz=moved(points[:, :3], FROM_RIGHT_FORWARD), remission=remission, name=name)


@cached_by_files(lambda path: [path])
def class_table(path: Path) -> np.ndarray:
    """Return look-up table (256,) int64 from lidarseg's ids to those of SEMANTIC_KITTI; -1 for ids without a name.

    InputError if category.json is missing, damaged or without ids, or names a class not in CLASSES.
    """
    rows = read_json(path)
    table = np.full(256, -1)
    for row in rows if isinstance(rows, list) else [None]:
        name, index = (row.get("name"), row.get("index")) if isinstance(row, dict) else (None, None)
        if not isinstance(name, str) or type(index) is not int or not 0 <= index < len(table):
            raise InputError(f"{path}: has a row without a name and an index of a class; take nuScenes-lidarseg's file")
        if name not in CLASSES:
            raise InputError(f"{path}: class {name!r} is not known" + closest(name, CLASSES))
        table[index] = SEMANTIC_KITTI.id_of(CLASSES[name])
    return table


# --- splits ---------------------------------------------------------------------------------------------------------

_Samples = list[tuple[NuscenesIndex, str, range]]  # of a scene, by their numbers


def _official(root: Path, split: str) -> _Samples:
    """Return the scenes of a split of the devkit, of a version, or one scene."""
    available = versions(root)
    if split in SPLITS and SPLITS[split][0] in available:
        version, numbers, inside = SPLITS[split]
        listed = {f"scene-{number:04d}" for first, last in numbers for number in range(first, last + 1)}
        return [part for part in _scenes(root, version) if (part[1] in listed) == inside]
    if split in available or (split == "all" and len(available) == 1):
        return _scenes(root, available[0] if split == "all" else split)
    if SCENE.fullmatch(split):
        return [_scene(root, split)]
    names = [name for name, (version, _, _) in SPLITS.items() if version in available]
    names += ["all"] * (len(available) == 1) + available
    raise InputError(f"{root}: no split {split!r} of {' and '.join(available)}" + closest(split, names))


def _listed(root: Path, split: str) -> _Samples:
    """Return the scenes or frames of a split of splits.json."""
    samples = []
    form = "scenes (scene-NNNN) or frames (scene-NNNN/NNNNNN)"
    for name in listed_names(root / "splits.json", split, form, lambda name: SCENE.fullmatch(name) is not None):
        scene, slash, number = name.partition("/")
        index, _, numbers = _scene(root, scene)
        if slash and int(number) not in numbers:
            raise InputError(f"{root}: {scene} has {len(numbers)} samples, none is {name!r}; mend splits.json")
        samples.append((index, scene, range(int(number), int(number) + 1) if slash else numbers))
    return samples


def _scenes(root: Path, version: str) -> _Samples:
    index = nuscenes_index(root, version)
    return [(index, str(scene), range(len(index.samples(scene)))) for scene in index.scenes]


def _scene(root: Path, scene: str) -> tuple[NuscenesIndex, str, range]:
    """Return a scene of the first version with it."""
    for version in versions(root):
        index = nuscenes_index(root, version)
        if rows := index.samples(scene):
            return index, scene, range(len(rows))
    raise InputError(f"{root}: no version has the scene {scene!r}; complete the data set or name another split")
