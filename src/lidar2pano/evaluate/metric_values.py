"""The metrics of one system, and their values with confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np
import torch

from lidar2pano.data.frames import CITYSCAPES_TO_COMMON15, Frame
from lidar2pano.evaluate.interface import Prediction
from lidar2pano.evaluate.metric_config import SECTORS, MetricConfig
from lidar2pano.evaluate.resampling import Resampled, windows
from lidar2pano.geometry.camera import project_to_camera
from lidar2pano.geometry.flow import Flow
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI
from lidar2pano.metrics.accumulation import FrameMetric, SetMetric
from lidar2pano.metrics.bootstrap import Interval, interval, set_intervals
from lidar2pano.metrics.confusion import MeanIoU, Resegmentation
from lidar2pano.metrics.consistency import RollError, SeamRatio, WarpingError
from lidar2pano.metrics.depth_error import DepthError
from lidar2pano.metrics.frechet import FrechetDistance
from lidar2pano.metrics.patch_frechet import PATCH, PatchFrechetDistance
from lidar2pano.metrics.sliced_wasserstein import LEVELS, SlicedWasserstein
from lidar2pano.metrics.sliced_wasserstein_pairs import PairwiseSlicedWasserstein
from lidar2pano.metrics.ssim import SSIM, WINDOW

UNSCORED = (COMMON15.id_of("unlabeled"), COMMON15.id_of("sky"))
SECTOR_ORDER = (*SECTORS, "points")
SWD_LEVELS = tuple(f"swd_{level}" for level in LEVELS)
# metric -> value of it -> name; the order is that of tables
NAMES: dict[str, dict[str, str]] = {
    "classes": {"mIoU": "miou", "accuracy": "accuracy", "published mIoU": "miou_published"},
    "ssim": {"SSIM": "ssim"},
    "swd pairs": {"mean": "swd_pairs"} | {str(level): f"swd_pairs_{level}" for level in LEVELS},
    "swd": {"mean": "swd"} | dict(zip(map(str, LEVELS), SWD_LEVELS, strict=True)),
    "patches": {
        "ratio": "patch_frechet_ratio",
        "distance": "patch_frechet",
        "real to real": "patch_frechet_real",
    },
    "fid": {"FID": "fid"},
    "fsd": {"FSD": "fsd"},
    "resegmentation": {"mIoU": "resegmentation_miou", "accuracy": "resegmentation_accuracy"},
    "depth": {"AbsRel": "depth_abs_rel", "RMSE": "depth_rmse_m", "delta1": "depth_delta1"},
    "warping": {"warping error": "warping_error"},
    "seam": {"seam ratio": "seam_ratio", "seam ratio nearby": "seam_ratio_nearby"},
    "roll": {"roll error": "roll_error"},
    "roll labels": {"roll error": "roll_error_ids"},
}
RANKING = (  # by the first of these that a frame has, frames are ranked; of all more is better
    ("camera", "classes", "mIoU"),
    ("panorama", "classes", "mIoU"),
    ("camera", "ssim", "SSIM"),
    ("panorama", "ssim", "SSIM"),
    ("points", "classes", "mIoU"),
)
Metric = TypeVar("Metric", bound="FrameMetric | SetMetric")


@dataclass(frozen=True, slots=True, kw_only=True)
class MetricValue:
    """One number of a system.

    sector, name  e.g. "camera", "miou".
    value         NaN where undefined;  low, high: its 95 % interval over resampled frames, for distances of sets by the
                  jackknife (`bootstrap.set_intervals`); NaN for a single frame and for sets of few images.
    frames        number of frames (for distances of sets: images).
    """

    sector: str
    name: str
    value: float
    low: float = math.nan
    high: float = math.nan
    frames: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PreviousImage:
    """The previous frame's image (H, W, 3) uint8 of a sector, and the flow to it, known where the scene is static."""

    image: np.ndarray
    flow: Flow


