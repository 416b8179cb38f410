"""Cameras hidden in turn: their views predicted from the scan alone, and from the scan with the other cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano.data.frames import Frame
from lidar2pano.data.surround import SurroundFrame
from lidar2pano.drives.camera_choice import CameraOptions
from lidar2pano.drives.cameras import cameras_of
from lidar2pano.errors import InputError, closest
from lidar2pano.evaluate.metric_collection import PatchFeatures
from lidar2pano.evaluate.pictures import captioned
from lidar2pano.formats.image_files import write_png, write_whole
from lidar2pano.geometry.stitching import Camera
from lidar2pano.hardware import Timer
from lidar2pano.markdown import markdown_table
from lidar2pano.memory import Memory
from lidar2pano.metrics.accumulation import FrameMetric, Interval, SetMetric, interval, set_intervals
from lidar2pano.metrics.frame_metrics import SSIM, ClassColourError, FeatureDistance
from lidar2pano.metrics.frechet import PatchFrechetDistance
from lidar2pano.panorama import Panorama
from lidar2pano.pipeline import Pipeline
from lidar2pano.pipeline.composition import sound_cameras
from lidar2pano.scan import Scan

EACH = "each"  # in place of a camera's name
COLOURS, INVENTED = "class colour error", "out of sight of the others"
SYSTEMS = ("scan alone", "with the other cameras")


@dataclass(frozen=True, kw_only=True, eq=False)
class HiddenView:
    """A hidden camera's image and its predictions.

    real       (h, w, 3) uint8;  predicted: likewise, by system.
    valid      (h, w) bool: pixels inside the panorama, and not on the own vehicle.
    classes    (h, w) uint8 ids of COMMON15, of the scan alone; 0 outside `valid`.
    invented   (h, w) bool: out of sight of all other cameras.
    """

    name: str
    real: np.ndarray
    predicted: Mapping[str, np.ndarray]
    valid: np.ndarray
    classes: np.ndarray
    invented: np.ndarray

    @property
    def real_share(self) -> float:
        """Share of the valid pixels in sight of another camera."""
        return float(1 - self.invented[self.valid].mean()) if self.valid.any() else 0.0

    def sheet(self) -> np.ndarray:
        """Return the image and the predictions under their captions, (H, 3 w, 3) uint8, black outside `valid`."""
        images = {"image": self.real, **self.predicted}
        joined = captioned({caption: image * self.valid[..., None] for caption, image in images.items()})
        assert joined is not None
        return joined


@dataclass(kw_only=True)
class HiddenScores:
    """Metrics of the hidden views by system; `patches` are the features of patch Frechet and feature distances."""

    patches: Mapping[str, PatchFeatures]
    metrics: dict[str, dict[str, FrameMetric | SetMetric]] = field(default_factory=dict)
    shares: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Begin with metrics of no view."""
        for system in SYSTEMS:
            self.metrics[system] = {"SSIM": SSIM(), COLOURS: ClassColourError(), INVENTED: ClassColourError()}
            for name, part in self.patches.items():
                title = f"patch Frechet, {name}"
                self.metrics[system][title] = PatchFrechetDistance(part.extractor, part.down, part.shrink)
                if part.shrink == 1:
                    self.metrics[system][f"feature distance, {name}"] = FeatureDistance(part.extractor, part.down)

    def add(self, view: HiddenView) -> None:
        """Count a view."""
        self.shares[view.name] = view.real_share
        for system, image in view.predicted.items():
            for title, metric in self.metrics[system].items():
                if isinstance(metric, ClassColourError):
                    classes = np.where(view.invented, view.classes, 0) if title == INVENTED else view.classes
                    metric.update(image, view.real, classes, view.name)
                elif isinstance(metric, SSIM | PatchFrechetDistance | FeatureDistance):
                    metric.update(image, view.real, view.name, valid=view.valid)

    def as_dict(self) -> dict[str, Any]:
        """Return values with 95 % intervals by metric and system, ready for JSON."""
        systems = {
            system: {title: _intervals(part) for title, part in self.metrics[system].items()} for system in SYSTEMS
        }
        return {"views": self.shares, "systems": systems}


def _intervals(metric: FrameMetric | SetMetric) -> dict[str, dict[str, float | None]]:
    if isinstance(metric, SetMetric):
        parts = set_intervals(metric)
    else:
        parts = {name: interval(metric, name) for name in metric.values()}
    return {name: _plain(part) for name, part in parts.items() if np.isfinite(part.value)}


def _plain(part: Interval) -> dict[str, float | None]:
    return {name: float(value) if np.isfinite(value) else None for name, value in part._asdict().items()}


