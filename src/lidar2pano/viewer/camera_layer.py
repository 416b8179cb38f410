"""The camera's image on the panorama, where a scan lies in a data set that has one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from lidar2pano.data.semantic_kitti import SemanticKittiFrame
from lidar2pano.geometry.camera import camera_in_panorama
from lidar2pano.views import View


def camera_layer(scan_file: Path, view: View) -> np.ndarray | None:
    """(h, w, 4) uint8 RGBA on the panorama's raster, transparent where no camera looks; None where there is no image.

    SemanticKITTI's layout only: <sequence>/velodyne/<stem>.bin, image_2/<stem>.png or .jpg, calib.txt. The scene is
    taken to be far away, or the panorama's origin to be the camera's centre. A simulated world has an image all around.
    Raises InputError where a file is damaged.
    """
    if scan_file.resolve().parent.name != "velodyne":
        return None
    frame = SemanticKittiFrame(scan_file.resolve().parents[1], scan_file.stem)
    if (around := frame.panorama) is not None and around.view.circular:
        return np.dstack([around.image, np.uint8(255) * around.valid])
    if frame.image_file is None or not (frame.folder / "calib.txt").is_file():
        return None
    image, calibration = frame.require("image", "calibration")
    lookup = camera_in_panorama(view, calibration)
    colour = lookup.linear(torch.from_numpy(image).movedim(2, 0).float()).round().to(torch.uint8).movedim(0, 2)
    return np.dstack([colour.numpy(), np.uint8(255) * lookup.valid.numpy()])
