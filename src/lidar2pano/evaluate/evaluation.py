"""Evaluation of systems: every system predicts every frame, one frame at a time, and metrics are counted."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lidar2pano.data.frames import CITYSCAPES_TO_COMMON15, IGNORE, Frame
from lidar2pano.data.surround import SurroundFrame
from lidar2pano.errors import InputError
from lidar2pano.evaluate.ground_truth import (
    Resampled,
    camera_flow,
    follows,
    panorama_flow,
    pseudo_labels,
    resampled,
)
from lidar2pano.evaluate.metric_collection import (
    SECTOR_ORDER,
    MetricCollection,
    MetricConfig,
    MetricValue,
)
from lidar2pano.evaluate.panorama_system import Prediction, System, SystemInput
from lidar2pano.evaluate.pictures import WorstFrame, WorstFrames, sheet
from lidar2pano.geometry.flow import Flow
from lidar2pano.scan import Scan

ROLL = 5 / 16  # of a full turn: a whole number of columns of every network's raster


@dataclass(frozen=True, slots=True, kw_only=True)
class Flows:
    """A frame's relation to the previous one: whether it follows in a sequence, and known flows of the sectors."""

    following: bool
    camera: Flow | None = None
    panorama: Flow | None = None


@dataclass(slots=True, kw_only=True)
class EvaluatedSystem:
    """A system under evaluation and its metrics.

    memory, image, panorama  from the previous frame: the system's memory, its camera image, its panorama.
    milliseconds             per stage, one entry per frame.
    """

    system: System
    metrics: MetricCollection
    worst: WorstFrames
    memory: Any = None
    image: np.ndarray | None = None
    panorama: Resampled | None = None
    milliseconds: dict[str, list[float]] = field(default_factory=dict)

    def evaluate(self, frame: Frame, inputs: SystemInput, flows: Flows) -> None:
        """Predict a frame and count the prediction."""
        if not flows.following:
            self.memory = self.image = self.panorama = None
        system_inputs = inputs if self.system.uses_ground_truth else replace(inputs, camera_labels=None)
        self.memory, prediction = self.system.predict(system_inputs, self.memory)
        for stage, value in prediction.milliseconds.items():
            self.milliseconds.setdefault(stage, []).append(value)
        self.metrics.points(frame, prediction)
        self.metrics.camera(frame, prediction)
        self.metrics.warping("camera", prediction.image, self.image, flows.camera, frame.name)
        panorama = None
        if prediction.panorama is not None and frame.panorama is not None:
            panorama = resampled(prediction.panorama, frame.panorama.view)
            self.metrics.panorama(frame, panorama, prediction.painted)
            if prediction.painted:
                self.metrics.seam(prediction.panorama.colour, frame.name)
                previous = None if self.panorama is None else self.panorama.image
                self.metrics.warping("panorama", panorama.image, previous, flows.panorama, frame.name)
            if "roll" in self.metrics.config.groups:
                self._roll(frame.name, inputs, flows, prediction)
        self.image, self.panorama = prediction.image, panorama
        rank = self.metrics.rank(frame.name) if self.worst.number else None
        if rank is not None and self.worst.wanted(rank[1]):
            self.worst.take(WorstFrame(frame.name, *rank, sheet(frame, prediction, panorama)))

    def _roll(self, name: str, inputs: SystemInput, flows: Flows, prediction: Prediction) -> None:
        """Predict the scan rotated about the sensor's axis; both predictions begin a sequence."""
        if inputs.origin is None or prediction.panorama is None:
            return
        straight, width = prediction.panorama, prediction.panorama.view.columns
        columns = round(ROLL * width)
        if flows.following:
            straight = self.system.predict(replace(inputs, calibration=None))[1].panorama
        scan, R = rotated(inputs.scan, columns, width)
        x, y, z = (R @ np.array(inputs.origin)).tolist()
        turned = self.system.predict(replace(inputs, scan=scan, calibration=None, origin=(x, y, z)))[1].panorama
        if straight is not None and turned is not None:
            pair = [Resampled(item.colour, item.segments, item.depth_m) for item in (straight, turned)]
            self.metrics.roll(pair[0], pair[1], columns, name)

    def mean_milliseconds(self) -> dict[str, float]:
        """Return the mean per stage; of several frames the first, for warming up, is left out."""
        return {
            stage: sum(warm) / len(warm) for stage, times in self.milliseconds.items() if (warm := times[1:] or times)
        }


@dataclass(slots=True, kw_only=True)
class Evaluation:
    """The result of `score`.

    counts     of frames: "images" with camera labels;  "scans" with point labels;  "camera_images" with a camera image;
               "panoramas" with a ground-truth panorama, real ones stitched from "stitched_images" in all;
               "following" another frame of their sequence, both with poses.
    pseudo_labels  number of frames by part ("point labels", ...) and hash of the teacher of its labels.
    reference  metrics of the ground truth itself: seams, warping error, re-segmentation.
    """

    systems: Sequence[EvaluatedSystem]
    reference: MetricCollection
    config: MetricConfig
    data: str
    split: str
    counts: Counter[str] = field(default_factory=Counter)
    pseudo_labels: Counter[tuple[str, str]] = field(default_factory=Counter)

    def target_classes(self, sector: str = "camera") -> list[int]:
        """Return the classes of the sector's targets: mIoU is the mean over them, for every prediction."""
        classes = (system.metrics.target_classes(sector) for system in self.systems)
        return next((ids for ids in classes if ids is not None), [])

    def values(self, metrics: MetricCollection) -> list[MetricValue]:
        """Return every value of a system's metrics, or of the reference."""
        return list(metrics.values({sector: self.target_classes(sector) for sector in SECTOR_ORDER}))


