"""The panorama of a scene, before it is painted."""

from __future__ import annotations

import numpy as np
import torch

from lidar2pano.geometry.rasters import upsample_azimuth, upsample_classes
from lidar2pano.labels import COMMON15
from lidar2pano.panorama import Panorama
from lidar2pano.scene.record import Scene
from lidar2pano.views import columns_between

TINY = 1e-20  # least probability whose logarithm is taken
SKY = COMMON15.id_of("sky")


def believed(scene: Scene, frame: int) -> Panorama:
    """Return the panorama of a scene, black before it is painted.

    Classes, depth and confidence are the scene's, enlarged; a pixel with a point has its distance. The sky has no other
    depth, and outside the sensor's field of view nothing is claimed.
    """
    points, view = scene.points, scene.view.scaled(2)
    assert points is not None, "scenes of scans have them"
    segments = upsample_classes(scene.probabilities, 2, least=TINY)
    measured = points.returns_m > 0
    depth_m = upsample_azimuth(scene.depth_m[None], 2)[0, 0].masked_fill_(segments == SKY, 0)
    depth_m = torch.where(measured, points.returns_m, depth_m)
    confidence = upsample_azimuth(scene.probabilities.amax(1, keepdim=True), 2)[0, 0]
    for left, right in points.gaps_deg:
        columns = columns_between(view, left, right)
        for layer in (segments, depth_m, confidence, measured):
            layer[:, columns] = 0
    layers = (segments, depth_m, confidence, measured, points.labels)
    segments, depth_m, confidence, measured, labels = (part.contiguous().cpu().numpy() for part in layers)
    return Panorama(
        name=points.name,
        frame=frame,
        view=view,
        colour=np.zeros((view.rows, view.columns, 3), np.uint8),
        segments=segments,
        depth_m=depth_m,
        confidence=confidence,
        measured=measured,
        labels=labels,
        dropped=points.dropped,
        beyond_rows=points.beyond_rows,
        points_between=points.points_between,
    )
