"""Frames with cameras all around, of whatever data set: the panorama is stitched from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from lidar2pano.calibration import Calibration
from lidar2pano.data.frames import IGNORE, Frame, PanoramaGroundTruth
from lidar2pano.formats.image_files import read_image
from lidar2pano.geometry.camera import at_camera
from lidar2pano.geometry.projection import RangeImage, project
from lidar2pano.geometry.stitching import Camera, stitch
from lidar2pano.labels import COMMON15, TABLES
from lidar2pano.scan import Scan
from lidar2pano.scene.depth import complete_depth
from lidar2pano.views import View

# From a frame with x to the right and y forward, as PandaSet and nuScenes have it, to ours: x forward, y left.
FROM_RIGHT_FORWARD = np.array([[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


class SurroundFrame(Frame):
    """A frame of a data set with cameras all around.

    front         the name of the forward camera.
    camera_names  the cameras, in the data set's order.
    whole_scan    the scan with the points on the vehicle itself.
    view  the raster of its panorama, whose origin becomes the front camera's centre.
    The panorama's depths and labels are those of the points in the pixels.
    """

    front: str
    camera_names: tuple[str, ...]
    whole_scan: Scan

    def __init__(self, name: str, view: View) -> None:
        super().__init__(name)
        self.view = view
        self._panoramas: dict[View, PanoramaGroundTruth] = {}

    def camera(self, name: str) -> Camera:
        """Read a camera; InputError if its image is missing or damaged."""
        raise NotImplementedError

    def camera_file(self, name: str) -> Path:
        """Return the file of a camera's image."""
        raise NotImplementedError

    @cached_property
    def T_sensor_file(self) -> np.ndarray:
        """(4, 4) float64: the coordinates in the scan's file -> the scan's."""
        return FROM_RIGHT_FORWARD

    @cached_property
    def cameras(self) -> Mapping[str, Camera]:
        """The images by camera, in the data set's order."""
        return {name: self.camera(name) for name in self.camera_names}

    @cached_property
    def scan(self) -> Scan:
        """See Frame; without the points on the vehicle itself."""
        return self.whole_scan.beyond()

    @cached_property
    def calibration(self) -> Calibration:
        """See Frame."""
        calibration = self.cameras[self.front].calibration
        assert isinstance(calibration, Calibration), "the camera that looks ahead is rectified"
        return calibration

    @cached_property
    def image(self) -> np.ndarray:
        """See Frame."""
        return self.cameras[self.front].image

    @cached_property
    def panorama(self) -> PanoramaGroundTruth | None:
        """See Frame."""
        return self.panorama_for(self.view)

    @cached_property
    def panorama_labels(self) -> np.ndarray | None:
        """See Frame; nothing is stitched for them."""
        return self._labels_on(self._range_image(self.view))

    def panorama_for(self, view: View) -> PanoramaGroundTruth | None:
        """See Frame. Labels and depths are those of the points on this raster, so few are lost on a coarse one."""
        if view not in self._panoramas:
            scan, range_image = self.scan.beyond(), self._range_image(view)
            depth_m = complete_depth(torch.from_numpy(scan.xyz), range_image.view)
            image, valid = stitch(list(self.cameras.values()), range_image.view, depth_m)
            self._panoramas[view] = PanoramaGroundTruth(
                view=range_image.view,
                image=image,
                valid=valid,
                labels=self._labels_on(range_image),
                depth_m=range_image.channels[0].numpy(),
            )
        return self._panoramas[view]

    def _range_image(self, view: View) -> RangeImage:
        """Project the scan without the points on the vehicle onto a panorama's raster, around the front camera."""
        return project(self.scan.beyond(), at_camera(view, self.calibration))

    def _labels_on(self, range_image: RangeImage) -> np.ndarray | None:
        """Return (H, W) uint8 ids of COMMON15 of the pixels' points, else IGNORE; None without labels."""
        if self.point_labels is None:
            return None
        common = TABLES["semantic-kitti", "common-15"][self.point_labels]
        common = np.where(common == COMMON15.id_of("unlabeled"), IGNORE, common).astype(np.uint8)
        return range_image.spread(torch.from_numpy(common), IGNORE).numpy()


def read_camera(
    path: Path, K: np.ndarray, T_camera_lidar: np.ndarray, vehicle_line: Sequence[tuple[float, float]] = ()
) -> Camera:
    """Read a camera's image; below the line through the pixels `vehicle_line` (u, v), u rising, it shows the vehicle.

    Raises InputError if the image is missing or damaged.
    """
    image = read_image(path, "RGB")
    height, width = image.shape[:2]
    ego_mask = None
    if vehicle_line:
        u, v = np.array(vehicle_line).T
        ego_mask = np.arange(height)[:, None] >= np.interp(np.arange(width), u, v)
    calibration = Calibration(K=K, T_camera_lidar=T_camera_lidar, size=(width, height))
    return Camera(image=image, calibration=calibration, ego_mask=ego_mask)


def moved(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Return points (N, 3) float32 in the target frame of T (4, 4), float32; computed in float64."""
    return (points.astype(np.float64) @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
