"""A system under evaluation: its input, prediction and contract, and the systems of panoramas."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from lidar2pano.calibration import Calibration
from lidar2pano.geometry.camera import panorama_in_camera
from lidar2pano.hardware import Timer
from lidar2pano.memory import Memory
from lidar2pano.panorama import Panorama
from lidar2pano.pipeline import Pipeline
from lidar2pano.pipeline.belief import TINY
from lidar2pano.scan import Scan
from lidar2pano.scene.record import Scene

SAME_PLACE_M = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SystemInput:
    """Input of a system for one frame: the scan, and the requested viewpoints.

    calibration    the camera of the requested image, at its size; None: no camera.
    origin         the centre of the requested panorama in the scan's frame, metres; None: no panorama.
    camera_labels  (h, w) uint8 ids of COMMON15, unknown: 0; ground truth, for the oracle only.
    colours        whether colours are requested, or only classes and depths.
    pose           (4, 4) float64 T_world_sensor, metres; None if unknown.
    """

    scan: Scan
    calibration: Calibration | None = None
    origin: tuple[float, float, float] | None = None
    camera_labels: np.ndarray | None = None
    colours: bool = True
    pose: np.ndarray | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prediction:
    """Output of a system for one frame; missing parts are None.

    point_labels   (N,) integer ids of SEMANTIC_KITTI of the scan's points.
    camera_labels  (h, w) integer ids of COMMON15 in the camera's image.
    image          (h, w, 3) uint8 RGB, the camera's image.
    depth_m        (h, w) float32 metres along the ray in the camera's image; 0 = none.
    panorama       the 360-degree panorama;  painted: whether its colours are predicted, not only classes and depths.
    milliseconds   time per stage of the camera's image, or of the panorama if no camera was requested.
    """

    point_labels: np.ndarray | None = None
    camera_labels: np.ndarray | None = None
    image: np.ndarray | None = None
    depth_m: np.ndarray | None = None
    panorama: Panorama | None = None
    painted: bool = True
    milliseconds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class SystemInfo:
    """Name, weights and card entries of a system.

    name      as the user gave it;  files: weight files by role;  networks: per role, entries of its card.
    """

    name: str
    files: Mapping[str, Path] = field(default_factory=dict)
    networks: Mapping[str, dict[str, Any]] = field(default_factory=dict)


class System(Protocol):
    """A predictor of images from a scan."""

    @property
    def info(self) -> SystemInfo:
        """Name and weights."""
        ...

    @property
    def uses_ground_truth(self) -> bool:
        """True for the oracle, with ground-truth labels as input."""
        ...

    def predict(self, inputs: SystemInput, memory: Any = None) -> tuple[Any, Prediction]:  # noqa: ANN401
        """Predict one frame; returns the memory for the next frame, and the prediction.

        memory  its memory of the previous frame; None at the beginning of a sequence.
        Raises InputError for a scan without usable points.
        """
        ...


class NoPainter:
    """A painter whose panoramas are grey, for systems without colours."""

    def paint(self, past: Any, scene: Scene, look: str = "") -> tuple[Any, Tensor]:  # noqa: ANN401, ARG002
        """Paint a scene; arguments and answer as of StreamPainter."""
        return past, scene.depth_m.new_zeros(1, 3, 2 * scene.view.rows, 2 * scene.view.columns)


class _View(NamedTuple):
    """The scene around one viewpoint, and its panorama where one was requested."""

    scene: Scene
    panorama: Panorama | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PanoramaSystem:
    """`titan-pano` and a painter of panoramas.

    The camera's classes and depths are sampled from the scene around the camera's optical centre, fused over time in a
    steady system, its colours from the panorama. A panorama around another point is a second run.

    paints  whether it has a painter;  steady: whether it uses the sensor's pose, where it is known, to smooth its
            panoramas over time.
    """

    info: SystemInfo
    pipeline: Pipeline
    paints: bool = True
    uses_ground_truth: bool = False
    steady: bool = False

    @torch.inference_mode()
    def predict(self, inputs: SystemInput, memory: Any = None) -> tuple[Any, Prediction]:  # noqa: ANN401
        """Predict one frame; arguments and answer as of System."""
        pipeline, calibration = self.pipeline, inputs.calibration
        viewpoints = _viewpoints(inputs)
        if not viewpoints:
            fitted = pipeline.fitted(inputs.scan, Memory())
            points = fitted.measure(inputs.scan, Timer(pipeline.device)).points  # labelled as for a panorama
            return memory, Prediction(point_labels=points.labels.cpu().numpy())
        memories: dict[str, Memory] = dict(memory or {})
        views: dict[str, _View] = {}
        timer = Timer(pipeline.device)
        for number, (name, place) in enumerate(viewpoints.items()):
            moved = replace(pipeline, view=replace(pipeline.view, origin=place))
            if not inputs.colours:
                moved = replace(moved, painter=NoPainter())
            own_timer = Timer(pipeline.device) if number else timer
            memory_before = memories.get(name, Memory())
            moved = moved.fitted(inputs.scan, memory_before)
            scene, panorama = moved.translate(inputs.scan, own_timer), None
            pose = inputs.pose if self.steady else None
            memories[name], scene = moved.remember(memory_before, scene, pose, own_timer)
            if inputs.colours or name == "panorama" or (len(viewpoints) == 1 and inputs.origin is not None):
                memories[name], panorama = moved.paint(memories[name], scene, own_timer)
            views[name] = _View(scene, panorama)
        panorama_view = views.get("panorama", views.get("camera")) if inputs.origin is not None else None
        prediction = Prediction(
            point_labels=_labels(next(iter(views.values())).scene),
            panorama=panorama_view.panorama if panorama_view else None,
            painted=self.paints and inputs.colours,
            milliseconds=timer.milliseconds,
        )
        if calibration is None:
            return memories, prediction
        return memories, self._in_camera(prediction, views["camera"], calibration, timer)

    def _in_camera(self, prediction: Prediction, view: _View, calibration: Calibration, timer: Timer) -> Prediction:
        """Add the camera's classes, depths and image to the prediction."""
        with timer("camera"):
            scene = view.scene
            lookup = panorama_in_camera(scene.view, calibration).to(scene.depth_m.device)
            ids = lookup.linear(scene.probabilities[0].clamp(min=TINY).log()).max(0).indices
            depth_m = lookup.linear(scene.depth_m[0])
        image: np.ndarray | None = None
        if prediction.painted and view.panorama is not None:
            image = view.panorama.to_camera(calibration).colour
        return replace(prediction, camera_labels=ids.cpu().numpy(), depth_m=depth_m.cpu().numpy(), image=image)


def _labels(scene: Scene) -> np.ndarray:
    assert scene.points is not None, "scenes of scans have them"
    return scene.points.labels.cpu().numpy()


def _viewpoints(inputs: SystemInput) -> dict[str, tuple[float, float, float]]:
    """Return the origins of "camera" and "panorama"; where they are the same, only of "camera"."""
    viewpoints: dict[str, tuple[float, float, float]] = {}
    if inputs.calibration is not None:
        viewpoints["camera"] = inputs.calibration.centre
    if inputs.origin is not None:
        apart = np.abs(np.subtract(viewpoints.get("camera", np.inf), inputs.origin)).max()
        if apart > SAME_PLACE_M:
            viewpoints["panorama"] = inputs.origin
    return viewpoints
