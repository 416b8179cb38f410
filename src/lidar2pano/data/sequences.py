"""A data set in SemanticKITTI's layout: which frames a split has and where their files lie.

ROOT/sequences/<seq>/{velodyne/NNNNNN.bin, labels/NNNNNN.label, image_2/NNNNNN.png|jpg, camera_labels/NNNNNN.png,
calib.txt}; ROOT/splits.json (split -> ["seq/NNNNNN", ...]), without which SemanticKITTI's own splits hold.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, UnidentifiedImageError

from lidar2pano.calibration import Calibration, read_calib
from lidar2pano.errors import InputError, closest
from lidar2pano.formats.scan_files import read_bin, read_label
from lidar2pano.scan import Scan

# Behley et al. 2019; the paper trains on 00-07, 09, 10, validates on 08 and tests on 11-21.
SEQUENCES: dict[str, tuple[int, ...]] = {
    "train": (0, 1, 2, 3, 4, 5, 6, 7, 9, 10),
    "val": (8,),
    "test": tuple(range(11, 22)),
}
UNSURE = 255  # in camera labels: no class is known


class SampleIndex(NamedTuple):
    """Which sample of a data set is requested, and the seed of its augmentation."""

    index: int
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """Files of one moment. Methods read them and raise InputError where one is missing or damaged.

    folder  ROOT/sequences/<seq>;  stem  NNNNNN.
    """

    folder: Path
    stem: str

    @property
    def name(self) -> str:
        """For messages and outputs: "seq/NNNNNN"."""
        return f"{self.folder.name}/{self.stem}"

    def scan(self) -> Scan:
        """Read the scan, without labels."""
        return read_bin(self.folder / "velodyne" / f"{self.stem}.bin")

    def labels(self, points: int) -> np.ndarray:
        """Read the point labels (N,) int64 of SEMANTIC_KITTI."""
        return read_label(self.folder / "labels" / f"{self.stem}.label", points)

    def image(self) -> np.ndarray:
        """Read the camera image (h, w, 3) uint8 RGB."""
        for suffix in (".png", ".jpg"):
            path = self.folder / "image_2" / f"{self.stem}{suffix}"
            if path.is_file():
                return _pixels(path, "RGB")
        raise InputError(f"{self.folder / 'image_2' / self.stem}.png: no image (.png or .jpg) goes with this scan")

    def camera_labels(self) -> np.ndarray:
        """Read the camera's class ids (h, w) uint8 of CITYSCAPES, UNSURE where nobody knows."""
        path = self.folder / "camera_labels" / f"{self.stem}.png"
        if not path.is_file():
            raise InputError(
                f"{path}: is missing; label the camera's pictures first: lidar2pano prepare ROOT --teacher ..."
            )
        ids = _pixels(path, None)
        if ids.ndim != 2 or ids.dtype != np.uint8:
            raise InputError(f"{path}: is no picture of class ids (one channel of 8 bits); write Cityscapes train ids")
        return ids

    def calibration(self, size: tuple[int, int]) -> Calibration:
        """Read the sequence's calib.txt for an image of `size` (width, height)."""
        return read_calib(self.folder / "calib.txt", size)


def frames_of(root: Path, splits: tuple[str, ...]) -> list[Frame]:
    """Frames of several splits, one after another; a split named twice counts twice.

    "FOLDER:split" is a split of another data set, e.g. a simulated one beside the real one in `root`.
    """
    return [frame for name in splits for frame in frames(*located(root, name))]


def located(root: Path, name: str) -> tuple[Path, str]:
    """Folder of the data set and name of the split that "split" (of `root`) or "FOLDER:split" stands for."""
    folder, colon, split = name.rpartition(":")
    return Path(folder) if colon else root, split


def frames(root: Path, split: str) -> list[Frame]:
    """Frames of a split, in its order.

    Raises InputError when the data set, the split or one of its scans is missing.
    """
    folder = root / "sequences"
    if not folder.is_dir():
        raise InputError(f"{root}: has no folder sequences/; name the root of a data set in SemanticKITTI layout")
    listing = root / "splits.json"
    entries = _listed(listing, split) if listing.is_file() else _by_sequence(folder, split)
    found = [Frame(folder=folder / seq, stem=stem) for seq, stem in (entry.split("/") for entry in entries)]
    for frame in found:
        if not (frame.folder / "velodyne" / f"{frame.stem}.bin").is_file():
            raise InputError(f"{frame.folder}: scan {frame.stem}.bin of split {split!r} is missing; complete the data")
    if not found:
        raise InputError(f"{root}: split {split!r} has no scan")
    return found


def _listed(listing: Path, split: str) -> list[str]:
    try:
        splits = json.loads(listing.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{listing}: is no JSON ({error}); write split -> list of seq/NNNNNN") from error
    if split not in splits:
        raise InputError(f"{listing}: has no split {split!r}" + closest(split, splits))
    return splits[split]


def _by_sequence(folder: Path, split: str) -> list[str]:
    if split not in SEQUENCES:
        raise InputError(f"{folder}: no split {split!r}" + closest(split, SEQUENCES))
    stems = []
    for number in SEQUENCES[split]:
        files = sorted((folder / f"{number:02d}" / "velodyne").glob("*.bin"))
        stems += [f"{number:02d}/{file.stem}" for file in files]
    return stems


def _pixels(path: Path, mode: str | None) -> np.ndarray:
    try:
        with Image.open(path) as picture:
            return np.array(picture.convert(mode) if mode else picture)
    except FileNotFoundError as error:
        raise InputError(f"{path}: is missing; complete the data set") from error
    except (OSError, UnidentifiedImageError) as error:
        raise InputError(f"{path}: is no readable picture; replace it") from error
