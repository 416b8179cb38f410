"""A segmenter's labels of all frames of a run, made before its first step and kept on disk."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext

import torch
from torch import Tensor

from lidar2pano.data.cache import PredictedLabels
from lidar2pano.data.frames import Frame, FrameList
from lidar2pano.models.card import load
from lidar2pano.pipeline import Segmenter
from lidar2pano.progress import working
from lidar2pano.scan import Scan
from lidar2pano.train.task import Task


def load_segmenter(file: str) -> Callable[[Scan], Tensor]:
    """Read a LiDAR segmenter's weight file: scan -> labels (N,) of SEMANTIC_KITTI."""
    return LabelPoints(Segmenter.from_card(*load(file, expect="salsanext")))


class LabelPoints:
    """A segmenter as a function of scans, on a movable device."""

    def __init__(self, segmenter: Segmenter) -> None:
        self.segmenter, self.device = segmenter, torch.device("cpu")

    def __call__(self, scan: Scan) -> Tensor:
        """Labels (N,) of SEMANTIC_KITTI."""
        return self.segmenter.points(scan, self.device)

    def move(self, device: torch.device) -> None:
        """Compute there from now on."""
        self.device = device
        self.segmenter.network.to(device)


def predict_all(task: Task, device: torch.device, rank: int = 0, world: int = 1) -> None:
    """Label the frames of the task's data sets that need a segmenter's labels, each process its share.

    Labels on disk are not made again; a list noted as complete is not even read again.
    """
    for samples in (task.dataset, getattr(task, "validation", None)):
        predicted = getattr(samples, "predicted", None)
        frames: FrameList[Frame] | None = getattr(samples, "frames", None)
        if isinstance(predicted, PredictedLabels) and frames is not None and not predicted.complete(frames):
            _predict(predicted, frames[rank::world], device, show=rank == 0)
            if world == 1:
                predicted.note_complete(frames)


def _predict(predicted: PredictedLabels, frames: FrameList[Frame], device: torch.device, *, show: bool) -> None:
    label_points = predicted.label_points
    if isinstance(label_points, LabelPoints):
        label_points.move(device)
    try:
        title = f"labelling {len(frames)} scans on {device}, once: the labels are kept on disk"
        with working(title, len(frames)) if show else nullcontext(lambda: None) as advance:
            for frame in frames:
                predicted.of(frame)
                advance()
    finally:
        if isinstance(label_points, LabelPoints):
            label_points.move(torch.device("cpu"))  # processes for samples have no GPU