def score(
    systems: Sequence[System],
    frames: Iterable[Frame],
    *,
    data: str,
    split: str,
    config: MetricConfig | None = None,
    worst: int = 0,
    after_each: Callable[[Frame, Sequence[EvaluatedSystem]], None] = lambda frame, systems: None,  # noqa: ARG005
) -> Evaluation:
    """Let every system predict every frame, and count metrics.

    config  everything within data and weights, when None;  worst: number of a system's worst frames to keep.
    after_each  is told each frame and the systems, whose `image` is the one of this frame.
    Metrics without ground truth on a frame are left out there. Frames with successive numbers in one sequence are a
    video. Only the current and the previous frame are held.
    Raises InputError for a frame without any ground truth, and for missing, damaged or unfit files.
    """
    config = config or MetricConfig()
    evaluated = [
        EvaluatedSystem(system=system, metrics=MetricCollection(config), worst=WorstFrames(worst)) for system in systems
    ]
    reference = MetricCollection(config)
    result = Evaluation(systems=evaluated, reference=reference, config=config, data=data, split=split)
    previous: Frame | None = None
    for frame in frames:
        _count_parts(result, frame)
        inputs, flows = system_input(frame, config), _flows(previous, frame, config)
        result.counts["following"] += flows.following
        for system in evaluated:
            system.evaluate(frame, inputs, flows)
        _count_reference(reference, previous, frame, flows)
        previous = frame
        after_each(frame, evaluated)
    return result


def system_input(frame: Frame, config: MetricConfig) -> SystemInput:
    """Return the input of systems for a frame: every viewpoint with ground truth."""
    camera = config.has("camera") and (frame.camera_labels is not None or frame.image is not None)
    panorama = frame.panorama if config.has("panorama") else None
    labels = None
    if camera and frame.camera_labels is not None:
        labels = CITYSCAPES_TO_COMMON15[frame.camera_labels]
        labels[labels == IGNORE] = 0
    return SystemInput(
        scan=frame.scan,
        calibration=frame.calibration if camera else None,
        origin=None if panorama is None else panorama.view.origin,
        camera_labels=labels,
        colours=config.colours,
        pose=frame.pose,
    )


def rotated(scan: Scan, columns: int, width: int) -> tuple[Scan, np.ndarray]:
    """Rotate the scan about the sensor's axis: panoramas of `width` columns move right by `columns`.

    Returns the rotation as well, (3, 3) float64.
    """
    angle = -columns * math.tau / width
    R = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    return replace(scan, xyz=(scan.xyz.astype(np.float64) @ R.T).astype(np.float32)), R


def _count_parts(result: Evaluation, frame: Frame) -> None:
    """Count the ground truth of a frame; InputError if it has none."""
    parts = (frame.camera_labels, frame.point_labels, frame.image, frame.panorama)
    if all(part is None for part in parts):
        raise InputError(f"{frame.name} has neither camera_labels/ nor labels/, and no image; label it first")
    for name, part in zip(("images", "scans", "camera_images", "panoramas"), parts, strict=True):
        result.counts[name] += part is not None
    if isinstance(frame, SurroundFrame) and frame.panorama is not None:
        result.counts["stitched_images"] += len(frame.camera_names)
    result.pseudo_labels.update(pseudo_labels(frame).items())


def _flows(previous: Frame | None, frame: Frame, config: MetricConfig) -> Flows:
    if previous is None or not follows(previous, frame):
        return Flows(following=False)
    timed = "time" in config.groups
    return Flows(
        following=True,
        camera=camera_flow(previous, frame) if timed and "camera" in config.sectors else None,
        panorama=panorama_flow(previous, frame) if timed and "panorama" in config.sectors else None,
    )


def _count_reference(reference: MetricCollection, previous: Frame | None, frame: Frame, flows: Flows) -> None:
    """Count the ground truth itself, by the metrics of an image alone."""
    sectors, panorama = reference.config.sectors, frame.panorama
    if frame.image is not None and "camera" in sectors:
        reference.resegmentation(frame.image, frame)
        image_before = None if previous is None else previous.image
        reference.warping("camera", frame.image, image_before, flows.camera, frame.name)
    if panorama is None or "panorama" not in sectors:
        return
    rows = panorama.valid.all(1)
    if panorama.view.circular and rows.any():
        reference.seam(np.ascontiguousarray(panorama.image[rows]), frame.name)
    panorama_before = None if previous is None else previous.panorama
    image_before = None if panorama_before is None else panorama_before.image
    reference.warping("panorama", panorama.image, image_before, flows.panorama, frame.name)
