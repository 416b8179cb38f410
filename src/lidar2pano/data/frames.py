"""Frame: everything that a data set knows about one moment, read when it is asked for; and the frames of a split.

Layouts are distinguished by what lies in their root: SemanticKITTI's (sequences/), worlds that `lidar2pano world` simulated
(the same, and world.json), PandaSet (classes.json), nuScenes (v1.0-*/, or single samples with info.json), KITTI-360
(data_3d_raw/), and images without scans: Cityscapes (leftImg8bit/) and any images/ beside labels/.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, overload

import numpy as np

from lidar2pano.calibration import Calibration
from lidar2pano.errors import InputError
from lidar2pano.labels import TABLES
from lidar2pano.scan import Scan
from lidar2pano.views import VIEWS, View

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

    image    (H, W, 3) uint8 RGB; black where not valid.
    valid    (H, W) bool: the colour is known.
    labels   (H, W) uint8 ids of COMMON15, IGNORE where unknown; None where no pixel's class is known.
    depth_m  (H, W) float32 metres from the view's origin along the ray, 0 where there is none (sky) or it is unknown;
             None where no pixel's depth is known.
    openings (H, W) float32 in [0, 1], the share of a pixel that is a window or a door of a building; None: not known.
    """

    view: View
    image: np.ndarray
    valid: np.ndarray
    labels: np.ndarray | None = None
    depth_m: np.ndarray | None = None
    openings: np.ndarray | None = None


class Frame:
    """One frame of a data set. A part is read on first access and kept as long as the Frame lives; None: there is none.

    name           "seq/NNNNNN", also the scan's.
    scan           in the sensor's frame (x forward, y left, z up), without labels.
    point_labels   (N,) int64 ids of SEMANTIC_KITTI, file order;  predicted_labels: likewise, but a segmenter's.
    calibration    of the (front) camera, for the size of image and camera_labels.
    image          (h, w, 3) uint8 RGB of that camera.
    camera_labels  (h, w) uint8 train ids of CITYSCAPES, IGNORE where unknown.
    pose           (4, 4) float64 T_world_sensor: the sensor's coordinates -> a frame fixed to the world, metres.
    panorama       the true panorama.
    root           the data set's folder, None where the frame comes from nowhere.
    Parts raise InputError where a file is damaged, does not fit the others, or is missing though the others need it.
    """

    root: Path | None = None

    def __init__(self, name: str, **parts: Any) -> None:  # noqa: ANN401
        self.name = name
        vars(self).update(parts)  # where cached properties look first

    @cached_property
    def scan(self) -> Scan:
        """See the class."""
        raise InputError(self.missing("scan"))

    @cached_property
    def point_labels(self) -> np.ndarray | None:
        """See the class."""
        return None

    @cached_property
    def predicted_labels(self) -> np.ndarray | None:
        """See the class."""
        return None

    @cached_property
    def calibration(self) -> Calibration | None:
        """See the class."""
        return None

    @cached_property
    def image(self) -> np.ndarray | None:
        """See the class."""
        return None

    @cached_property
    def camera_labels(self) -> np.ndarray | None:
        """See the class."""
        return None

    @cached_property
    def pose(self) -> np.ndarray | None:
        """See the class."""
        return None

    @cached_property
    def panorama(self) -> PanoramaGroundTruth | None:
        """See the class."""
        return None

    @cached_property
    def panorama_labels(self) -> np.ndarray | None:
        """The labels of the panorama; where they have a file of their own, nothing else is read."""
        return None if self.panorama is None else self.panorama.labels

    def panorama_for(self, view: View) -> PanoramaGroundTruth | None:  # noqa: ARG002 of use where panoramas are stitched
        """The panorama for use on the raster `view`: stitched on it where it has to be stitched, else as it is."""
        return self.panorama

    def require(self, *parts: str) -> tuple[Any, ...]:
        """Parts by name; InputError that names the missing file and says what to do where one is None."""
        found = tuple(getattr(self, part) for part in parts)
        for part, value in zip(parts, found, strict=True):
            if value is None:
                raise InputError(self.missing(part))
        return found

    def missing(self, part: str) -> str:
        """The message of the error where a part that is needed is not there."""
        return f"{self.name}: this data set has no {part.replace('_', ' ')}; choose another data set or split"


