"""Optical flow between successive frames of a sequence, from ground-truth poses, depths and labels alone.

It is known of what cannot move: the side of a bus that passes keeps its depth, but not the flow that the poses give it.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lidar2pano.calibration import Calibration
from lidar2pano.data.frames import CITYSCAPES_TO_COMMON15, Frame, PanoramaGroundTruth
from lidar2pano.evaluate.panorama_system import SAME_PLACE_M
from lidar2pano.evaluate.resampling import same_raster
from lidar2pano.geometry.camera import panorama_in_camera
from lidar2pano.geometry.depth_completion import complete_depth
from lidar2pano.geometry.flow import Flow, ego_flow, scan_distances
from lidar2pano.geometry.warp import warp
from lidar2pano.labels import COMMON15
from lidar2pano.memory import may_move

SAME_MOUNT_M = 0.02  # calibrations of one mount that are written frame by frame differ by less
SKY = COMMON15.id_of("sky")


def follows(before: Frame | None, now: Frame) -> bool:
    """Whether a frame is the next one of the same sequence, by its number, and both have poses.

    Sets of single frames are numbered, too: without poses the numbers need not be time.
    """
    if before is None or before.pose is None or now.pose is None:
        return False
    (sequence, _, stem), (other, _, last) = now.name.rpartition("/"), before.name.rpartition("/")
    return sequence == other and stem.isdecimal() and last.isdecimal() and int(stem) == int(last) + 1


def relative_pose(before: Frame, now: Frame) -> Tensor:
    """T_before_now (4, 4) float64, metres, of two frames with poses."""
    assert before.pose is not None and now.pose is not None
    return torch.from_numpy(np.linalg.inv(before.pose) @ now.pose)


def camera_flow(before: Frame, now: Frame) -> Flow | None:
    """Flow in the camera, by poses and depths, of a frame that follows another; None without camera labels.

    They tell where the sky is, which has no depth, and what may move, of which the flow is not known.
    """
    if now.calibration is None or now.camera_labels is None or before.camera_labels is None:
        return None
    if now.camera_labels.shape != before.camera_labels.shape:
        return None
    distances = [camera_distances(frame, now.calibration) for frame in (now, before)]
    flow = ego_flow(distances[0], distances[1], relative_pose(before, now), now.calibration)
    return _of_what_stands(flow, CITYSCAPES_TO_COMMON15[now.camera_labels])


def panorama_flow(before: Frame, now: Frame) -> Flow | None:
    """Flow on the ground-truth panorama's raster, by poses and depths, of a frame that follows another.

    None where there are none. It is known only where both panoramas' colours are, and not of what may move, where there
    are labels.
    """
    one, other = now.panorama, before.panorama
    if one is None or other is None or not same_raster(one.view, other.view):
        return None
    if np.abs(np.subtract(one.view.origin, other.view.origin)).max() > SAME_MOUNT_M:
        return None
    distances = [_panorama_distances(frame) for frame in (now, before)]
    if distances[0] is None or distances[1] is None:
        return None
    flow = ego_flow(distances[0], distances[1], relative_pose(before, now), one.view)
    valid = torch.from_numpy(np.array(other.valid))[None, None].float()
    valid_before = warp(valid, flow.shift[None], circular=one.view.circular)[0, 0] > 0.999
    flow = Flow(shift=flow.shift, known=flow.known & valid_before & torch.from_numpy(np.array(one.valid)))
    return flow if one.labels is None else _of_what_stands(flow, np.array(one.labels))


def camera_distances(frame: Frame, calibration: Calibration) -> Tensor:
    """Distances (h, w) for `ego_flow`: those of a dense panorama around this camera, else the scan's."""
    around = frame.panorama
    if around is not None and _is_dense(around):
        apart = np.abs(np.subtract(around.view.origin, calibration.centre)).max()
        distances = _panorama_distances(frame)
        if apart <= SAME_PLACE_M and distances is not None:
            return panorama_in_camera(around.view, calibration).nearest(distances)
    distance = scan_distances(torch.from_numpy(frame.scan.xyz), calibration)
    assert frame.camera_labels is not None
    return distance.where(torch.from_numpy(CITYSCAPES_TO_COMMON15[frame.camera_labels]) != SKY, torch.inf)


def _panorama_distances(frame: Frame) -> Tensor | None:
    """Distances (H, W) on the panorama's raster, infinite in the sky: dense ones, or the scan's completed depth."""
    around = frame.panorama
    assert around is not None
    if _is_dense(around):
        distance = torch.from_numpy(np.array(around.depth_m, dtype=np.float32))
        return torch.where(distance == 0, torch.inf, distance)
    if around.view.kind != "cylinder":
        return None
    return complete_depth(torch.from_numpy(frame.scan.xyz), around.view)


def _of_what_stands(flow: Flow, labels: np.ndarray) -> Flow:
    """The flow, not known of classes that may move; labels: (H, W) uint8 ids of COMMON15."""
    known = flow.known & ~may_move(torch.from_numpy(labels))
    return Flow(shift=flow.shift * known, known=known)


def _is_dense(around: PanoramaGroundTruth) -> bool:
    """Whether every pixel has a depth or is sky, as in simulated panoramas; depths of a scan are sparse."""
    if around.depth_m is None or around.labels is None:
        return False
    return bool(((around.depth_m > 0) | (around.labels == SKY)).all())
