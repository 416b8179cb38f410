"""Data sets of camera images and their labels, without scans: Cityscapes' layout, and any folder of images and labels.

Cityscapes   ROOT/leftImg8bit/<split>/<city>/<city>_<drive>_<frame>_leftImg8bit.png and
             ROOT/gtFine/<split>/<city>/<...>_gtFine_labelIds.png or if there is one, ..._gtFine_labelTrainIds.png.
Folder       ROOT/images/<split>/<name>.png|jpg and ROOT/labels/<split>/<name>.png with Cityscapes train ids; if
             images lie in images/ itself, all in it are of the split "train".
Frames have an image and camera labels, so a camera segmenter, vid2vid and a latent painter train on them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from lidar2pano.data.frames import IGNORE, Frame, FrameList, read_train_ids
from lidar2pano.errors import InputError, closest
from lidar2pano.formats.image_files import image_size, read_image
from lidar2pano.labels import CITYSCAPES, CITYSCAPES_IDS
from lidar2pano.name_order import sort_names

IMAGES, FINE = "leftImg8bit", "gtFine"
SUFFIXES = (".png", ".jpg", ".jpeg")
TRAIN_IDS = np.full(256, IGNORE, dtype=np.uint8)  # of label ids; untrained ones are IGNORE
TRAIN_IDS[[CITYSCAPES_IDS.id_of(name) for name in CITYSCAPES.classes]] = np.arange(len(CITYSCAPES))


OpenFrame = Callable[[str], "LabelledImage"]  # name -> frame


class LabelledImage(Frame):
    """A frame by its files: an image, and labels as train ids or (label_ids) Cityscapes' label ids."""

    def __init__(self, root: Path, image: Path, labels: Path, label_ids: bool, name: str) -> None:
        super().__init__(name)
        self.root, self.image_file, self.labels_file, self.label_ids = root, image, labels, label_ids

    @cached_property
    def image(self) -> np.ndarray | None:
        """See Frame."""
        self._check_sizes()
        return read_image(self.image_file, "RGB")

    @cached_property
    def camera_labels(self) -> np.ndarray | None:
        """See Frame."""
        if not self.labels_file.is_file():
            return None
        self._check_sizes()
        if not self.label_ids:
            return read_train_ids(self.labels_file)
        ids = read_image(self.labels_file)
        if ids.ndim != 2 or ids.dtype != np.uint8 or ids.max() >= len(CITYSCAPES_IDS):
            raise InputError(f"{self.labels_file}: holds no label ids of Cityscapes (0 to {len(CITYSCAPES_IDS) - 1})")
        return TRAIN_IDS[ids]

    def _check_sizes(self) -> None:
        """Raise InputError if image and labels differ in size."""
        if self.labels_file.is_file():
            (w, h), (width, height) = image_size(self.image_file), image_size(self.labels_file)
            if (w, h) != (width, height):
                raise InputError(f"{self.labels_file}: is {width}x{height} and its image {w}x{h}; label it again")

    def missing(self, part: str) -> str:
        """See Frame."""
        if part == "camera_labels":
            return f"{self.labels_file}: is missing; complete the labels, or leave {self.image_file.name} out"
        part_name = part.replace("_", " ")
        return f"{self.root}: has images and labels only, no {part_name}; sdnet, vid2vid and latent-painter train on it"


def matches(root: Path) -> bool:
    """Return whether a folder is such a data set."""
    return (root / IMAGES).is_dir() or ((root / "images").is_dir() and (root / "labels").is_dir())


def frames(root: Path, split: str) -> FrameList[LabelledImage]:
    """Return frames of a split, sorted by name; InputError if there is no such split."""
    cityscapes = (root / IMAGES).is_dir()
    folder = root / (IMAGES if cityscapes else "images")
    if (folder / split).is_dir():
        entries = dict(_cityscapes(root, split) if cityscapes else _folder(root, split))
    elif split == "train" and not cityscapes and any(path.suffix.lower() in SUFFIXES for path in folder.iterdir()):
        entries = dict(_folder(root, ""))
    else:
        splits = sort_names(path.name for path in folder.iterdir() if path.is_dir())
        raise InputError(f"{root}: no split {split!r}{closest(split, splits)}")
    if not entries:
        raise InputError(f"{root}: split {split!r} has no image (.png or .jpg); complete the data")
    return FrameList((name, entries[name]) for name in sort_names(entries))


def _cityscapes(root: Path, split: str) -> Iterator[tuple[str, OpenFrame]]:
    for path in (root / IMAGES / split).glob(f"*/*_{IMAGES}.png"):
        stem = path.name.removesuffix(f"_{IMAGES}.png")
        city = root / FINE / split / path.parent.name
        labels = city / f"{stem}_{FINE}_labelTrainIds.png"
        by_id = not labels.is_file()
        if by_id:
            labels = city / f"{stem}_{FINE}_labelIds.png"
        name = f"{path.parent.name}/{stem}"
        yield name, partial(LabelledImage, root, path, labels, by_id)


def _folder(root: Path, split: str) -> Iterator[tuple[str, OpenFrame]]:
    folder, labels = root / "images" / split, root / "labels" / split
    for path in folder.rglob("*"):
        if path.suffix.lower() in SUFFIXES and not path.name.startswith("."):
            inside = path.relative_to(folder).with_suffix(".png")
            name = f"{'.'.join(inside.parts[:-1]) or split or 'train'}/{inside.stem}"
            yield name, partial(LabelledImage, root, path, labels / inside, False)
