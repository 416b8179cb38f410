"""Scene: belief about what a scan shows, the only source of classes, depth and confidence."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from lidar2pano.geometry.rasters import likeliest
from lidar2pano.labels import COMMON15
from lidar2pano.scene.surfaces import cylinder_points
from lidar2pano.views import View

SKY = COMMON15.id_of("sky")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanPoints:
    """The N points of a scan as they were used.

    name            of the scan.
    labels          (N,) int64 ids of SEMANTIC_KITTI.
    returns_m       (2H, 2W) float32 on the panorama's raster: distance from the view's origin of the nearest point in
                    each pixel, metres; 0 where there is none.
    gaps_deg        sectors (left, right) of azimuth out of the sensor's field of view.
    dropped         points that could not be used.
    beyond_rows     points that could be used, but lie above or below the segmenter's rows.
    points_between  points that were put between the beams of a sparse sensor.
    """

    name: str
    labels: Tensor
    returns_m: Tensor
    gaps_deg: tuple[tuple[float, float], ...] = ()
    dropped: int = 0
    beyond_rows: int = 0
    points_between: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """What is believed of a scan on a raster of H x W pixels: from measurement and networks alone.

    view            the raster.
    channels        (1, 5, H, W) float32 of the scan's RangeImage.
    probabilities   (1, 16, H, W) float32 of COMMON15.
    depth_m         (1, H, W) float32 metres from the view's origin along the ray.
    viewpoint_m     (1,) float32 metres: height of the view's origin above the road.
    T_world_sensor  (4, 4) float64, the sensor's pose in a static frame; None where it is unknown.
    points          the scan's points; None in training.
    photographed    colours (1, 3, 2H, 2W) float32 in [-1, 1] of cameras, and the pixels in their sight,
                    (1, 2H, 2W) bool; None without cameras.
    In training the first dimension is a batch of scenes.
    """

    view: View
    channels: Tensor
    probabilities: Tensor
    depth_m: Tensor
    viewpoint_m: Tensor
    T_world_sensor: np.ndarray | None = None
    points: ScanPoints | None = None
    photographed: tuple[Tensor, Tensor] | None = None

    @property
    def measured(self) -> Tensor:
        """(1, H, W) bool: pixels with a point of the scan, or with one between the beams of a sparse sensor."""
        return self.channels[:, 0] > 0

    @cached_property
    def cylinder(self) -> tuple[Tensor, Tensor]:
        """Distances from the view's axis and heights above its origin, (1, H, W) float32 metres each."""
        return cylinder_points(self.depth_m, self.view)

    @property
    def depth_with_sky_m(self) -> Tensor:
        """(1, H, W) float32 metres: depths, infinite in the sky."""
        return torch.where(self.ids == SKY, torch.inf, self.depth_m)

    @cached_property
    def ids(self) -> Tensor:
        """(1, H, W) uint8: the likeliest classes, ids of COMMON15."""
        return likeliest(self.probabilities)