def records(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return one row per system and value of `as_dict`."""
    return [
        {"system": system, "metric": _label(title, name), **part}
        for system, metrics in summary["systems"].items()
        for title, values in metrics.items()
        for name, part in values.items()
    ]


def _label(title: str, name: str) -> str:
    return name if title in ("SSIM", COLOURS) else f"{title}: {name}"


def table(summary: Mapping[str, Any]) -> str:
    """Return the scores as Markdown: each metric by system, with 95 % intervals, and the ratio of the two."""
    first, second = (summary["systems"][system] for system in SYSTEMS)
    share = np.mean(list(summary["views"].values()))
    rows: list[list[str]] = []
    for title, values in first.items():
        for name, value in values.items():
            second_value = second[title].get(name)
            if second_value is None or name == "real to real":
                continue
            ratio = f"{second_value['value'] / value['value']:.2f}" if value["value"] else ""
            rows.append([_label(title, name), _shown(value), _shown(second_value), ratio])
    heading = f"{len(summary['views'])} hidden views; the others see {share:.0%} of them."
    return f"{heading}\n\n{markdown_table(['metric', *SYSTEMS, 'ratio'], rows)}"


def _shown(part: Mapping[str, float | None]) -> str:
    ends = "" if part["low"] is None else f" [{part['low']:.3g}, {part['high']:.3g}]"
    return f"{part['value']:.3g}{ends}"


def frame_cameras(frame: Frame) -> list[Camera]:
    """Return the cameras of a frame, with names; InputError if fewer than two can be read."""
    if isinstance(frame, SurroundFrame):
        cameras = [replace(camera, name=name) for name, camera in frame.cameras.items()]
    else:
        scan_file: Path | None = getattr(frame, "scan_file", None)
        cameras = list(cameras_of(scan_file, "", CameraOptions(), np.eye(4)).cameras) if scan_file else []
    if len(cameras) < 2:
        raise InputError(f"{frame.name}: --leave-out needs two cameras of a scan, it has {len(cameras)}")
    return cameras


def hidden_views(pipeline: Pipeline, frame: Frame, leave_out: str) -> Iterator[HiddenView]:
    """Yield the view of the camera of this name, or EACH of a frame's; InputError if it has none of this name."""
    cameras = frame_cameras(frame)
    names = [camera.name for camera in cameras]
    if leave_out not in (EACH, *names):
        raise InputError(f"{frame.name}: --leave-out: no camera {leave_out!r}{closest(leave_out, [EACH, *names])}")
    for hidden in cameras:
        if leave_out in (EACH, hidden.name):
            other_cameras = [camera for camera in cameras if camera is not hidden]
            yield hidden_view(pipeline, frame.scan, hidden, other_cameras, f"{frame.name}/{hidden.name}")


def hidden_view(
    pipeline: Pipeline, scan: Scan, hidden: Camera, other_cameras: Sequence[Camera], name: str
) -> HiddenView:
    """Predict a camera's view from its optical centre: the scan is translated once, and painted twice.

    The other cameras tell its exposure, too.
    """
    moved, timer = pipeline.at(hidden.calibration), Timer(pipeline.device)
    scene = moved.translate(scan, timer)
    sound, _ = sound_cameras(other_cameras, scan, edges=False)
    panoramas = [moved.paint(Memory(), scene, timer, cameras)[1] for cameras in ((), sound)]
    look = [panorama.to_camera(hidden.calibration, metered=True) for panorama in panoramas]
    valid = look[0].valid if hidden.ego_mask is None else look[0].valid & ~hidden.ego_mask
    return HiddenView(
        name=name,
        real=hidden.image,
        predicted={system: image.colour for system, image in zip(SYSTEMS, look, strict=True)},
        valid=valid,
        classes=np.where(valid, look[0].segments, 0).astype(np.uint8),
        invented=_invented_in(panoramas[1], hidden),
    )


def _invented_in(panorama: Panorama, camera: Camera) -> np.ndarray:
    """Return the pixels (h, w) bool of a camera's image where the panorama is invented: all if no camera was sound."""
    source = np.zeros_like(panorama.segments) if panorama.source is None else panorama.source
    return replace(panorama, segments=source).to_camera(camera.calibration).segments == 0


def score_hidden(
    pipeline: Pipeline,
    frames: Sequence[Frame],
    leave_out: str,
    patches: Mapping[str, PatchFeatures],
    *,
    sheets: Path | None = None,
    after_each: Callable[[], object] = lambda: None,
) -> HiddenScores:
    """Score all hidden views of frames; `sheets` is a folder for a picture of each."""
    scores = HiddenScores(patches=patches)
    for frame in frames:
        for view in hidden_views(pipeline, frame, leave_out):
            scores.add(view)
            if sheets:
                path = sheets / f"{view.name.replace('/', '-')}.png"
                write_whole(path, lambda file, view=view: write_png(file, np.ascontiguousarray(view.sheet())))
        after_each()
    return scores
