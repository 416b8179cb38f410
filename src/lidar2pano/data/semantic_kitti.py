"""Data sets in SemanticKITTI's layout, simulated worlds among them.

ROOT/sequences/<seq>/{velodyne/NNNNNN.bin, labels/NNNNNN.label, image_2/NNNNNN.png|jpg, camera_labels/NNNNNN.png,
calib.txt, poses.txt}; of worlds also pano/, pano_labels/ and pano_depth/ with NNNNNN.png.
ROOT/splits.json (split -> ["seq/NNNNNN", ...]), else SemanticKITTI's own splits hold.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from lidar2pano.calibration import Calibration, has_camera, read_calib
from lidar2pano.data.frames import (
    Frame,
    FrameList,
    PanoramaGroundTruth,
    listed_names,
    names_with_scans,
    read_train_ids,
    scan_names,
)
from lidar2pano.data.poses import lidar_poses
from lidar2pano.errors import InputError, closest
from lidar2pano.formats.image_files import DEPTH_STEPS, image_size, read_image
from lidar2pano.formats.json_files import read_json
from lidar2pano.formats.scan_files import read_bin, read_label
from lidar2pano.geometry.camera import at_camera
from lidar2pano.scan import Scan
from lidar2pano.views import VIEWS, View

# Behley et al. 2019; the paper trains on 00-07, 09, 10, validates on 08 and tests on 11-21.
SEQUENCES: dict[str, tuple[int, ...]] = {
    "train": (0, 1, 2, 3, 4, 5, 6, 7, 9, 10),
    "val": (8,),
    "test": tuple(range(11, 22)),
    # ours: the training sequences apart from one, for the selection of checkpoints
    "fit": (0, 1, 2, 3, 4, 5, 6, 7, 9),
    "selection": (10,),
}
BYTES_PER_POINT = 16
IMAGE_SUFFIXES = (".png", ".jpg")


class SemanticKittiFrame(Frame):
    """A frame by its files: `folder` is ROOT/sequences/<seq>, `stem` NNNNNN."""

    def __init__(self, folder: Path, stem: str) -> None:
        super().__init__(f"{folder.name}/{stem}")
        self.folder, self.stem = folder, stem
        self.root: Path = folder.parents[1]

    def file(self, part: str, suffix: str = ".png") -> Path:
        """Return the frame's file in the folder `part` of its sequence."""
        return self.folder / part / f"{self.stem}{suffix}"

    @property
    def scan_file(self) -> Path:
        """The file of the scan."""
        return self.file("velodyne", ".bin")

    @property
    def source_files(self) -> tuple[Path, ...]:
        """See Frame."""
        images = (self.file("image_2", suffix) for suffix in IMAGE_SUFFIXES)
        ground_truth = (self.file(part) for part in ("camera_labels", "pano", *_PANORAMA_PARTS))
        of_sequence = self.folder / "calib.txt", self.folder / "poses.txt", self.root / "world.json"
        return (self.scan_file, self.file("labels", ".label"), *images, *ground_truth, *of_sequence)

    @cached_property
    def image_file(self) -> Path | None:
        """The file of the image: PNG or JPEG; None if there is none."""
        return next((path for suffix in IMAGE_SUFFIXES if (path := self.file("image_2", suffix)).is_file()), None)

    @cached_property
    def scan(self) -> Scan:
        """See Frame."""
        return replace(read_bin(self.scan_file), name=self.name)

    @cached_property
    def point_labels(self) -> np.ndarray | None:
        """See Frame; the scan itself is not read for them."""
        return self._labels("labels")

    @cached_property
    def predicted_labels(self) -> np.ndarray | None:
        """See Frame; those by `prepare --labels-folder predicted_labels`."""
        return self._labels("predicted_labels")

    def _labels(self, part: str) -> np.ndarray | None:
        path = self.file(part, ".label")
        if not path.is_file():
            return None
        size = self.scan_file.stat().st_size if self.scan_file.is_file() else 0
        whole = size > 0 and size % BYTES_PER_POINT == 0  # otherwise reading the scan raises the error
        return read_label(path, size // BYTES_PER_POINT if whole else len(self.scan))

    @cached_property
    def image(self) -> np.ndarray | None:
        """See Frame."""
        return None if self.image_file is None or self._size is None else read_image(self.image_file, "RGB")

    @cached_property
    def camera_labels(self) -> np.ndarray | None:
        """See Frame."""
        path = self.file("camera_labels")
        if not path.is_file() or self._size is None:
            return None
        return read_train_ids(path)

    @cached_property
    def _size(self) -> tuple[int, int] | None:
        """(width, height) of image and camera labels, by their headers; InputError if they differ."""
        labels = self.file("camera_labels")
        sizes = [image_size(path) for path in (self.image_file, labels) if path is not None and path.is_file()]
        if sizes and sizes[0] != sizes[-1]:
            (w, h), (width, height) = sizes
            raise InputError(f"{labels}: is {width}x{height} and its image {w}x{h}; label the image again")
        return sizes[0] if sizes else None

    @cached_property
    def calibration(self) -> Calibration | None:
        """See Frame."""
        return self._size and read_calib(self.folder / "calib.txt", self._size)

    @cached_property
    def pose(self) -> np.ndarray | None:
        """See Frame; the world is the sensor's frame at the sequence's first pose. None if it is unknown."""
        poses = lidar_poses(self.folder)
        pose = None if poses is None else poses.at(self.stem)
        return None if poses is None or pose is None else np.linalg.inv(poses.first()) @ pose

    @cached_property
    def panorama(self) -> PanoramaGroundTruth | None:
        """See Frame; without world.json its rows cover the same directions as VIEWS["panorama"]."""
        if not self.file("pano").is_file():
            return None
        image = read_image(self.file("pano"), "RGB")
        view = _world_view(self.root / "world.json")
        if view is None:
            view = replace(VIEWS["panorama"], rows=image.shape[0], columns=image.shape[1])
        size = (view.rows, view.columns)
        _check(self.file("pano"), image, (*size, 3), np.uint8)
        labels, steps = (self._beside(part, size, dtype) for part, dtype in _PANORAMA_PARTS.items())
        calib = self.folder / "calib.txt"
        return PanoramaGroundTruth(
            view=at_camera(view, read_calib(calib)) if has_camera(calib) else view,
            image=image,
            valid=np.ones(size, dtype=bool),
            labels=labels,
            depth_m=None if steps is None else steps.astype(np.float32) / DEPTH_STEPS,
        )

    @cached_property
    def panorama_labels(self) -> np.ndarray | None:
        """See Frame."""
        path = self.file("pano_labels")
        return read_image(path) if path.is_file() and self.file("pano").is_file() else None

    def _beside(self, part: str, size: tuple[int, int], dtype: type[np.generic]) -> np.ndarray | None:
        path = self.file(part)
        if not path.parent.is_dir():
            return None
        values = read_image(path)
        _check(path, values, size, dtype)
        return values

    def missing(self, part: str) -> str:
        """See Frame."""
        if part in ("panorama_labels", "panorama_depths"):
            return f"{self.name}: its panorama has no labels or no depths; simulate the world again"
        return {
            "point_labels": f"{self.file('labels', '.label')}: is missing; label the scans: lidar2pano prepare ROOT",
            "predicted_labels": f"{self.file('predicted_labels', '.label')}: is missing; let a segmenter label the"
            " scans (lidar2pano prepare ROOT --lidar NAME --labels-folder predicted_labels), name it with"
            " --set options.segmenter=FILE, or train on the data's labels with --set options.segments=data",
            "image": f"{self.file('image_2')}: no image (.png or .jpg) goes with this scan",
            "camera_labels": f"{self.file('camera_labels')}: is missing; label the camera's images first:"
            " lidar2pano prepare ROOT --teacher ...",
            "calibration": f"{self.file('image_2')}: no image (.png or .jpg) goes with this scan, nor camera labels",
            "pose": f"{self.folder / 'poses.txt'}: is missing, or without this frame's pose; write a line of 12 numbers"
            " per frame, as KITTI does",
            "panorama": f"{self.file('pano')}: is missing; only simulated data sets (lidar2pano world) have panoramas",
        }.get(part) or super().missing(part)


_PANORAMA_PARTS: dict[str, type[np.generic]] = {
    "pano_labels": np.uint8,
    "pano_depth": np.uint16,
}


def frames(root: Path, split: str) -> FrameList[SemanticKittiFrame]:
    """Return frames of a split, in its order.

    Raises InputError if the split, or a scan listed in it, is missing; a sequence's folder is listed once.
    """
    folder, listing = root / "sequences", root / "splits.json"

    def scans(sequence: str) -> Path:
        return folder / sequence / "velodyne"

    if listing.is_file():
        names = list(names_with_scans(listed_names(listing, split), scans, split))
    else:
        names = scan_names(sequences_of(folder, split), scans)
    if not names:
        raise InputError(f"{root}: split {split!r} has no scan")
    open_one = partial(open_frame, folder)
    return FrameList((name, open_one) for name in names)


def open_frame(folder: Path, name: str) -> SemanticKittiFrame:
    """Return the frame "seq/NNNNNN" of the data set whose sequences lie in `folder`; nothing is read."""
    sequence, _, stem = name.partition("/")
    return SemanticKittiFrame(folder / sequence, stem)


def sequences_of(folder: Path, split: str) -> list[str]:
    """Return the sequences of one of SemanticKITTI's own splits; InputError for another."""
    if split not in SEQUENCES:
        raise InputError(f"{folder}: no split {split!r}" + closest(split, SEQUENCES))
    return [f"{number:02d}" for number in SEQUENCES[split]]


def _world_view(card: Path) -> View | None:
    """Return the raster of pano/: the first view of a world's card, such as "panorama" or "panorama/2"."""
    if not card.is_file():
        return None
    settings = read_json(card)
    names = settings.get("views") if isinstance(settings, dict) else None
    name, _, part = str(names[0] if isinstance(names, list) and names else "").partition("/")
    if name not in VIEWS or not (part or "1").isdecimal() or int(part or 1) < 1:
        raise InputError(f"{card}: names no view of its panoramas; simulate the world again")
    return VIEWS[name].scaled(1 / int(part or 1))


def _check(path: Path, values: np.ndarray, shape: tuple[int, ...], dtype: type[np.generic]) -> None:
    if values.shape != shape or values.dtype != dtype:
        expected = "x".join(str(length) for length in shape)
        raise InputError(f"{path}: is {values.shape} {values.dtype}, not {expected}; simulate the world again")
