"""Ground truth of frames: optical flow, panoramas on its raster, and labels predicted by teachers.

Flow between successive frames of a sequence comes from ground-truth poses, depths and labels alone. It is known of
static things: the side of a passing bus keeps its depth, but not the flow of the poses.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidar2pano.calibration import Calibration
from lidar2pano.data.frames import CITYSCAPES_TO_COMMON15, Frame, PanoramaGroundTruth
from lidar2pano.data.journal import Journal
from lidar2pano.data.semantic_kitti import SemanticKittiFrame
from lidar2pano.evaluate.panorama_system import SAME_PLACE_M
from lidar2pano.geometry.camera import panorama_in_camera, panorama_in_view
from lidar2pano.geometry.flow import Flow, ego_flow, relative_pose, scan_distances
from lidar2pano.geometry.rasters import warp
from lidar2pano.labels import COMMON15
from lidar2pano.memory import may_move
from lidar2pano.panorama import Panorama
from lidar2pano.scene.depth import complete_depth
from lidar2pano.views import View

SAME_MOUNT_M = 0.02  # calibrations of one mount, written frame by frame, differ by less
SKY = COMMON15.id_of("sky")
WINDOWS = 4  # a quarter of KITTI's panorama has about the shape of the camera's image
GREY = 128  # of unknown pixels, on both sides
ZERO = (0.0, 0.0, 0.0)
PARTS = {"point labels": ("labels", ".label"), "camera labels": ("camera_labels", ".png")}


# --- the raster of a ground-truth panorama ----------------------------------------------------------------------------


class Resampled(NamedTuple):
    """A panorama on another raster (H, W); beyond the old one it is black, unlabeled and without depth.

    image (H, W, 3) uint8;  labels (H, W) uint8 of COMMON15;  depth_m (H, W) float32.
    """

    image: np.ndarray
    labels: np.ndarray
    depth_m: np.ndarray


def resampled(panorama: Panorama, view: View) -> Resampled:
    """Return the panorama on the raster `view`; the origins of the two views are ignored."""
    if same_raster(panorama.view, view):
        return Resampled(panorama.colour, panorama.segments, panorama.depth_m)
    lookup = _lookup(replace(panorama.view, origin=ZERO), replace(view, origin=ZERO))
    image = lookup.linear(torch.from_numpy(panorama.colour).movedim(2, 0).float())
    return Resampled(
        image=image.round().movedim(0, 2).to(torch.uint8).numpy(),
        labels=lookup.nearest(torch.from_numpy(panorama.segments)).numpy(),
        depth_m=lookup.nearest(torch.from_numpy(panorama.depth_m)).numpy(),
    )


def same_raster(first: View, second: View) -> bool:
    """Return whether two views have the same pixels, whatever their origins."""
    fields = (astuple(replace(view, kind="sphere", origin=ZERO)) for view in (first, second))
    numbers = [np.array([value for value in values if isinstance(value, int | float)]) for values in fields]
    return first.kind == second.kind and np.allclose(numbers[0], numbers[1], rtol=0, atol=1e-9)


_lookup = lru_cache(maxsize=4)(panorama_in_view)


def windows(predicted: np.ndarray, target: np.ndarray, valid: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield those quarters of two panoramas (H, W, 3) uint8 of at least half valid pixels; the rest is grey in both."""
    hidden = ~valid[..., None]
    sides = [np.where(hidden, np.uint8(GREY), side) for side in (predicted, target)]
    for quarter in np.array_split(np.arange(valid.shape[1]), min(WINDOWS, valid.shape[1])):
        cut = slice(int(quarter[0]), int(quarter[-1]) + 1)
        if valid[:, cut].mean() >= 0.5:
            yield sides[0][:, cut], sides[1][:, cut]


# --- optical flow -----------------------------------------------------------------------------------------------------


def follows(previous: Frame | None, frame: Frame) -> bool:
    """Return whether a frame is the next one of the same sequence, by its number, and both have poses.

    Sets of single frames are numbered, too: without poses the numbers need not be time.
    """
    if previous is None or previous.pose is None or frame.pose is None:
        return False
    (sequence, _, number), (last_sequence, _, last) = frame.name.rpartition("/"), previous.name.rpartition("/")
    decimal = number.isdecimal() and last.isdecimal()
    return sequence == last_sequence and decimal and int(number) == int(last) + 1


def camera_flow(previous: Frame, frame: Frame) -> Flow | None:
    """Return the flow in the camera, by poses and depths, of a frame that follows another; None without camera labels.

    They tell the sky, which has no depth, and moving classes, of unknown flow.
    """
    if frame.calibration is None or frame.camera_labels is None or previous.camera_labels is None:
        return None
    if frame.camera_labels.shape != previous.camera_labels.shape:
        return None
    distances = [camera_distances(item, frame.calibration) for item in (frame, previous)]
    flow = ego_flow(distances[0], distances[1], _motion(previous, frame), frame.calibration)
    return _static(flow, CITYSCAPES_TO_COMMON15[frame.camera_labels])


