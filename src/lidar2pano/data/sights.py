"""What a frame looks like, from its camera or all around, and the flow to the frame before it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from lidar2pano.calibration import Calibration
from lidar2pano.data.optical_flow import seen_flow
from lidar2pano.data.poses import lidar_poses
from lidar2pano.data.sequences import UNSURE, Frame
from lidar2pano.errors import InputError
from lidar2pano.formats.output_files import DEPTH_STEPS
from lidar2pano.geometry.camera import at_camera, panorama_in_camera
from lidar2pano.geometry.flow import Flow, ego_flow, scan_distances
from lidar2pano.labels import COMMON15, TABLES
from lidar2pano.views import VIEWS, View

SKY = COMMON15.id_of("sky")
CAMERA_TO_COMMON15 = np.full(256, UNSURE, dtype=np.uint8)
CAMERA_TO_COMMON15[:19] = TABLES["cityscapes", "common-15"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sight:
    """A picture and its classes on one raster.

    raster   the panorama's View, or the camera whose picture it is.
    colour   (3, H, W) uint8 RGB.
    classes  (H, W) uint8 ids of COMMON15, 0 where nobody knows.
    """

    raster: View | Calibration
    colour: Tensor
    classes: Tensor


def camera_sight(frame: Frame, scale: float) -> Sight:
    """What the camera saw, `scale` times as wide and high; InputError where a file is missing or does not fit."""
    picture, ids = frame.image(), frame.camera_labels()
    if picture.shape[:2] != ids.shape:
        raise InputError(f"{frame.name}: its image is {picture.shape[:2]} and its camera labels {ids.shape}; pair anew")
    calibration = frame.calibration((ids.shape[1], ids.shape[0])).scaled(scale)
    common = CAMERA_TO_COMMON15[ids]
    common[common == UNSURE] = 0
    return _sight(calibration, picture, common, calibration.size)


def panorama_sight(frame: Frame, view: View) -> Sight:
    """What is all around, on the raster `view` around the camera; InputError where the data set has no such truth."""
    ids = _truth(frame, "pano_labels")
    size = (ids.shape[1], ids.shape[0])
    with Image.open(_path(frame, "pano")) as file:
        picture = np.array(file.convert("RGB"))
    if picture.shape[:2] != ids.shape or abs(size[0] * view.rows - size[1] * view.columns) > view.columns:
        raise InputError(f"{frame.name}: pano/ and pano_labels/ must both be panoramas like {view.columns}x{view.rows}")
    return _sight(at_camera(view, frame.calibration((1, 1))), picture, ids, (view.columns, view.rows))


def flow_to(before: Frame, frame: Frame, was: Sight, now: Sight) -> Flow:
    """Flow from a frame's sight back to that of the frame before: by poses and depth, else as the pictures show it."""
    poses = lidar_poses(frame.folder)
    if poses is None:
        return seen_flow(now.colour, was.colour)
    moved = np.linalg.inv(poses.at(before.stem)) @ poses.at(frame.stem)
    distances = [distances_m(one, sight) for one, sight in ((frame, now), (before, was))]
    return ego_flow(distances[0], distances[1], torch.from_numpy(moved), now.raster)


def distances_m(frame: Frame, sight: Sight) -> Tensor:
    """Distances (H, W) float32 as `ego_flow` takes them: from pano_depth/ where there is one, else from the scan."""
    if (frame.folder / "pano_depth").is_dir():
        steps = torch.from_numpy(_truth(frame, "pano_depth").astype(np.float32))
        depth_m = torch.where(steps > 0, steps / DEPTH_STEPS, torch.inf)
        rows, columns = depth_m.shape
        whole = replace(VIEWS["panorama"], rows=rows, columns=columns)
        if isinstance(sight.raster, Calibration):
            return panorama_in_camera(at_camera(whole, sight.raster), sight.raster).nearest(depth_m)
        return _nearest(depth_m, sight.classes.shape[0], sight.classes.shape[1])
    if not isinstance(sight.raster, Calibration):
        raise InputError(f"{frame.folder}: has no pano_depth/, which the panorama's flow needs; simulate it anew")
    distance = scan_distances(torch.from_numpy(frame.scan().xyz), sight.raster)
    return distance.where(sight.classes != SKY, torch.inf)


def _sight(raster: View | Calibration, picture: np.ndarray, ids: np.ndarray, size: tuple[int, int]) -> Sight:
    """Picture and ids at another size (columns, rows): means of the pixels, and the nearest id."""
    colour = np.array(Image.fromarray(picture).resize(size, Image.Resampling.BOX))
    classes = np.array(Image.fromarray(ids).resize(size, Image.Resampling.NEAREST))
    return Sight(
        raster=raster,
        colour=torch.from_numpy(colour).movedim(2, 0).contiguous(),
        classes=torch.from_numpy(classes),
    )


def _nearest(picture: Tensor, rows: int, columns: int) -> Tensor:
    row = ((torch.arange(rows) + 0.5) * picture.shape[0] / rows).long()
    column = ((torch.arange(columns) + 0.5) * picture.shape[1] / columns).long()
    return picture[row[:, None], column]


def _path(frame: Frame, folder: str) -> Path:
    path = frame.folder / folder / f"{frame.stem}.png"
    if not path.is_file():
        raise InputError(f"{path}: is missing; only data sets with the truth all around (lidar2pano world) have it")
    return path


def _truth(frame: Frame, folder: str) -> np.ndarray:
    path = _path(frame, folder)
    try:
        with Image.open(path) as file:
            values = np.array(file)
    except (OSError, UnidentifiedImageError) as error:
        raise InputError(f"{path}: is no readable picture; replace it") from error
    if values.ndim != 2:
        raise InputError(f"{path}: has {values.ndim} dimensions; one channel of ids or depths is needed")
    return values
