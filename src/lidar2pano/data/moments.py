"""A frame on the panorama's raster, as training holds it: what its camera saw, or the whole truth where it is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lidar2pano.calibration import Calibration
from lidar2pano.data.ranges import labelled
from lidar2pano.data.sequences import UNSURE, Frame
from lidar2pano.data.sights import CAMERA_TO_COMMON15, distances_m, panorama_sight
from lidar2pano.geometry.camera import at_camera, camera_in_panorama
from lidar2pano.geometry.projection import pixels, project
from lidar2pano.scan import Scan
from lidar2pano.views import View


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moment:
    """A frame as it is held in memory: in a window of the raster a little wider than the crops, or all around.

    scan     with its point labels;  view: the window or the whole turn, seen from the camera's optical centre.
    camera   (H, W) uint8 as in PanoramaSample;  depth_m (H, W) float32: the scan's, or the true one all around.
    colour   (3, 2H, 2W) uint8, seen (2H, 2W) bool; both empty unless asked for.
    """

    scan: Scan
    view: View
    camera: Tensor
    depth_m: Tensor
    colour: Tensor
    seen: Tensor


def read_moment(frame: Frame, view: View, columns: int, colour: bool) -> Moment:
    """Read a frame onto `view`: all of it where the data set has the truth all around, else what its camera saw.

    What the camera saw is a window, `columns` wide, around the camera's sector.
    Raises InputError where scan, labels, camera labels, image or calibration are missing or do not fit together.
    """
    if (frame.folder / "pano_labels").is_dir():
        return _all_around(frame, view, colour)
    ids = frame.camera_labels()
    calibration = frame.calibration((ids.shape[1], ids.shape[0]))
    scan = labelled(frame)
    window = around_camera(at_camera(view, calibration), calibration, columns)
    camera = camera_in_panorama(window, calibration).nearest(torch.from_numpy(CAMERA_TO_COMMON15[ids]), UNSURE)
    picture, seen = _nothing()
    if colour:
        lookup = camera_in_panorama(window.scaled(2), calibration)
        picture = lookup.linear(torch.from_numpy(frame.image()).movedim(2, 0).float()).round().to(torch.uint8)
        seen = lookup.valid
    return Moment(
        scan=scan,
        view=window,
        camera=camera,
        depth_m=project(scan, window).channels[0],
        colour=picture,
        seen=seen,
    )


def _all_around(frame: Frame, view: View, colour: bool) -> Moment:
    sight = panorama_sight(frame, view)
    assert isinstance(sight.raster, View)
    distances = distances_m(frame, sight)
    picture, seen = _nothing()
    if colour:
        picture = panorama_sight(frame, view.scaled(2)).colour
        seen = torch.ones(picture.shape[1:], dtype=torch.bool)
    return Moment(
        scan=labelled(frame),
        view=sight.raster,
        camera=sight.classes.where(sight.classes != 0, UNSURE),
        depth_m=distances.where(distances.isfinite(), 0),
        colour=picture,
        seen=seen,
    )


def _nothing() -> tuple[Tensor, Tensor]:
    return torch.zeros(3, 0, 0, dtype=torch.uint8), torch.zeros(0, 0, dtype=torch.bool)


def around_camera(view: View, calibration: Calibration, columns: int) -> View:
    """The window of the raster, `columns` wide, in whose middle the camera looks."""
    ahead = np.linalg.inv(calibration.K @ calibration.T_camera_lidar[:3, :3]) @ np.array(
        [(calibration.size[0] - 1) / 2, (calibration.size[1] - 1) / 2, 1.0]
    )
    x, y, z = torch.from_numpy(ahead).unbind()
    _, column = pixels(x, y, z, view)
    start = min(max(round(float(column)) - columns // 2, 0), view.columns - columns)
    return view.window(start, columns)