def panorama_flow(previous: Frame, frame: Frame) -> Flow | None:
    """Return the flow on the ground-truth panorama's raster, by poses and depths, of a frame that follows another.

    None without panoramas or depths. It is known only of pixels with colours in both panoramas and, if there are
    labels, of static classes.
    """
    new, old = frame.panorama, previous.panorama
    if new is None or old is None or not same_raster(new.view, old.view):
        return None
    if np.abs(np.subtract(new.view.origin, old.view.origin)).max() > SAME_MOUNT_M:
        return None
    distances = [_panorama_distances(item) for item in (frame, previous)]
    if distances[0] is None or distances[1] is None:
        return None
    flow = ego_flow(distances[0], distances[1], _motion(previous, frame), new.view)
    valid = torch.from_numpy(np.array(old.valid))[None, None].float()
    old_valid = warp(valid, flow.shift[None], circular=new.view.circular)[0, 0] > 0.999
    flow = Flow(shift=flow.shift, known=flow.known & old_valid & torch.from_numpy(np.array(new.valid)))
    return flow if new.labels is None else _static(flow, np.array(new.labels))


def _motion(previous: Frame, frame: Frame) -> Tensor:
    """Return T_previous_frame (4, 4) float64, metres, of two frames with poses."""
    assert previous.pose is not None and frame.pose is not None
    return relative_pose(previous.pose, frame.pose)


def camera_distances(frame: Frame, calibration: Calibration) -> Tensor:
    """Return distances (h, w) for `ego_flow`: those of a dense panorama around this camera, else the scan's."""
    dense = _dense_distances(frame, calibration)
    if dense is not None:
        return dense
    distance = scan_distances(torch.from_numpy(frame.scan.xyz), calibration)
    assert frame.camera_labels is not None
    return distance.where(torch.from_numpy(CITYSCAPES_TO_COMMON15[frame.camera_labels]) != SKY, torch.inf)


def camera_depth(frame: Frame) -> Tensor | None:
    """Return the true depth (h, w) in the camera, metres, 0 = none; None without a dense panorama around it."""
    dense = None if frame.calibration is None else _dense_distances(frame, frame.calibration)
    return None if dense is None else dense.nan_to_num(posinf=0)


def _dense_distances(frame: Frame, calibration: Calibration) -> Tensor | None:
    """Return distances (h, w) in a dense panorama around this camera, infinite in the sky; None if there is none."""
    panorama = frame.panorama
    if panorama is None or not is_dense(panorama):
        return None
    distances = _panorama_distances(frame)
    offset = np.abs(np.subtract(panorama.view.origin, calibration.centre)).max()
    if distances is None or offset > SAME_PLACE_M:
        return None
    return panorama_in_camera(panorama.view, calibration).nearest(distances)


def _panorama_distances(frame: Frame) -> Tensor | None:
    """Return distances (H, W) on the panorama's raster, infinite in the sky: dense ones, or the scan's completed."""
    panorama = frame.panorama
    assert panorama is not None
    if is_dense(panorama):
        distance = torch.from_numpy(np.array(panorama.depth_m, dtype=np.float32))
        return torch.where(distance == 0, torch.inf, distance)
    if panorama.view.kind != "cylinder":
        return None
    return complete_depth(torch.from_numpy(frame.scan.xyz), panorama.view)


def _static(flow: Flow, labels: np.ndarray) -> Flow:
    """Return the flow, unknown of moving classes; labels: (H, W) uint8 ids of COMMON15."""
    known = flow.known & ~may_move(torch.from_numpy(labels))
    return Flow(shift=flow.shift * known, known=known)


def is_dense(panorama: PanoramaGroundTruth) -> bool:
    """Return whether every pixel has a depth or is sky, as in simulated panoramas; depths of a scan are sparse."""
    if panorama.depth_m is None or panorama.labels is None:
        return False
    return bool(((panorama.depth_m > 0) | (panorama.labels == SKY)).all())


# --- labels of teachers -----------------------------------------------------------------------------------------------


def pseudo_labels(frame: Frame) -> dict[str, str]:
    """Return parts of a frame ("point labels", "camera labels") written by a teacher -> the teacher's hash.

    They are scored like ground truth. A file counts as the teacher's while it has the size and the modification time in
    the journal of `prepare`.
    """
    if not isinstance(frame, SemanticKittiFrame):
        return {}
    teachers, journal = {}, _journal(frame.folder)
    for part, (folder, suffix) in PARTS.items():
        path = frame.file(folder, suffix)
        record = next(iter(journal.of(f"{folder}/{path.name}")), None)
        if record and path.is_file():
            status = path.stat()
            if (status.st_size, status.st_mtime_ns) == (record.stamp.size, record.stamp.changed_ns):
                teachers[part] = record.made_by
    return teachers


_journal = lru_cache(maxsize=1)(Journal)
