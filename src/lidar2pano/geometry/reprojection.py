"""Rasters of other programs: the equirectangular part of a sphere, and the faces of a cube; look-ups to fill them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from lidar2pano.calibration import Calibration
from lidar2pano.geometry.camera import Lookup, panorama_in_camera
from lidar2pano.geometry.projection import directions, pixels
from lidar2pano.views import FULL_TURN, View

PROJECTIONS = ("cylinder", "equirectangular", "cubemap")
# Face of a cube -> directions of its image's right, of its image's bottom, and of its middle; x forward, y left, z up.
# Above and below, one looks up and down from the face ahead: its upper edge is the lower edge of the face above.
CUBE_AXES = {
    "front": ((0, -1, 0), (0, 0, -1), (1, 0, 0)),
    "right": ((-1, 0, 0), (0, 0, -1), (0, -1, 0)),
    "back": ((0, 1, 0), (0, 0, -1), (-1, 0, 0)),
    "left": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "up": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "down": ((0, -1, 0), (-1, 0, 0), (0, 0, -1)),
}


def equirectangular(view: View) -> View:
    """Return the part of a sphere with the directions of a view, as fine as the view is at the horizon.

    It consists of whole pixels of a full sphere, twice as wide as high, straight ahead in its middle. A view across the
    direction straight behind becomes a full turn.
    """
    full_columns = _full_columns(view)
    step = FULL_TURN / full_columns
    up, down = view.up, view.down
    if view.kind == "cylinder":
        up, down = (math.degrees(math.atan(tangent)) for tangent in (up, down))
    top, bottom = math.ceil((90 - min(up, 90)) / step - 0.5), math.floor((90 - max(down, -90)) / step + 0.5)
    left, right = 0, full_columns
    if not view.circular and view.left <= FULL_TURN / 2 and view.right >= -FULL_TURN / 2:
        left = math.ceil((FULL_TURN / 2 - view.left) / step - 0.5)
        right = math.floor((FULL_TURN / 2 - view.right) / step + 0.5)
    return replace(
        view,
        kind="sphere",
        rows=max(bottom - top, 1),
        columns=max(right - left, 1),
        up=90 - top * step,
        down=90 - max(bottom, top + 1) * step,
        left=FULL_TURN / 2 - left * step,
        right=FULL_TURN / 2 - max(right, left + 1) * step,
    )


def _full_columns(view: View) -> int:
    """Return the even number of columns in a full turn as fine as a view's."""
    return 2 * round(view.columns * FULL_TURN / (view.left - view.right) / 2)


def cube_faces(view: View) -> dict[str, Calibration]:
    """Return a square camera with a field of 90 degrees for each face, as fine in its middle as a view is."""
    size = 2 * round(view.focal_px)
    K = np.array([[size / 2, 0, (size - 1) / 2], [0, size / 2, (size - 1) / 2], [0, 0, 1.0]])
    cameras: dict[str, Calibration] = {}
    for face, axes in CUBE_AXES.items():
        T = np.eye(4)
        T[:3, :3] = axes
        T[:3, 3] = -T[:3, :3] @ np.array(view.origin)
        cameras[face] = Calibration(K=K, T_camera_lidar=T, size=(size, size))
    return cameras


def panorama_in_view(view: View, target: View) -> Lookup:
    """Return the look-up from a panorama on `view` to `target`, another raster around the same point."""
    x, y, z = directions(target).unbind(-1)
    row, column = pixels(x, y, z, view)
    valid = (row >= 0) & (row <= view.rows) & (view.circular | ((column >= 0) & (column <= view.columns)))
    row, column = (torch.where(valid, place, 0.0).float() for place in (row, column))
    return Lookup(row=row, column=column, valid=valid, circular=view.circular)


def lookups(view: View, projection: str) -> dict[str, Lookup]:
    """Return the look-ups of a projection's images, by the ending of their names' stems."""
    if projection == "equirectangular":
        return {"": panorama_in_view(view, equirectangular(view))}
    return {f".{face}": panorama_in_camera(view, camera) for face, camera in cube_faces(view).items()}
