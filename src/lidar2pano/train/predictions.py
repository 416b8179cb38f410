"""A segmenter's labels of all frames that a run uses, made before its first step and kept on disk."""

from __future__ import annotations

import logging
import sys
import time
from contextlib import ExitStack

import torch
from rich.console import Console
from rich.progress import Progress

from lidar2pano.data.cache import PredictedLabels
from lidar2pano.data.frames import Frame, FrameList
from lidar2pano.train.task import LabelPoints, Task

log = logging.getLogger(__name__)
LOG_EVERY_S = 20.0  # where there is no terminal


def predict_all(task: Task, device: torch.device, rank: int = 0, world: int = 1) -> None:
    """Label every frame that the task's data sets want a segmenter's labels of, each process its share.

    What is on disk already is not made again; a list of frames that was complete before is not even read again.
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
    if show:
        log.info("labelling %d scans on %s, once: the labels are kept on disk", len(frames), device)
    logged = time.monotonic()
    if isinstance(label_points, LabelPoints):
        label_points.move(device)
    try:
        with ExitStack() as stack:
            bar = None
            if show and sys.stderr.isatty():
                bar = stack.enter_context(Progress(console=Console(file=sys.stderr)))
                bar.add_task("labelling scans", total=len(frames))
            for number, frame in enumerate(frames, 1):
                predicted.of(frame)
                if bar:
                    bar.advance(bar.task_ids[0])
                elif show and time.monotonic() - logged > LOG_EVERY_S:
                    log.info("labelled %d of %d scans", number, len(frames))
                    logged = time.monotonic()
    finally:
        if isinstance(label_points, LabelPoints):
            label_points.move(torch.device("cpu"))  # processes that prepare samples have no GPU
