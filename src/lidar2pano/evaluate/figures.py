"""From counts to figures: every number of a system, with its interval."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from lidar2pano.evaluate.tallies import Key, Tally
from lidar2pano.metrics.bootstrap import interval
from lidar2pano.metrics.classes import ClassCounts
from lidar2pano.metrics.frames import FrameMetric
from lidar2pano.metrics.samples import TwoSets

# measure -> figure of its metric -> name; the order is that of tables
NAMES: dict[str, dict[str, str]] = {
    "classes": {"mIoU": "miou", "accuracy": "accuracy"},
    "ssim": {"SSIM": "ssim"},
    "swd": {"mean": "swd"} | {level: f"swd_{level}" for level in ("1024", "512", "256", "128", "64", "32", "16")},
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
    "roll ids": {"roll error": "roll_error_ids"},
}
SECTOR_ORDER = ("camera", "panorama", "points")


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """One number of a system.

    sector, name  what it is, e.g. "camera", "miou".
    value         NaN where undefined;  low, high: where 95 % of resamples of the frames lie, NaN where that says
                  nothing: for a single frame, and for distances of sets.
    frames        how many frames (of sets: pictures) it is over.
    """

    sector: str
    name: str
    value: float
    low: float = math.nan
    high: float = math.nan
    frames: int = 0


def figures(tally: Tally, over: Mapping[str, Sequence[int]]) -> Iterator[Figure]:
    """Every figure of a tally, in the order of tables; `over`: per sector, the ids whose IoU is averaged."""
    for (sector, measure), metric in sorted(tally.metrics.items(), key=lambda item: _order(item[0])):
        names = NAMES[measure]
        if isinstance(metric, TwoSets):
            for name, value in metric.figures().items():
                yield Figure(sector=sector, name=names[name], value=value, frames=len(metric))
        else:
            yield from _of_frames(sector, names, _averaging(metric, over.get(sector, ())))


def present(counts: ClassCounts) -> list[int]:
    """Ids of the classes that some scored target has."""
    return counts.confusion().counts.sum(1).nonzero()[:, 0].tolist()


def _averaging(metric: FrameMetric, over: Sequence[int]) -> FrameMetric:
    """The same counts, with the mean IoU over the classes asked for; what is counted on stays as it is."""
    if isinstance(metric, ClassCounts):
        metric = copy.copy(metric)
        metric.over = tuple(over)
    return metric


def _of_frames(sector: str, names: Mapping[str, str], metric: FrameMetric) -> Iterator[Figure]:
    for figure, name in names.items():
        found = interval(metric, figure)
        low, high = (found.low, found.high) if found.units > 1 else (math.nan, math.nan)
        yield Figure(sector=sector, name=name, value=found.value, low=low, high=high, frames=found.units)


def _order(key: Key) -> tuple[int, int]:
    sector, measure = key
    return SECTOR_ORDER.index(sector), list(NAMES).index(measure)
