"""Truths: what is known of each frame of a data set, of whatever kind, for everything that measures.

Three kinds are told apart by what lies in their root: a data set in SemanticKITTI's layout (`data.sequences`), whose
frames may have the truth all around when it is simulated (`pano/`, world.json); a PandaSet (classes.json); samples of
nuScenes (info.json).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import overload

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError

from lidar2pano.calibration import Calibration
from lidar2pano.data.nuscenes_sample import nuscenes_samples
from lidar2pano.data.pandaset import pandaset_frames
from lidar2pano.data.poses import motion
from lidar2pano.data.sequences import UNSURE, Frame, frames
from lidar2pano.data.sights import CAMERA_TO_COMMON15
from lidar2pano.data.surround import SurroundFrame, read_json
from lidar2pano.errors import InputError
from lidar2pano.formats.output_files import DEPTH_STEPS
from lidar2pano.geometry.camera import at_camera
from lidar2pano.geometry.compose import compose
from lidar2pano.geometry.filling import dense_depth
from lidar2pano.geometry.projection import project
from lidar2pano.labels import COMMON15, TABLES
from lidar2pano.scan import Scan
from lidar2pano.views import VIEWS, View


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TruePanorama:
    """What is really all around, on the raster `view` (H rows, W columns; its origin in the scan's frame).

    colour   (H, W, 3) uint8 RGB; black where not valid.
    valid    (H, W) bool: the colour is known.
    ids      (H, W) uint8 ids of COMMON15, UNSURE where nobody knows; None when no pixel's class is known.
    depth_m  (H, W) float32 metres from the view's origin along the ray, 0 where there is none (sky) or nobody knows;
             None when no pixel's depth is known.
    """

    view: View
    colour: np.ndarray
    valid: np.ndarray
    ids: np.ndarray | None = None
    depth_m: np.ndarray | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """What is known of one frame; what nobody knows is None.

    name         "seq/NNNNNN" or the like, for messages and outputs; also the scan's name.
    scan         the scan alone, without labels: what is handed to the networks.
    calibration  the camera that `picture` and `camera_ids` belong to; known whenever one of them is.
    picture      (h, w, 3) uint8 RGB of that camera.
    camera_ids   (h, w) uint8 ids of COMMON15 in that camera, UNSURE where nobody knows.
    point_ids    (N,) int64 ids of SEMANTIC_KITTI of the scan's points, file order; 0 where nobody labelled.
    panorama     what is really all around.
    pose         (4, 4) float64: the scan's frame -> a frame that stands still over the sequence, metres.
    """

    name: str
    scan: Scan
    calibration: Calibration | None = None
    picture: np.ndarray | None = None
    camera_ids: np.ndarray | None = None
    point_ids: np.ndarray | None = None
    panorama: TruePanorama | None = None
    pose: np.ndarray | None = None


class Truths(Sequence[Truth]):
    """The truths of a split, each read when it is asked for, and not held.

    kind   "frames", "world", "pandaset" or "nuscenes".
    names  of the frames, in order; nothing is read for them.
    """

    def __init__(self, kind: str, named: Sequence[tuple[str, Callable[[], Truth]]]) -> None:
        self.kind = kind
        self.names = tuple(name for name, _ in named)
        self._readers = tuple(read for _, read in named)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._readers)

    @overload
    def __getitem__(self, index: int) -> Truth: ...

    @overload
    def __getitem__(self, index: slice) -> Truths: ...

    def __getitem__(self, index: int | slice) -> Truth | Truths:
        """Read a frame; of a slice nothing is read."""
        if isinstance(index, slice):
            return Truths(self.kind, list(zip(self.names, self._readers, strict=True))[index])
        return self._readers[index]()


def truths(root: Path, split: str, view: View = VIEWS["panorama"]) -> Truths:
    """What is known of the frames of a split of the data set in `root`, in its order.

    view  the raster of panoramas that are composed from surround cameras; its origin becomes the front camera's centre.
          A simulated world's panoramas keep the raster they were drawn on.
    Raises InputError where the folder is none of the known kinds, or has no such split; reading a frame raises it
    where a file is damaged, or one is missing that the others need.
    """
    if (root / "info.json").is_file():
        samples = nuscenes_samples(root, split)
        return Truths("nuscenes", [(one.name, partial(_read_surround, one.read, view)) for one in samples])
    if (root / "classes.json").is_file():
        found = pandaset_frames(root, split)
        return Truths("pandaset", [(one.name, partial(_read_surround, one.read, view)) for one in found])
    if (root / "world.json").is_file():
        raster = _world_raster(root / "world.json")
        return Truths("world", [(one.name, partial(frame_truth, one, raster)) for one in frames(root, split)])
    if (root / "sequences").is_dir():
        return Truths("frames", [(one.name, partial(frame_truth, one)) for one in frames(root, split)])
    raise InputError(
        f"{root}: is no data set with a known truth; name one in SemanticKITTI layout (sequences/), a simulated world "
        "(world.json), a PandaSet (classes.json) or a folder with nuScenes' info.json"
    )


def frame_truth(frame: Frame, view: View | None = None) -> Truth:
    """What is known of a frame in SemanticKITTI's layout; `view`: the raster of the panoramas in pano/, if it has some.

    Labels and pictures that are not there are None. Raises InputError for a damaged file, for a picture without
    calib.txt, for sizes that do not fit, and for a panorama of which a part is missing.
    """
    scan = replace(frame.scan(), name=frame.name)
    picture = frame.image() if _has_image(frame) else None
    ids = CAMERA_TO_COMMON15[frame.camera_labels()] if _has(frame, "camera_labels") else None
    if picture is not None and ids is not None and picture.shape[:2] != ids.shape:
        raise InputError(
            f"{frame.folder / 'camera_labels' / frame.stem}.png: is {ids.shape[1]}x{ids.shape[0]} and its image "
            f"{picture.shape[1]}x{picture.shape[0]}; label the image anew"
        )
    calibration, around = None, _has(frame, "pano") and view is not None
    if (seen := picture if picture is not None else ids) is not None:
        calibration = frame.calibration((seen.shape[1], seen.shape[0]))
    return Truth(
        name=frame.name,
        scan=scan,
        calibration=calibration,
        picture=picture,
        camera_ids=ids,
        point_ids=frame.labels(len(scan)) if _has(frame, "labels", ".label") else None,
        panorama=_drawn(frame, view) if around and view else None,
        pose=_pose(frame),
    )


def surround_truth(frame: SurroundFrame, view: View) -> Truth:
    """What is known of a frame with cameras all around; the panorama on `view` around its front camera's centre.

    Its depths are the scan's alone, where a point owns the pixel, and its ids those of such points that have a label.
    """
    front = frame.photos[frame.front]
    view = at_camera(view, front.calibration)
    scan = replace(frame.scan, label=None).beyond()
    colour, valid = compose(list(frame.photos.values()), view, dense_depth(torch.from_numpy(scan.xyz), view))
    image = project(scan, view)
    ids = None
    if (label := frame.scan.label) is not None:
        common = TABLES["semantic-kitti", "common-15"][label]
        common = np.where(common == COMMON15.id_of("unlabeled"), UNSURE, common).astype(np.uint8)
        ids = image.spread(torch.from_numpy(common), UNSURE).numpy()
    return Truth(
        name=frame.name,
        scan=scan,
        calibration=front.calibration,
        picture=front.picture,
        point_ids=label,
        panorama=TruePanorama(view=view, colour=colour, valid=valid, ids=ids, depth_m=image.channels[0].numpy()),
        pose=frame.pose,
    )


def _read_surround(read: Callable[[], SurroundFrame], view: View) -> Truth:
    return surround_truth(read(), view)


def _world_raster(card: Path) -> View:
    """The raster of pano/: the first of the views that a world's card names, such as "panorama" or "panorama/2"."""
    told = read_json(card)
    names = told.get("views") if isinstance(told, dict) else None
    name, _, part = str(names[0] if isinstance(names, list) and names else "").partition("/")
    if name not in VIEWS or not (part or "1").isdecimal() or int(part or 1) < 1:
        raise InputError(f"{card}: names no view of its panoramas; simulate the world anew")
    return VIEWS[name].scaled(1 / int(part or 1))


def _drawn(frame: Frame, view: View) -> TruePanorama:
    """A simulated panorama, of which everything is known."""
    view = at_camera(view, frame.calibration((1, 1)))
    size = (view.rows, view.columns)
    colour = _picture(frame, "pano", (*size, 3), np.uint8)
    ids = _picture(frame, "pano_labels", size, np.uint8)
    steps = _picture(frame, "pano_depth", size, np.uint16)
    return TruePanorama(
        view=view,
        colour=colour,
        valid=np.ones(size, dtype=bool),
        ids=ids,
        depth_m=steps.astype(np.float32) / DEPTH_STEPS,
    )


def _picture(frame: Frame, folder: str, shape: tuple[int, ...], kind: type[np.generic]) -> np.ndarray:
    path = frame.folder / folder / f"{frame.stem}.png"
    try:
        with Image.open(path) as file:
            values = np.array(file)
    except FileNotFoundError as error:
        raise InputError(f"{path}: is missing; simulate the world anew") from error
    except (OSError, UnidentifiedImageError) as error:
        raise InputError(f"{path}: is no readable picture; simulate it anew") from error
    if values.shape != shape or values.dtype != kind:
        wanted = "x".join(str(length) for length in shape)
        raise InputError(f"{path}: is {values.shape} {values.dtype}, not {wanted}; simulate the world anew")
    return values


def _pose(frame: Frame) -> np.ndarray | None:
    """The LiDAR's frame -> its frame at the sequence's first pose."""
    return motion(frame, replace(frame, stem="0"))


def _has(frame: Frame, folder: str, suffix: str = ".png") -> bool:
    return (frame.folder / folder / f"{frame.stem}{suffix}").is_file()


def _has_image(frame: Frame) -> bool:
    return _has(frame, "image_2") or _has(frame, "image_2", ".jpg")