F = TypeVar("F", bound=Frame, covariant=True)


class FrameList(Sequence[F]):
    """Frames of a split. Indexing makes a new Frame, and nothing is held: memory does not depend on what was read.

    layout  "semantic-kitti", "simulated", "pandaset", "nuscenes", "kitti-360", "cityscapes" or "images".
    names   of the frames, in order.
    """

    def __init__(self, layout: str, entries: Iterable[tuple[str, Callable[[str], F]]]) -> None:
        self.layout = layout
        self._entries = tuple(entries)  # name -> Frame, by a function that all frames of a split share

    @property
    def names(self) -> tuple[str, ...]:
        """See the class."""
        return tuple(name for name, _ in self._entries)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._entries)

    @overload
    def __getitem__(self, index: int) -> F: ...

    @overload
    def __getitem__(self, index: slice) -> FrameList[F]: ...

    def __getitem__(self, index: int | slice) -> F | FrameList[F]:
        """A new Frame, or the FrameList of a slice; nothing is read."""
        if isinstance(index, slice):
            return FrameList(self.layout, self._entries[index])
        name, open_frame = self._entries[index]
        return open_frame(name)

    def __add__(self, other: FrameList[Any]) -> FrameList[F]:
        """The frames of both; the layout is that of the first."""
        return FrameList(self.layout, self._entries + other._entries)


def frames(root: Path, split: str, view: View = VIEWS["panorama"]) -> FrameList[Frame]:
    """Frames of a split of the data set in `root`, in its order.

    view  the raster of panoramas that are stitched from surround cameras; its origin becomes the front camera's centre.
          A simulated world's panoramas keep the raster that they were rendered on.
    Raises InputError where the folder has none of the known layouts, or no such split.
    """
    from lidar2pano.data import kitti360, labelled_images, nuscenes, nuscenes_samples, pandaset, semantic_kitti

    if (root / "info.json").is_file():
        return nuscenes.frames(root, split, view)
    if (root / "classes.json").is_file():
        return pandaset.frames(root, split, view)
    if (root / "sequences").is_dir():
        return semantic_kitti.frames(root, split)
    if nuscenes_samples.versions(root):
        return nuscenes_samples.frames(root, split, view)
    if kitti360.is_one(root):
        return kitti360.frames(root, split, view)
    if labelled_images.is_one(root):
        return labelled_images.frames(root, split)
    raise InputError(
        f"{root}: is no data set; name one in SemanticKITTI layout (with a folder sequences/), a simulated world"
        " (world.json), a PandaSet (classes.json), nuScenes (v1.0-*/, or info.json), KITTI-360 (data_3d_raw/), Cityscapes"
        " (leftImg8bit/), or images/ beside labels/"
    )


def frames_of(root: Path, splits: Sequence[str]) -> FrameList[Frame]:
    """Frames of several splits, one after another; a split named twice counts twice.

    "FOLDER:split" is a split of another data set, e.g. a simulated one beside the real one in `root`.
    """
    return sum((frames(*located(root, name)) for name in splits), FrameList[Frame]("semantic-kitti", ()))


def evenly_spaced(frames: int, most: int = 500) -> list[int]:
    """Up to `most` indices of so many frames, evenly spaced: enough for statistics, however large the data set is."""
    return np.linspace(0, frames - 1, min(frames, most)).round().astype(int).tolist()


def located(root: Path, name: str) -> tuple[Path, str]:
    """Folder of the data set and name of the split that "split" (of `root`) or "FOLDER:split" stands for."""
    folder, colon, split = name.rpartition(":")
    return Path(folder) if colon else root, split
