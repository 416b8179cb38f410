"""KITTI-360 (Liao et al. 2022, CC BY-NC-SA 3.0): HDL-64E scans, the left perspective camera, its labels, and poses.

ROOT/data_3d_raw/<seq>/velodyne_points/data/N.bin, data_2d_raw/<seq>/image_00/data_rect/N.png,
data_2d_semantics/train/<seq>/image_00/semantic/N.png, data_poses/<seq>/poses.txt and
calibration/{perspective,calib_cam_to_velo,calib_cam_to_pose}.txt, N of ten digits. Frames are "<seq>/N". Points have no
labels here: those of the data set are of scans accumulated over seconds. With the fisheye cameras to the left and
right, data_2d_raw/<seq>/image_{02,03}/data_rgb/N.png and calibration/image_{02,03}.yaml, a panorama is stitched.
Formats: the data set's documentation, and kitti360scripts/{helpers/project.py, viewer/kitti360Viewer3DRaw.py}.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from lidar2pano.bounded_files import MOST_CALIBRATION_BYTES, read_input
from lidar2pano.calibration import Calibration, LensCalibration, read_calib, read_rigid
from lidar2pano.data.cache import cached_by_files
from lidar2pano.data.camera_files import calibration_of
from lidar2pano.data.frames import (
    IGNORE,
    FrameList,
    PanoramaGroundTruth,
    listed_names,
    listed_splits,
    names_with_scans,
    scan_names,
)
from lidar2pano.data.labelled_images import TRAIN_IDS
from lidar2pano.data.poses import read_poses
from lidar2pano.data.surround import SurroundFrame
from lidar2pano.errors import InputError, closest
from lidar2pano.formats.image_files import image_size, read_image
from lidar2pano.formats.scan_files import read_bin
from lidar2pano.formats.yaml_files import read_document
from lidar2pano.geometry.stitching import Camera
from lidar2pano.labels import CITYSCAPES
from lidar2pano.name_order import sort_names
from lidar2pano.scan import Scan
from lidar2pano.views import View

SCANS = "data_3d_raw"
CAMERA = "image_00"
FISHEYES = ("image_02", "image_03")  # to the left and to the right
REACH_DEG = 185 / 2  # of the fisheyes' axes: "roughly 185 degrees", says issue 39 of autonomousvision/kitti360Scripts
LENS = ("xi", "k1", "k2", "p1", "p2", "gamma1", "gamma2", "u0", "v0", "image_width", "image_height")
LARGEST_COEFFICIENT = 100.0  # of a lens; the data set's are below 5
LISTS = "data_2d_semantics/train/2013_05_28_drive_{}_frames.txt"  # the data set's own lists of labelled images
FILES = ("perspective.txt", "calib_cam_to_velo.txt", "calib_cam_to_pose.txt")
LABEL_IDS = 45
# Cityscapes' label ids, and KITTI-360's beyond them (kitti360scripts/helpers/labels.py), as train ids.
LABELS = TRAIN_IDS.copy()
LABELS[34:] = IGNORE
for _beyond, _name in {34: "building", 35: "fence", 37: "pole"}.items():  # garage, gate, smallpole
    LABELS[_beyond] = CITYSCAPES.id_of(_name)


class Kitti360Frame(SurroundFrame):
    """A frame by its root and its name, "<seq>/NNNNNNNNNN".

    view  the raster of its panorama, whose origin becomes the perspective camera's centre.
    The panorama, which needs all three images and the calibrations, has no labels; its depths are the scan's alone.
    """

    front, camera_names = CAMERA, ()  # its images are taken whole, ahead or stitched

    def __init__(self, root: Path, view: View, name: str) -> None:
        super().__init__(name, view)
        self.root: Path = root
        self.sequence, _, self.stem = name.partition("/")

    @property
    def scan_file(self) -> Path:
        """The file of the scan."""
        return _scans(self.root, self.sequence) / f"{self.stem}.bin"

    @property
    def image_file(self) -> Path:
        """The file of the image; it may be missing."""
        return self.root / "data_2d_raw" / self.sequence / CAMERA / "data_rect" / f"{self.stem}.png"

    @property
    def fisheye_files(self) -> Mapping[str, Path]:
        """The files of the fisheye cameras' images; any may be missing."""
        folder = self.root / "data_2d_raw" / self.sequence
        return {name: folder / name / "data_rgb" / f"{self.stem}.png" for name in FISHEYES}

    @property
    def labels_file(self) -> Path:
        """The file of the image's labels; only a part of the images has one."""
        return self.root / "data_2d_semantics" / "train" / self.sequence / CAMERA / "semantic" / f"{self.stem}.png"

    @property
    def source_files(self) -> tuple[Path, ...]:
        """See Frame."""
        own = self.scan_file, self.image_file, self.labels_file, *self.fisheye_files.values()
        return (*own, self._poses_file, *_calibration_files(self.root), *_lens_files(self.root))

    @property
    def _poses_file(self) -> Path:
        return self.root / "data_poses" / self.sequence / "poses.txt"

    @cached_property
    def scan(self) -> Scan:
        """See Frame."""
        return replace(read_bin(self.scan_file), name=self.name)

    @cached_property
    def image(self) -> np.ndarray | None:
        """See Frame."""
        return None if self.calibration is None or not self.image_file.is_file() else read_image(self.image_file, "RGB")

    @cached_property
    def camera_labels(self) -> np.ndarray | None:
        """See Frame."""
        if self.calibration is None or not self.labels_file.is_file():
            return None
        ids = read_image(self.labels_file)
        if ids.ndim != 2 or ids.dtype != np.uint8 or ids.max() >= LABEL_IDS:
            raise InputError(f"{self.labels_file}: holds no label ids of KITTI-360 (0 to {LABEL_IDS - 1}); replace it")
        return LABELS[ids]

    @cached_property
    def calibration(self) -> Calibration | None:
        """See Frame; None if there is neither an image nor labels."""
        files = [path for path in (self.image_file, self.labels_file) if path.is_file()]
        if not files:
            return None
        camera, _ = calibration(self.root)
        for path in files:
            _check_size(path, camera.size, FILES[0])
        return camera

    @cached_property
    def cameras(self) -> Mapping[str, Camera]:
        """The images of the three cameras by name; InputError if one is missing or damaged, or not of its size."""
        image, camera = self.require("image", "calibration")
        cameras = {CAMERA: Camera(image=image, calibration=camera)}
        lenses = fisheye_calibrations(self.root)
        for name, path in self.fisheye_files.items():
            _check_size(path, lenses[name].size, f"{name}.yaml")
            cameras[name] = Camera(image=read_image(path, "RGB"), calibration=lenses[name])
        return cameras

    @cached_property
    def panorama_labels(self) -> None:
        """See Frame: there are none, and nothing is stitched to find out."""
        return

    def panorama_for(self, view: View) -> PanoramaGroundTruth | None:
        """See Frame; None if an image or the calibration of one of the three cameras is missing."""
        return super().panorama_for(view) if self._absent() is None else None

    def _absent(self) -> Path | None:
        """Return the first missing file of the panorama, None if all are there."""
        files = (self.image_file, *self.fisheye_files.values(), *_lens_files(self.root))
        return next((path for path in files if not path.is_file()), None)

    @cached_property
    def pose(self) -> np.ndarray | None:
        """See Frame; None if poses.txt has none."""
        path = self._poses_file
        T_world_ego = _poses(path).get(int(self.stem)) if path.is_file() else None
        return None if T_world_ego is None else T_world_ego @ calibration(self.root)[1]

    def missing(self, part: str) -> str:
        """See Frame."""
        return {
            "point_labels": f"{self.name}: KITTI-360 has no labels of single scans; name a segmenter that labels them"
            " with --set options.segmenter=FILE",
            "image": f"{self.image_file}: is missing; download the perspective images",
            "calibration": f"{self.image_file}: is missing, and so are its labels; download the perspective images",
            "camera_labels": f"{self.labels_file}: is missing; choose the split train or val, whose images are"
            " labelled",
            "panorama": f"{self._absent()}: is missing; download the perspective and the fisheye images and the"
            " calibration",
            "panorama_labels": f"{self.name}: KITTI-360 has no labels all around; choose the split train or val, whose"
            f" {CAMERA} is labelled",
            "pose": f"{self._poses_file}: has no line for frame {int(self.stem)}; choose another split",
        }.get(part) or super().missing(part)


