"""Evaluation of systems: every system predicts every frame, one frame at a time, and metrics are counted."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lidar2pano.data.frames import CITYSCAPES_TO_COMMON15, IGNORE, Frame
from lidar2pano.errors import InputError
from lidar2pano.evaluate.ground_truth_flow import camera_flow, follows, panorama_flow
from lidar2pano.evaluate.interface import Prediction, System, SystemInput
from lidar2pano.evaluate.metric_config import MetricConfig
from lidar2pano.evaluate.metric_values import SECTOR_ORDER, MetricCollection, MetricValue, PreviousImage
from lidar2pano.evaluate.pseudo_labels import pseudo_labels
from lidar2pano.evaluate.resampling import Resampled, resampled
from lidar2pano.evaluate.worst_frames import WorstFrame, WorstFrames, sheet
from lidar2pano.geometry.flow import Flow
from lidar2pano.scan import Scan

ROLL = 5 / 16  # of a full turn: a whole number of columns of every raster that networks use


@dataclass(frozen=True, slots=True, kw_only=True)
class Flows:
    """Whether a frame follows the previous one in a sequence, and the flow of each sector where it is known."""

    following: bool
    camera: Flow | None = None
    panorama: Flow | None = None


@dataclass(slots=True, kw_only=True)
class EvaluatedSystem:
    """A system under evaluation and its metrics.

    memory, image, around  from the previous frame: the system's memory, its camera image, its panorama.
    milliseconds           per stage, one entry per frame.
    """

    system: System
    metrics: MetricCollection
    worst: WorstFrames
    memory: Any = None
    image: np.ndarray | None = None
    around: Resampled | None = None
    milliseconds: dict[str, list[float]] = field(default_factory=dict)

    def evaluate(self, frame: Frame, inputs: SystemInput, flows: Flows) -> None:
        """Predict a frame and count the prediction."""
        if not flows.following:
            self.memory = self.image = self.around = None
        given = inputs if self.system.uses_ground_truth else replace(inputs, camera_labels=None)
        self.memory, prediction = self.system.predict(given, self.memory)
        for stage, value in prediction.milliseconds.items():
            self.milliseconds.setdefault(stage, []).append(value)
        self.metrics.points(frame, prediction)
        self.metrics.camera(frame, prediction, _previous(self.image, flows.camera))
        around = None
        if prediction.panorama is not None and frame.panorama is not None:
            around = resampled(prediction.panorama, frame.panorama.view)
            before = None if self.around is None else self.around.image
            self.metrics.panorama(frame, around, prediction.painted, _previous(before, flows.panorama))
            if prediction.painted:
                self.metrics.seam(prediction.panorama.colour, frame.name)
            if "roll" in self.metrics.config.groups:
                self._roll(frame.name, inputs, flows, prediction)
        self.image, self.around = prediction.image, around
        ranked = self.metrics.rank(frame.name) if self.worst.number else None
        if ranked is not None and self.worst.wanted(ranked[1]):
            self.worst.take(WorstFrame(frame.name, *ranked, sheet(frame, prediction, around)))

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
        other = self.system.predict(replace(inputs, scan=scan, calibration=None, origin=(x, y, z)))[1].panorama
        if straight is not None and other is not None:
            pair = [Resampled(one.colour, one.segments, one.depth_m) for one in (straight, other)]
            self.metrics.roll(pair[0], pair[1], columns, name)

    def mean_milliseconds(self) -> dict[str, float]:
        """Mean per stage; the first frame, which warms up, is left out where there are several."""
        return {
            stage: sum(warm) / len(warm) for stage, times in self.milliseconds.items() if (warm := times[1:] or times)
        }


@dataclass(slots=True, kw_only=True)
class Evaluation:
    """The result of `score`.

    images     number of frames with camera labels;  scans: with point labels;  camera_images: with a camera image;
               panoramas: with a ground-truth panorama.
    pseudo_labels  number of frames by part ("point labels", ...) and hash of the teacher that predicted it.
    reference  metrics of the ground truth itself: seams, warping error, re-segmentation.
    """

    systems: Sequence[EvaluatedSystem]
    reference: MetricCollection
    config: MetricConfig
    data: str
    split: str
    images: int = 0
    scans: int = 0
    camera_images: int = 0
    panoramas: int = 0
    pseudo_labels: Counter[tuple[str, str]] = field(default_factory=Counter)

    def target_classes(self, sector: str = "camera") -> list[int]:
        """The classes that the sector's targets have: mIoU is the mean over them, whatever is predicted."""
        found = (one.metrics.target_classes(sector) for one in self.systems)
        return next((ids for ids in found if ids is not None), [])

    def values(self, metrics: MetricCollection) -> list[MetricValue]:
        """Every value of a system's metrics, or of the reference."""
        return list(metrics.values({sector: self.target_classes(sector) for sector in SECTOR_ORDER}))


