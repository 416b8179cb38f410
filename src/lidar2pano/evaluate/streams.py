"""Frames that follow each other: where each one's pixels were in the one before, by the truth alone."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lidar2pano.calibration import Calibration
from lidar2pano.data.truths import TruePanorama, Truth
from lidar2pano.evaluate.around import SAME_PLACE_M
from lidar2pano.evaluate.rasters import same_raster
from lidar2pano.geometry.camera import panorama_in_camera
from lidar2pano.geometry.depth_completion import complete_depth
from lidar2pano.geometry.flow import Flow, ego_flow, scan_distances
from lidar2pano.geometry.warp import warp
from lidar2pano.labels import COMMON15

SAME_MOUNT_M = 0.02  # calibrations that are written frame by frame differ by less
SKY = COMMON15.id_of("sky")


def follows(before: Truth | None, now: Truth) -> bool:
    """Whether a frame is the next one of the same sequence, by its number, and both have poses.

    Sets of single frames are numbered, too: without poses nothing says that numbers are time.
    """
    if before is None or before.pose is None or now.pose is None:
        return False
    (sequence, _, stem), (other, _, last) = now.name.rpartition("/"), before.name.rpartition("/")
    return sequence == other and stem.isdecimal() and last.isdecimal() and int(stem) == int(last) + 1


def motion(before: Truth, now: Truth) -> Tensor:
    """(4, 4) float64: the scan's coordinates now -> those before, metres, of a frame that follows another."""
    assert before.pose is not None and now.pose is not None
    return torch.from_numpy(np.linalg.inv(before.pose) @ now.pose)


def camera_flow(before: Truth, now: Truth) -> Flow | None:
    """Flow in the camera, by poses and depths, of a frame that follows another; None where classes are not known.

    Without them the sky, which has no depth, is not known either.
    """
    if now.calibration is None or now.camera_ids is None or before.camera_ids is None:
        return None
    if now.camera_ids.shape != before.camera_ids.shape:
        return None
    far = [camera_distances(truth, now.calibration) for truth in (now, before)]
    return ego_flow(far[0], far[1], motion(before, now), now.calibration)


def panorama_flow(before: Truth, now: Truth) -> Flow | None:
    """Flow on the truth panorama's raster, by poses and depths, of a frame that follows another.

    None where there are none. Known only where both panoramas' colours are, too.
    """
    one, other = now.panorama, before.panorama
    if one is None or other is None or not same_raster(one.view, other.view):
        return None
    if np.abs(np.subtract(one.view.origin, other.view.origin)).max() > SAME_MOUNT_M:
        return None
    far = [_around(truth) for truth in (now, before)]
    if far[0] is None or far[1] is None:
        return None
    flow = ego_flow(far[0], far[1], motion(before, now), one.view)
    valid = torch.from_numpy(np.array(other.valid))[None, None].float()
    there = warp(valid, flow.shift[None], closed=one.view.circular)[0, 0] > 0.999
    return Flow(shift=flow.shift, known=flow.known & there & torch.from_numpy(np.array(one.valid)))


def camera_distances(truth: Truth, calibration: Calibration) -> Tensor:
    """Distances (h, w) as `ego_flow` takes them: the drawn panorama's around this camera, else the scan's."""
    around = truth.panorama
    if around is not None and _drawn(around):
        apart = np.abs(np.subtract(around.view.origin, calibration.centre)).max()
        far = _around(truth)
        if apart <= SAME_PLACE_M and far is not None:
            return panorama_in_camera(around.view, calibration).nearest(far)
    distance = scan_distances(torch.from_numpy(truth.scan.xyz), calibration)
    assert truth.camera_ids is not None
    return distance.where(torch.from_numpy(np.array(truth.camera_ids)) != SKY, torch.inf)


def _around(truth: Truth) -> Tensor | None:
    """Distances (H, W) on the panorama's raster, infinite in the sky: drawn, or the scan's with its gaps filled."""
    around = truth.panorama
    assert around is not None
    if _drawn(around):
        distance = torch.from_numpy(np.array(around.depth_m, dtype=np.float32))
        return torch.where(distance == 0, torch.inf, distance)
    if around.view.kind != "cylinder":
        return None
    return complete_depth(torch.from_numpy(truth.scan.xyz), around.view)


def _drawn(around: TruePanorama) -> bool:
    """Whether every pixel has a depth or is sky, as where the truth is simulated; a scan's own depths are sparse."""
    if around.depth_m is None or around.ids is None:
        return False
    return bool(((around.depth_m > 0) | (around.ids == SKY)).all())
