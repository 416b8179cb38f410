"""Doubts about a camera beside a scan: whether its image shows something, then, there, and the right way up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from lidar2pano.geometry.projection import project
from lidar2pano.geometry.stitching import BLACK, WHITE, Camera, Sight, hides_nothing, look
from lidar2pano.scan import Scan
from lidar2pano.scene.surfaces import same_surface
from lidar2pano.views import VIEWS

FEW = 0.01  # largest share of an image's pixels on the other side
MOST_APART_S = 0.1  # half a period of the slowest LiDARs (VLP-16: 5 to 20 turns a second)
EVERY_PX = 4  # one of so many rows and columns of an image is looked at
BEAMS = replace(VIEWS["hdl64e"], columns=1024)  # as coarse as a turn of the slower LiDARs: neighbours are neighbours
FEWEST_EDGES = 30  # points whose mean is taken to be normal
STANDARD_ERRORS = 3.0  # by which a turned image must fit better: by chance it does in one of 700 cases
UPSIDE_DOWN = np.diag([-1.0, -1.0, 1.0, 1.0])


def sound_cameras(cameras: Sequence[Camera], scan: Scan, edges: bool) -> tuple[list[Camera], tuple[str, ...]]:
    """Return the useful cameras of a scan, and a sentence on each of the others, and on doubtful ones.

    edges  whether edges are compared: it takes time, and calibrations do not change along a drive.
    """
    points = torch.from_numpy(scan.xyz[np.isfinite(scan.xyz).all(1) & scan.xyz.any(1)]).T
    edge_points = _edge_points(scan) if edges and cameras else None
    kept: list[Camera] = []
    doubts: list[str] = []
    for camera in cameras:
        if fault := _fault(camera, points):
            doubts.append(f"camera {camera.name} is left out: {fault}")
            continue
        kept.append(camera)
        if edge_points is not None and turned_fit(camera, edge_points) > STANDARD_ERRORS:
            doubts.append(
                f"camera {camera.name}: its edges would fit the scan's better if it were turned by 180 degrees;"
                " check its pose, whose z axis looks ahead and y axis down"
            )
    return kept, tuple(doubts)


def _fault(camera: Camera, points: Tensor) -> str:
    """Return why a camera is of no use, "" where it is; points: (3, n) of the scan, metres."""
    level = camera.image[::EVERY_PX, ::EVERY_PX].max(2)
    for side, share in (("black", np.mean(level > BLACK)), ("burnt out", np.mean(level < WHITE))):
        if share < FEW:
            return f"its image is {side}; clean or mend it"
    if camera.time_s is not None and abs(camera.time_s) > MOST_APART_S:
        return f"its image was taken {abs(camera.time_s):.3g} s {'after' if camera.time_s > 0 else 'before'} the scan"
    if not len(_sight(camera, points).surface):
        return "its calibration looks away from all points of the scan; check its pose"
    return ""


def _sight(camera: Camera, points: Tensor) -> Sight:
    """Return the points (3, n) inside a camera's image, whatever stands before them."""
    whole = torch.cat([points, torch.ones(1, points.shape[1])])
    return look(camera, whole, 1.0, hides_nothing)


def _edge_points(scan: Scan) -> Tensor:
    """Return points (3, n) at whose side, along a beam, another surface begins farther away."""
    image = project(scan, BEAMS)
    distance = image.channels[0]
    edge = torch.zeros_like(image.valid)
    for step in (-1, 1):
        neighbour = distance.roll(step, 1)
        edge |= image.valid & (neighbour > distance) & ~same_surface(distance, neighbour)
    return image.channels[1:4, edge]


def turned_fit(camera: Camera, edge_points: Tensor) -> float:
    """Return by how many standard errors an image has larger steps at edges of the scan if it is turned by 180 degrees.

    edge_points  (3, n). Steps are the square roots of differences of grey to either side: few large ones decide less.
    """
    grey = torch.from_numpy(camera.image[::EVERY_PX, ::EVERY_PX]).float().mean(2)
    steps = max_pool2d((grey.roll(-1, 1) - grey.roll(1, 1)).abs().sqrt()[None], 3, 1, 1)[0]
    values = torch.full((2, edge_points.shape[1]), torch.nan)
    calibration = camera.calibration
    turned = replace(calibration, T_camera_lidar=UPSIDE_DOWN @ calibration.T_camera_lidar)
    for value, pose in zip(values, (calibration, turned), strict=True):
        sight = _sight(replace(camera, calibration=pose), edge_points)
        value[sight.surface] = steps[(sight.lookup.row / EVERY_PX).long(), (sight.lookup.column / EVERY_PX).long()]
    gain = values[1] - values[0]
    gain = gain[gain.isfinite()]
    if len(gain) < FEWEST_EDGES:
        return 0.0
    return float(gain.mean() / gain.std().clamp(min=1e-9) * len(gain) ** 0.5)