class MetricCollection:
    """Metrics of one system by sector ("camera", "panorama", "points") and name, made on first use."""

    def __init__(self, config: MetricConfig) -> None:
        self.config = config
        self.metrics: dict[tuple[str, str], FrameMetric | SetMetric] = {}
        self._distances: dict[tuple[str, str, int], dict[str, Interval]] = {}  # they cost seconds: made once

    def points(self, frame: Frame, prediction: Prediction) -> None:
        """Count the classes of the scan's points."""
        if "points" not in self.config.groups or prediction.point_labels is None or frame.point_labels is None:
            return
        metric = self._metric("points", "classes", partial(MeanIoU, SEMANTIC_KITTI, unscored=(0,)))
        metric.update(prediction.point_labels, frame.point_labels, frame.name)

    def camera(self, frame: Frame, prediction: Prediction, previous: PreviousImage | None) -> None:
        """Count the camera's image."""
        groups, image = self.config.groups, prediction.image
        if "classes" in groups and prediction.camera_labels is not None and frame.camera_labels is not None:
            target = CITYSCAPES_TO_COMMON15[frame.camera_labels]
            self._metric("camera", "classes", _mean_iou).update(prediction.camera_labels, target, frame.name)
        if "depth" in groups and prediction.depth_m is not None:
            assert frame.calibration is not None
            rows, columns = prediction.depth_m.shape
            measured = project_to_camera(frame.scan, frame.calibration, (rows, columns))[1]
            self._metric("camera", "depth", DepthError).update(prediction.depth_m, measured, frame.name)
        if image is None:
            return
        if "pictures" in groups and frame.image is not None:
            self._ssim("camera", image, frame.image, frame.name)
            self._metric("camera", "swd", SlicedWasserstein).update(image, frame.image, frame.name)
            self._metric("camera", "swd pairs", PairwiseSlicedWasserstein).update(image, frame.image, frame.name)
            self._patches("camera", image, frame.image, frame.name)
            if (segmenter := self.config.image_segmenter) is not None:
                make = partial(FrechetDistance, segmenter.features, name="FSD")
                self._metric("camera", "fsd", make).update(image, frame.image, frame.name)
                self.resegmentation(image, frame)
            if (inception := self.config.inception) is not None:
                make = partial(FrechetDistance, inception, name="FID")
                self._metric("camera", "fid", make).update(image, frame.image, frame.name)
        if "time" in groups and previous is not None:
            self.warping("camera", image, previous, frame.name)

    def panorama(self, frame: Frame, around: Resampled, painted: bool, previous: PreviousImage | None) -> None:
        """Count the panorama, on the ground truth's raster."""
        true, groups = frame.panorama, self.config.groups
        assert true is not None
        if "classes" in groups and true.labels is not None:
            self._metric("panorama", "classes", _mean_iou).update(around.labels, true.labels, frame.name)
        if "depth" in groups and true.depth_m is not None:
            self._metric("panorama", "depth", DepthError).update(around.depth_m, true.depth_m, frame.name)
        if not painted:
            return
        if "pictures" in groups and true.valid.any():
            self._ssim("panorama", around.image, true.image, frame.name, true.valid)
            self._patches("panorama", around.image, true.image, frame.name, true.valid)
            swd = self._metric("panorama", "swd", SlicedWasserstein)
            for number, (predicted, target) in enumerate(windows(around.image, true.image, true.valid)):
                swd.update(predicted, target, f"{frame.name}#{number}")
        if "time" in groups and previous is not None:
            self.warping("panorama", around.image, previous, frame.name)

    def seam(self, image: np.ndarray, name: str) -> None:
        """Count the seam of a panorama (H, W, 3) uint8."""
        if "seams" in self.config.groups:
            self._metric("panorama", "seam", SeamRatio).update(image, name)

    def roll(self, straight: Resampled, rotated: Resampled, columns: int, name: str) -> None:
        """Count a panorama against that of the scan rotated by so many columns."""
        colours = [torch.from_numpy(np.ascontiguousarray(one.image)).movedim(2, 0) for one in (straight, rotated)]
        self._metric("panorama", "roll", RollError).update(colours[0], colours[1], columns, name)
        make = partial(RollError, ids=True)
        self._metric("panorama", "roll labels", make).update(straight.labels, rotated.labels, columns, name)

    def resegmentation(self, image: np.ndarray, frame: Frame) -> None:
        """Count the labels that the camera segmenter predicts in an image."""
        segmenter = self.config.image_segmenter
        if segmenter is None or frame.camera_labels is None or "pictures" not in self.config.groups:
            return
        make = partial(Resegmentation, segmenter.segment, COMMON15, unscored=UNSCORED)
        target = CITYSCAPES_TO_COMMON15[frame.camera_labels]
        self._metric("camera", "resegmentation", make).update(image, target, frame.name)

    def warping(self, sector: str, image: np.ndarray, previous: PreviousImage, name: str) -> None:
        """Count an image against the previous one, warped by the flow."""
        metric = self._metric(sector, "warping", partial(WarpingError, circular=sector == "panorama"))
        metric.update(previous.image, image, previous.flow.shift, name, valid=previous.flow.known)

    def classes(self, sector: str) -> MeanIoU | None:
        """The class counts of a sector."""
        found = self.metrics.get((sector, "classes"))
        return found if isinstance(found, MeanIoU) else None

    def target_classes(self, sector: str) -> list[int] | None:
        """Ids of the classes that a sector's scored targets have; None where no labels were counted."""
        for name in ("classes", "resegmentation"):
            if isinstance(found := self.metrics.get((sector, name)), MeanIoU):
                return found.confusion().counts.sum(1).nonzero()[:, 0].tolist()
        return None

    def values(self, over: Mapping[str, Sequence[int]]) -> Iterator[MetricValue]:
        """Every value, in the order of tables; `over`: per sector, ids of the classes whose IoU is averaged."""
        for (sector, key), metric in sorted(self.metrics.items(), key=lambda item: _order(item[0])):
            if isinstance(metric, SetMetric):
                place = (sector, key, len(metric))
                found = self._distances[place] = self._distances.get(place) or set_intervals(metric)
                for name, (value, low, high, frames) in found.items():
                    yield MetricValue(
                        sector=sector, name=NAMES[key][name], value=value, low=low, high=high, frames=frames
                    )
                continue
            if isinstance(metric, MeanIoU):
                metric = metric.averaged_over(over.get(sector, ()))  # noqa: PLW2901
            for name, title in NAMES[key].items():
                value, low, high, frames = interval(metric, name)
                ends = {"low": low, "high": high} if frames > 1 else {}
                yield MetricValue(sector=sector, name=title, value=value, frames=frames, **ends)

    def rank(self, name: str) -> tuple[str, float] | None:
        """The metric by which a frame is ranked, and its value; None where it has none."""
        for sector, key, value_name in RANKING:
            metric = self.metrics.get((sector, key))
            if isinstance(metric, FrameMetric) and not math.isnan(value := metric.value_of_frame(name, value_name)):
                return f"{sector} {value_name}", value
        return None

    def _metric(self, sector: str, name: str, make: Callable[[], Metric]) -> Metric:
        if (sector, name) not in self.metrics:
            self.metrics[sector, name] = make()
        return self.metrics[sector, name]  # pyright: ignore[reportReturnType] made by the same function before

    def _ssim(
        self, sector: str, predicted: np.ndarray, target: np.ndarray, name: str, valid: np.ndarray | None = None
    ) -> None:
        if min(target.shape[:2]) >= WINDOW:
            self._metric(sector, "ssim", SSIM).update(predicted, target, name, valid=valid)

    def _patches(
        self, sector: str, predicted: np.ndarray, target: np.ndarray, name: str, valid: np.ndarray | None = None
    ) -> None:
        if self.config.patches is not None and min(target.shape[:2]) >= PATCH:
            make = partial(PatchFrechetDistance, self.config.patches)
            self._metric(sector, "patches", make).update(predicted, target, name, valid)


def _mean_iou() -> MeanIoU:
    return MeanIoU(COMMON15, unscored=UNSCORED)


def _order(key: tuple[str, str]) -> tuple[int, int]:
    sector, name = key
    return SECTOR_ORDER.index(sector), list(NAMES).index(name)