def score(
    systems: Sequence[System],
    frames: Iterable[Frame],
    *,
    data: str,
    split: str,
    config: MetricConfig | None = None,
    worst: int = 0,
    after_each: Callable[[], None] = lambda: None,
) -> Evaluation:
    """Let every system predict every frame, and count metrics.

    config  all that data and weights allow, when None;  worst: how many of a system's worst frames are kept.
    On each frame the metrics are counted whose ground truth it has. Frames with successive numbers in one sequence are
    a video. Only the current and the previous frame are held.
    Raises InputError for a frame without any ground truth, and for files that are missing, damaged or do not fit.
    """
    config = config or MetricConfig()
    evaluated = [
        EvaluatedSystem(system=one, metrics=MetricCollection(config), worst=WorstFrames(worst)) for one in systems
    ]
    reference = MetricCollection(config)
    result = Evaluation(systems=evaluated, reference=reference, config=config, data=data, split=split)
    before: Frame | None = None
    for frame in frames:
        _count_parts(result, frame)
        inputs, flows = system_input(frame, config), _flows(before, frame, config)
        for one in evaluated:
            one.evaluate(frame, inputs, flows)
        _count_reference(reference, before, frame, flows)
        before = frame
        after_each()
    return result


def system_input(frame: Frame, config: MetricConfig) -> SystemInput:
    """The input of systems for a frame: every viewpoint at which there is ground truth to compare with."""
    camera = config.has("camera") and (frame.camera_labels is not None or frame.image is not None)
    around = frame.panorama if config.has("panorama") else None
    labels = None
    if camera and frame.camera_labels is not None:
        labels = CITYSCAPES_TO_COMMON15[frame.camera_labels]
        labels[labels == IGNORE] = 0
    return SystemInput(
        scan=frame.scan,
        calibration=frame.calibration if camera else None,
        origin=None if around is None else around.view.origin,
        camera_labels=labels,
        colours=config.colours,
        pose=frame.pose,
    )


def rotated(scan: Scan, columns: int, width: int) -> tuple[Scan, np.ndarray]:
    """The scan rotated about the sensor's axis so that panoramas of `width` columns move right by `columns`.

    Also the rotation itself, (3, 3) float64.
    """
    angle = -columns * math.tau / width
    R = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    return replace(scan, xyz=(scan.xyz.astype(np.float64) @ R.T).astype(np.float32)), R


def _count_parts(result: Evaluation, frame: Frame) -> None:
    """Count which ground truth a frame has; InputError where it has none."""
    parts = (frame.camera_labels, frame.point_labels, frame.image, frame.panorama)
    if all(part is None for part in parts):
        raise InputError(f"{frame.name} has neither camera_labels/ nor labels/, and no image; label it first")
    for name, part in zip(("images", "scans", "camera_images", "panoramas"), parts, strict=True):
        setattr(result, name, getattr(result, name) + (part is not None))
    result.pseudo_labels.update(pseudo_labels(frame).items())


def _flows(before: Frame | None, now: Frame, config: MetricConfig) -> Flows:
    if before is None or not follows(before, now):
        return Flows(following=False)
    timed = "time" in config.groups
    return Flows(
        following=True,
        camera=camera_flow(before, now) if timed and "camera" in config.sectors else None,
        panorama=panorama_flow(before, now) if timed and "panorama" in config.sectors else None,
    )


def _count_reference(reference: MetricCollection, before: Frame | None, now: Frame, flows: Flows) -> None:
    """Count the ground truth itself, by the metrics that need an image alone."""
    sectors = reference.config.sectors
    if now.image is not None and "camera" in sectors:
        reference.resegmentation(now.image, now)
        if previous := _previous(None if before is None else before.image, flows.camera):
            reference.warping("camera", now.image, previous, now.name)
    around = now.panorama
    if around is None or "panorama" not in sectors:
        return
    rows = around.valid.all(1)
    if around.view.circular and rows.any():
        reference.seam(np.ascontiguousarray(around.image[rows]), now.name)
    earlier = None if before is None or before.panorama is None else before.panorama.image
    if previous := _previous(earlier, flows.panorama):
        reference.warping("panorama", around.image, previous, now.name)


def _previous(image: np.ndarray | None, flow: Flow | None) -> PreviousImage | None:
    return None if image is None or flow is None else PreviousImage(image=image, flow=flow)