def frames(root: Path, split: str, view: View) -> FrameList[Kitti360Frame]:
    """Return frames of a split. InputError if there is none.

    split  of splits.json; "train" or "val": the data set's own lists of labelled images, those with a
           scan; "all", or the name of a sequence: all scans.
    view   the raster of stitched panoramas.
    """
    sequences = sort_names(path.name for path in (root / SCANS).iterdir() if path.is_dir())
    scans = partial(_scans, root)
    if split in listed_splits(root / "splits.json"):
        names = listed_names(root / "splits.json", split, "SEQUENCE/NNNNNNNNNN", _is_frame_name)
        names = list(names_with_scans(names, scans, split))
    elif split in ("train", "val"):
        names = list(names_with_scans(_labelled(root, split), scans))
    elif split in ("all", *sequences):
        names = [*filter(_is_frame_name, scan_names(sequences if split == "all" else [split], scans))]
    else:
        raise InputError(f"{root}: no split {split!r}" + closest(split, ("train", "val", "all", *sequences)))
    if not names:
        raise InputError(f"{root}: split {split!r} has no scan ({SCANS}/*/velodyne_points/data); complete the data set")
    open_frame = partial(Kitti360Frame, root, view)
    return FrameList((name, open_frame) for name in names)


def _check_size(path: Path, size: tuple[int, int], source: str) -> None:
    """Raise InputError if an image is not of the calibration's size."""
    width, height = image_size(path)
    if (width, height) != size:
        raise InputError(
            f"{path}: is {width}x{height}, but {source} says {size[0]}x{size[1]}; take both from the data set"
        )


