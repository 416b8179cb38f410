"""What has been counted of one system, and the figures that follow."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np
import torch

from lidar2pano.data.camera_rasters import camera_raster
from lidar2pano.data.truths import Truth
from lidar2pano.evaluate.measures import Measures
from lidar2pano.evaluate.questions import Seen
from lidar2pano.evaluate.rasters import Carried, windows
from lidar2pano.geometry.flow import Flow
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI
from lidar2pano.metrics.classes import ClassCounts
from lidar2pano.metrics.depth import DepthError
from lidar2pano.metrics.frames import FrameMetric
from lidar2pano.metrics.frechet import FrechetDistance
from lidar2pano.metrics.patch_frechet import PATCH, PatchFrechetDistance
from lidar2pano.metrics.resegmentation import Resegmentation
from lidar2pano.metrics.samples import TwoSets
from lidar2pano.metrics.seams import RollError, SeamRatio
from lidar2pano.metrics.similarity import SSIM, WINDOW
from lidar2pano.metrics.time import WarpingError
from lidar2pano.metrics.wasserstein import SlicedWasserstein

UNSCORED = (COMMON15.id_of("unlabeled"), COMMON15.id_of("sky"))
Key = tuple[str, str]  # sector ("points", "camera", "panorama") and measure
Kind = TypeVar("Kind", bound="FrameMetric | TwoSets")
LEADING = (
    ("camera", "classes", "mIoU"),
    ("panorama", "classes", "mIoU"),
    ("camera", "ssim", "SSIM"),
    ("panorama", "ssim", "SSIM"),
    ("points", "classes", "mIoU"),
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moved:
    """A sector's picture (H, W, 3) uint8 of the frame before, and the flow to it: known where something stood still."""

    before: np.ndarray
    flow: Flow


