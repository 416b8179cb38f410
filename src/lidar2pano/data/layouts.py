"""The layouts of data sets, distinguished by the files and folders in the root, and the frames of a split."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from lidar2pano.data import kitti360, labelled_images, nuscenes, pandaset, semantic_kitti
from lidar2pano.data.frames import Frame, FrameList
from lidar2pano.errors import InputError
from lidar2pano.views import VIEWS, View


class Layout(NamedTuple):
    """A layout of data sets.

    matches  (root) -> whether the folder has this layout.
    frames   (root, split, raster of stitched panoramas) -> the frames of the split.
    """

    matches: Callable[[Path], object]
    frames: Callable[[Path, str, View], FrameList[Any]]


LAYOUTS: dict[str, Layout] = {  # the first to match is taken
    "nuScenes' info.json": Layout(lambda root: (root / "info.json").is_file(), nuscenes.info_frames),
    "PandaSet": Layout(lambda root: (root / "classes.json").is_file(), pandaset.frames),
    "SemanticKITTI, simulated worlds": Layout(
        lambda root: (root / "sequences").is_dir(), lambda root, split, _: semantic_kitti.frames(root, split)
    ),
    "nuScenes": Layout(nuscenes.versions, nuscenes.frames),
    "KITTI-360": Layout(lambda root: (root / kitti360.SCANS).is_dir(), kitti360.frames),
    "Cityscapes, images beside labels": Layout(
        labelled_images.matches, lambda root, split, _: labelled_images.frames(root, split)
    ),
}


def frames(root: Path, split: str, view: View = VIEWS["panorama"]) -> FrameList[Frame]:
    """Return the frames of a split of the data set in `root`, in its order.

    view  the raster of panoramas stitched from surround cameras; its origin becomes the front camera's centre.
          A simulated world's panoramas keep their own raster.
    Raises InputError if the folder has none of the known layouts, or no such split.
    """
    for layout in LAYOUTS.values():
        if layout.matches(root):
            return layout.frames(root, split, view)
    raise InputError(
        f"{root}: is no data set; name one in SemanticKITTI layout (with a folder sequences/), a simulated world"
        " (world.json), a PandaSet (classes.json), nuScenes (v1.0-*/, or info.json), KITTI-360 (data_3d_raw/),"
        " Cityscapes (leftImg8bit/), or images/ beside labels/"
    )


def frames_of(root: Path, splits: Sequence[str]) -> FrameList[Frame]:
    """Return the frames of several splits, one after another; a split named twice counts twice.

    "FOLDER:split" is a split of another data set, e.g. a simulated one beside the real one in `root`.
    """
    return sum((frames(*locate_split(root, name)) for name in splits), FrameList[Frame]())


def locate_split(root: Path, name: str) -> tuple[Path, str]:
    """Return the data set's folder and the split's name of "split" (of `root`) or "FOLDER:split"."""
    folder, colon, split = name.rpartition(":")
    return Path(folder) if colon else root, split