def _calibration_files(root: Path) -> list[Path]:
    return [root / "calibration" / name for name in FILES]


def _lens_files(root: Path) -> list[Path]:
    return [root / "calibration" / f"{name}.yaml" for name in FISHEYES]


@cached_by_files(_calibration_files)
def calibration(root: Path) -> tuple[Calibration, np.ndarray]:
    """Return the left perspective camera, rectified, and (4, 4) float64 LiDAR -> the frame of poses.txt, the vehicle's.

    Raises InputError if a file of ROOT/calibration is missing or damaged.
    """
    perspective, cam_to_velo, cam_to_pose = _calibration_files(root)
    T_camera_lidar = np.linalg.inv(read_rigid(cam_to_velo))
    return read_calib(perspective, None, camera=0), read_rigid(cam_to_pose, CAMERA) @ T_camera_lidar


@cached_by_files(lambda root: [*_calibration_files(root), *_lens_files(root)])
def fisheye_calibrations(root: Path) -> Mapping[str, LensCalibration]:
    """Read calibration/image_*.yaml: the fisheye cameras by name; InputError if a file is missing or damaged."""
    (_, T_ego_lidar), mounts = calibration(root), root / "calibration" / FILES[2]
    lenses = {}
    for name, path in zip(FISHEYES, _lens_files(root), strict=True):
        lenses[name] = _lens(path, np.linalg.inv(read_rigid(mounts, name)) @ T_ego_lidar)
    return lenses


# The files are CamOdoCal's (CataCamera.cc), whose distortion is (k1, k2, p1, p2) of "brown". The data set's own
# project.py leaves out p1 and p2, "for simplicity" (issue 95 there): up to a pixel of 1400 at the rim.
def _lens(path: Path, T_camera_lidar: np.ndarray) -> LensCalibration:
    """Return a fisheye camera by its file."""
    document = read_document(path, "take the file from the data set")
    sections = [document, *document.values()] if isinstance(document, dict) else []
    settings = {key: value for section in sections if isinstance(section, dict) for key, value in section.items()}
    if settings.get("model_type") != "MEI":
        raise InputError(f"{path}: says no 'model_type: MEI'; take the file from the data set")
    try:
        values = [float(settings[name]) for name in LENS]
    except (KeyError, TypeError, ValueError, OverflowError):
        values = [np.nan]
    if not np.isfinite(values).all():
        raise InputError(f"{path}: {', '.join(LENS)} must be finite numbers; take the file from the data set")
    if min(values[9:]) < 1 or not all(value.is_integer() for value in values[9:]):
        raise InputError(
            f"{path}: image_width and image_height are no size of an image; take the file from the data set"
        )
    if values[0] < 0 or max(map(abs, values[:5])) > LARGEST_COEFFICIENT:
        raise InputError(f"{path}: xi, k1, k2, p1 and p2 are no lens's; take the file from the data set")
    camera = {"K": [values[0], *values[5:9]], "D": values[1:5], "width": values[9], "height": values[10]}
    lens = calibration_of(path, camera, path, None, T_camera_lidar)
    assert isinstance(lens, LensCalibration), "five numbers of K begin with xi"
    return replace(lens, reach_deg=REACH_DEG)


@cached_by_files(lambda path: [path])
def _poses(path: Path) -> dict[int, np.ndarray]:
    """Return frame -> (4, 4) float64 pose of the vehicle's frame in the world, metres."""
    lines = read_poses(path, 13, "a frame's number and 12 numbers a line, as KITTI-360 does")
    lines = lines[np.isfinite(lines).all(1)]  # else it is unknown
    poses = np.tile(np.eye(4), (len(lines), 1, 1))
    poses[:, :3] = lines[:, 1:].reshape(-1, 3, 4)
    return dict(zip(lines[:, 0].astype(int).tolist(), poses, strict=True))


def _scans(root: Path, sequence: str) -> Path:
    return root / SCANS / sequence / "velodyne_points" / "data"


def _is_frame_name(name: str) -> bool:
    sequence, _, stem = name.partition("/")
    return bool(sequence) and stem.isdecimal()


def _labelled(root: Path, split: str) -> list[str]:
    """Return names in the list of labelled images, whose lines begin with .../SEQ/image_00/data_rect/N.png."""
    path = root / LISTS.format(split)
    if not path.is_file():
        raise InputError(
            f"{path}: is missing, which says what the split {split!r} is; download the semantics, or write splits.json"
        )
    text = read_input(path, "complete the data set", MOST_CALIBRATION_BYTES).decode("utf-8", "replace")
    images = [Path(line.split()[0]).parts for line in text.splitlines() if line.strip()]
    if not all(len(parts) >= 4 for parts in images):
        raise InputError(f"{path}: must have lines .../SEQUENCE/{CAMERA}/data_rect/N.png; take it from the data set")
    names = (f"{sequence}/{Path(file).stem}" for *_, sequence, camera, _, file in images if camera == CAMERA)
    return [name for name in names if _is_frame_name(name)]
