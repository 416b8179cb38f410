"""Frame: the parts of one moment of a data set, read on access; FrameList: the frames of a split, and their names."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, overload

import numpy as np

from lidar2pano.calibration import Calibration
from lidar2pano.errors import InputError, closest
from lidar2pano.formats.image_files import read_image
from lidar2pano.formats.json_files import read_json
from lidar2pano.labels import CITYSCAPES, TABLES
from lidar2pano.name_order import sort_names
from lidar2pano.scan import Scan
from lidar2pano.views import View

IGNORE = 255  # label id of pixels whose class is unknown: they are neither trained nor scored
CITYSCAPES_TO_COMMON15 = np.full(256, IGNORE, dtype=np.uint8)
CITYSCAPES_TO_COMMON15[:19] = TABLES["cityscapes", "common-15"]


class SampleIndex(NamedTuple):
    """One sample of a data set: the number of its frame, and the seed of its augmentation."""

    index: int
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PanoramaGroundTruth:
    """The true panorama on the raster `view` (H rows, W columns; its origin in the scan's frame).

    image    (H, W, 3) uint8 RGB; black if not valid.
    valid    (H, W) bool: the colour is known.
    labels   (H, W) uint8 ids of COMMON15, IGNORE if unknown; None if no pixel's class is known.
    depth_m  (H, W) float32 metres from the view's origin along the ray, 0 if there is none (sky) or it is unknown;
             None if no pixel's depth is known.
    """

    view: View
    image: np.ndarray
    valid: np.ndarray
    labels: np.ndarray | None = None
    depth_m: np.ndarray | None = None


class Frame:
    """One frame of a data set. A part is read on first access and kept as long as the Frame lives; None: there is none.

    name           "seq/NNNNNN", also the scan's.
    scan           in the sensor's frame (x forward, y left, z up), without labels.
    point_labels   (N,) int64 ids of SEMANTIC_KITTI, file order;  predicted_labels: likewise, but a segmenter's.
    calibration    of the (front) camera, for the size of image and camera_labels.
    image          (h, w, 3) uint8 RGB of the camera.
    camera_labels  (h, w) uint8 train ids of CITYSCAPES, IGNORE if unknown.
    pose           (4, 4) float64 T_world_sensor: the sensor's coordinates -> a frame fixed to the world, metres.
    panorama       the true panorama.
    root           the data set's folder, None if the frame comes from nowhere.
    Parts raise InputError if a file is damaged, does not fit the others, or is missing though the others need it.
    """

    root: Path | None = None
    point_labels: np.ndarray | None = None
    predicted_labels: np.ndarray | None = None
    calibration: Calibration | None = None
    image: np.ndarray | None = None
    camera_labels: np.ndarray | None = None
    pose: np.ndarray | None = None
    panorama: PanoramaGroundTruth | None = None

    def __init__(self, name: str, **parts: Any) -> None:  # noqa: ANN401
        self.name = name
        vars(self).update(parts)  # looked up first by cached properties

    @property
    def source_files(self) -> tuple[Path, ...]:
        """Files of the parts but `predicted_labels`, missing ones included; none if the layout does not tell them."""
        return ()

    @cached_property
    def scan(self) -> Scan:
        """See the class."""
        raise InputError(self.missing("scan"))

    @cached_property
    def panorama_labels(self) -> np.ndarray | None:
        """The labels of the panorama; if they have a file of their own, nothing else is read."""
        return None if self.panorama is None else self.panorama.labels

    def panorama_for(self, view: View) -> PanoramaGroundTruth | None:  # noqa: ARG002 for stitched panoramas
        """Return the panorama for use on the raster `view`: a stitched one on it, others as they are."""
        return self.panorama

    def require(self, *parts: str) -> tuple[Any, ...]:
        """Return parts by name; InputError with the missing file and the remedy if one is None."""
        values = tuple(getattr(self, part) for part in parts)
        for part, value in zip(parts, values, strict=True):
            if value is None:
                raise InputError(self.missing(part))
        return values

    def labelled_scan(self) -> Scan:
        """Return the scan with its point labels; InputError if they are missing."""
        scan, labels = self.require("scan", "point_labels")
        return replace(scan, label=labels)

    def missing(self, part: str) -> str:
        """Return the message of the error if a needed part is not there."""
        return f"{self.name}: this data set has no {part.replace('_', ' ')}; choose another data set or split"


F_co = TypeVar("F_co", bound=Frame, covariant=True)


class FrameList(Sequence[F_co]):
    """Frames of a split. Indexing makes a new Frame, and nothing is held: memory does not grow with reading.

    names  of the frames, in order.
    """

    def __init__(self, entries: Iterable[tuple[str, Callable[[str], F_co]]] = ()) -> None:
        self._entries = tuple(entries)  # name -> Frame, by a function shared by all frames of a split

    @property
    def names(self) -> tuple[str, ...]:
        """See the class."""
        return tuple(name for name, _ in self._entries)

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._entries)

    @overload
    def __getitem__(self, index: int) -> F_co: ...

    @overload
    def __getitem__(self, index: slice) -> FrameList[F_co]: ...

    def __getitem__(self, index: int | slice) -> F_co | FrameList[F_co]:
        """Return a new Frame, or the FrameList of a slice; nothing is read."""
        if isinstance(index, slice):
            return FrameList(self._entries[index])
        name, open_frame = self._entries[index]
        return open_frame(name)

    def __add__(self, frames: FrameList[Any]) -> FrameList[F_co]:
        """Return the frames of both."""
        return FrameList(self._entries + frames._entries)


def evenly_spaced(frames: int, most: int = 500) -> list[int]:
    """Return up to `most` indices of so many frames, evenly spaced: enough for statistics of any data set."""
    return np.linspace(0, frames - 1, min(frames, most)).round().astype(int).tolist()


def read_train_ids(path: Path) -> np.ndarray:
    """Read an image of Cityscapes train ids (h, w) uint8, IGNORE if unknown; InputError for other values."""
    ids = read_image(path)
    if ids.ndim != 2 or ids.dtype != np.uint8:
        raise InputError(f"{path}: is no image of class ids (one channel of 8 bits); write Cityscapes train ids")
    strange = (ids >= len(CITYSCAPES)) & (ids != IGNORE)
    if strange.any():
        raise InputError(
            f"{path}: holds class {ids[strange][0]}; write Cityscapes train ids, 0 to {len(CITYSCAPES) - 1}, and"
            f" {IGNORE} where unknown"
        )
    return ids


def is_frame_name(name: str) -> bool:
    """Return whether a name has the form "seq/NNNNNN"."""
    return name.count("/") == 1


def listed_splits(listing: Path) -> dict[str, object]:
    """Return split -> entries of the file, not checked; none without the file.

    Raises InputError if the file is no object.
    """
    splits = read_json(listing) if listing.is_file() else {}
    if not isinstance(splits, dict):
        raise InputError(f"{listing}: must be an object of split -> list of seq/NNNNNN; write it so")
    return splits


def listed_names(
    listing: Path, split: str, form: str = "seq/NNNNNN", accepts: Callable[[str], bool] = is_frame_name
) -> list[str]:
    """Return the names listed for a split, in order.

    form, accepts  of a name, for the message and to check it.
    Raises InputError if there is no such split, or it holds anything else.
    """
    splits = listed_splits(listing)
    if split not in splits:
        raise InputError(f"{listing}: has no split {split!r}" + closest(split, splits))
    names = splits[split]
    if not isinstance(names, list) or not all(isinstance(name, str) and accepts(name) for name in names):
        raise InputError(f"{listing}: split {split!r} must be a list of {form}; write it so")
    return names


def stems(folder: Path, *suffixes: str) -> list[str]:
    """Return sorted stems of the files in a folder with one of the suffixes; none if there is no such folder.

    Files whose names begin with a dot do not count. Raises InputError if the folder may not be read.
    """
    try:
        with os.scandir(folder) as entries:
            names = [entry.name for entry in entries]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise InputError(f"{folder}: cannot be looked into ({error.strerror}); ask for permission") from error
    files = [name for name in names if not name.startswith(".")]
    return sort_names({name[: -len(suffix)] for name in files for suffix in suffixes if name.endswith(suffix)})


def scan_names(sequences: Iterable[str], scans: Callable[[str], Path]) -> list[str]:
    """Return the names "seq/NNNNNN" of all scans NNNNNN.bin in the folders `scans(seq)` of some sequences."""
    return [f"{sequence}/{stem}" for sequence in sequences for stem in stems(scans(sequence), ".bin")]


def names_with_scans(names: list[str], scans: Callable[[str], Path], split: str = "") -> Iterator[str]:
    """Yield the names "seq/NNNNNN" whose scans NNNNNN.bin are in the folder `scans(seq)`, listed once.

    split  whose names must all have a scan: a missing one is an InputError; "": it is left out.
    """
    files: dict[str, set[str]] = {}
    for name in names:
        sequence, _, stem = name.partition("/")
        if sequence not in files:
            files[sequence] = set(stems(scans(sequence), ".bin"))
        if stem in files[sequence]:
            yield name
        elif split:
            raise InputError(f"{scans(sequence)}: scan {stem}.bin of split {split!r} is missing; complete the data")
