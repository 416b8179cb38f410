"""Optical flow of two images, where there are no poses: OpenCV's DIS."""

from __future__ import annotations

import torch
from torch import Tensor

from lidar2pano.errors import InputError
from lidar2pano.geometry.flow import Flow, reaches
from lidar2pano.geometry.warp import warp


def optical_flow(now: Tensor, before: Tensor) -> Flow:
    """Flow from an image (3, H, W) uint8 RGB to the one before: (2, H, W) pixels and (H, W) bool.

    Kroeger et al. 2016 (arXiv:1603.03590), preset "medium". Known where the flow forth and that back undo each other
    as far as Sundaram et al. 2010 (ECCV), equation 5, ask: |w + w'|^2 < 0.01 (|w|^2 + |w'|^2) + 0.5.
    Raises InputError where OpenCV is not installed.
    """
    forth, back = _dis(now, before), _dis(before, now)
    returned = warp(back[None], forth[None])[0]
    gap, length = (forth + returned).square().sum(0), forth.square().sum(0) + returned.square().sum(0)
    known = (gap < 0.01 * length + 0.5) & reaches(forth[None])[0]
    return Flow(shift=forth * known, known=known)


def _dis(first: Tensor, second: Tensor) -> Tensor:
    """(2, H, W) float32: where what `first` shows lies in `second`."""
    try:
        import cv2
    except ModuleNotFoundError as error:
        raise InputError("flow without poses.txt needs OpenCV: pip install 'lidar2pano[flow]'") from error
    grey = [cv2.cvtColor(image.movedim(0, 2).numpy().copy(), cv2.COLOR_RGB2GRAY) for image in (first, second)]
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return torch.from_numpy(dis.calc(grey[0], grey[1], None)).movedim(2, 0).contiguous()  # pyright: ignore[reportCallIssue, reportArgumentType]