class Tally:
    """Metrics by sector and measure, made when they are first needed."""

    def __init__(self, measures: Measures) -> None:
        self.measures = measures
        self.metrics: dict[Key, FrameMetric | TwoSets] = {}

    def points(self, truth: Truth, seen: Seen) -> None:
        """Count the classes of the scan's points."""
        if truth.point_ids is not None and seen.labels is not None and "points" in self.measures.kinds:
            self._of("points", "classes", _point_classes).update(seen.labels, truth.point_ids, truth.name)

    def camera(self, truth: Truth, seen: Seen, moved: Moved | None) -> None:
        """Count the camera's image."""
        kinds = self.measures.kinds
        if "classes" in kinds and seen.ids is not None and truth.camera_ids is not None:
            self._of("camera", "classes", _classes).update(seen.ids, truth.camera_ids, truth.name)
        if "depth" in kinds and seen.depth_m is not None:
            assert truth.calibration is not None
            rows, columns = seen.depth_m.shape
            measured = camera_raster(truth.scan, truth.calibration, (rows, columns))[1]
            self._of("camera", "depth", DepthError).update(seen.depth_m, measured, truth.name)
        if seen.colour is None:
            return
        if "pictures" in kinds and truth.picture is not None:
            self._similar("camera", seen.colour, truth.picture, truth.name)
            self._of("camera", "swd", SlicedWasserstein).update(seen.colour, truth.picture, truth.name)
            self._patches("camera", seen.colour, truth.picture, truth.name)
            self._judged(truth, seen.colour, truth.picture)
        if "time" in kinds and moved is not None:
            self.warped("camera", seen.colour, moved, truth.name)

    def panorama(self, truth: Truth, around: Carried, painted: bool, moved: Moved | None) -> None:
        """Count what is all around, on the truth's raster."""
        true, kinds = truth.panorama, self.measures.kinds
        assert true is not None
        if "classes" in kinds and true.ids is not None:
            self._of("panorama", "classes", _classes).update(around.ids, true.ids, truth.name)
        if "depth" in kinds and true.depth_m is not None:
            self._of("panorama", "depth", DepthError).update(around.depth_m, true.depth_m, truth.name)
        if not painted:
            return
        if "pictures" in kinds and true.valid.any():
            self._similar("panorama", around.colour, true.colour, truth.name, true.valid)
            self._patches("panorama", around.colour, true.colour, truth.name, true.valid)
            swd = self._of("panorama", "swd", SlicedWasserstein)
            for number, (mine, theirs) in enumerate(windows(around.colour, true.colour, true.valid)):
                swd.update(mine, theirs, f"{truth.name}#{number}")
        if "time" in kinds and moved is not None:
            self.warped("panorama", around.colour, moved, truth.name)

    def seam(self, colour: np.ndarray, name: str) -> None:
        """Count the seam of a panorama (H, W, 3) uint8."""
        if "seams" in self.measures.kinds:
            self._of("panorama", "seam", SeamRatio).update(colour, name)

    def roll(self, straight: Carried, turned: Carried, columns: int, name: str) -> None:
        """Count a panorama against that of the scan turned by so many columns."""
        colours = [torch.from_numpy(np.ascontiguousarray(one.colour)).movedim(2, 0) for one in (straight, turned)]
        self._of("panorama", "roll", RollError).update(colours[0], colours[1], columns, name)
        self._of("panorama", "roll ids", lambda: RollError(ids=True)).update(straight.ids, turned.ids, columns, name)

    def resegmented(self, colour: np.ndarray, truth: Truth) -> None:
        """Count what the camera segmenter sees in a picture."""
        eye = self.measures.eye
        if eye is None or truth.camera_ids is None or "pictures" not in self.measures.kinds:
            return

        def made() -> Resegmentation:
            return Resegmentation(eye.segment, COMMON15, segmenter=eye.sha256, unscored=UNSCORED)

        self._of("camera", "resegmentation", made).update(colour, truth.camera_ids, truth.name)

    def warped(self, sector: str, colour: np.ndarray, moved: Moved, name: str) -> None:
        """Count a picture against the one before it, carried over by the flow."""
        self._of(sector, "warping", lambda: WarpingError(circular=sector == "panorama")).update(
            moved.before, colour, moved.flow.shift, name, valid=moved.flow.known
        )

    def merge(self, other: Tally) -> None:
        """Take in another part of the split; ValueError where the two have a frame in common."""
        for key, metric in other.metrics.items():
            if key in self.metrics:
                self.metrics[key].merge(metric)  # pyright: ignore[reportArgumentType] of one key, so of one kind
            else:
                self.metrics[key] = metric

    def classes(self, sector: str) -> ClassCounts | None:
        """What has been counted of a sector's classes."""
        found = self.metrics.get((sector, "classes"))
        return found if isinstance(found, ClassCounts) else None

    def labelled(self, sector: str) -> list[ClassCounts]:
        """All that has been counted against a sector's classes: the system's own first, then a judge's."""
        found = (self.metrics.get((sector, measure)) for measure in ("classes", "resegmentation"))
        return [counts for counts in found if isinstance(counts, ClassCounts)]

    def of_frame(self, name: str) -> tuple[str, float] | None:
        """The figure by which a frame is judged, and its value: the first of LEADING that it has; more is better."""
        for sector, measure, figure in LEADING:
            metric = self.metrics.get((sector, measure))
            if isinstance(metric, FrameMetric) and name in metric.rows:
                with np.errstate(invalid="ignore", divide="ignore"):
                    value = float(metric.figures_of(metric.rows[name])[figure])
                if not math.isnan(value):
                    return f"{sector} {figure}", value
        return None

    def _of(self, sector: str, measure: str, make: Callable[[], Kind]) -> Kind:
        key = (sector, measure)
        if key not in self.metrics:
            self.metrics[key] = make()
        return self.metrics[key]  # pyright: ignore[reportReturnType] made by the same function before

    def _similar(
        self, sector: str, mine: np.ndarray, theirs: np.ndarray, name: str, valid: np.ndarray | None = None
    ) -> None:
        if min(theirs.shape[:2]) >= WINDOW:
            self._of(sector, "ssim", SSIM).update(mine, theirs, name, valid=valid)

    def _patches(
        self, sector: str, mine: np.ndarray, theirs: np.ndarray, name: str, valid: np.ndarray | None = None
    ) -> None:
        patches = self.measures.patches
        if patches is not None and min(theirs.shape[:2]) >= PATCH:
            made = partial(PatchFrechetDistance, patches, extractor=patches.sha256)
            self._of(sector, "patches", made).update(mine, theirs, name, valid)

    def _judged(self, truth: Truth, mine: np.ndarray, theirs: np.ndarray) -> None:
        """What needs somebody else's weights."""
        if self.measures.eye is not None:
            self._of("camera", "fsd", self._fsd).update(mine, theirs, truth.name)
            self.resegmented(mine, truth)
        if (inception := self.measures.inception) is not None:
            self._of(
                "camera", "fid", lambda: FrechetDistance(inception, name="FID", extractor=inception.sha256)
            ).update(mine, theirs, truth.name)

    def _fsd(self) -> FrechetDistance:
        eye = self.measures.eye
        assert eye is not None
        return FrechetDistance(eye.features, name="FSD", extractor=eye.sha256)


def _classes() -> ClassCounts:
    return ClassCounts(COMMON15, unscored=UNSCORED)


def _point_classes() -> ClassCounts:
    return ClassCounts(SEMANTIC_KITTI, unscored=(0,))
