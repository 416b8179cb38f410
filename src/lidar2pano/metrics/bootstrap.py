"""Confidence intervals of metric values by resampling frames."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidar2pano.metrics.accumulation import FrameMetric, SetMetric

LEAST_IMAGES = 5  # of a set whose distance has an interval
STUDENT_T = (np.nan, 12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262)  # 97.5 %, by degrees of freedom
BLOCK = 1 << 23  # multiplicities in memory at a time, 64 MB


class Interval(NamedTuple):
    """A value and the ends of its confidence interval; low and high are NaN without frames."""

    value: float
    low: float
    high: float
    frames: int


def interval(
    metric: FrameMetric, name: str | None = None, *, level: float = 0.95, resamples: int = 2000, seed: int = 0
) -> Interval:
    """Compute the percentile bootstrap of a value over frames (Efron and Tibshirani 1993, chapter 13).

    Frames are drawn with replacement, as many as there are; their sums give the value as all frames' sums do.
    name   of the value, the leading one when None;  level: share of resamples within the interval.
    Resamples of undefined value are left out. Raises ValueError for a level outside (0, 1).
    """
    if not 0 < level < 1 or resamples < 1:
        raise ValueError(f"an interval needs a level in (0, 1) and a resample, not {level} and {resamples}")
    sums = metric.sums()
    frames, value = len(sums), float(_value(metric, sums.sum(0), name))
    if not frames:
        return Interval(value, np.nan, np.nan, 0)
    generator, block = np.random.default_rng(seed), max(1, BLOCK // frames)
    counts = [min(block, resamples - start) for start in range(0, resamples, block)]
    drawn = np.concatenate([_value(metric, multiplicities(frames, count, generator) @ sums, name) for count in counts])
    drawn = drawn[~np.isnan(drawn)]
    low, high = np.quantile(drawn, [(1 - level) / 2, (1 + level) / 2]) if len(drawn) else (np.nan, np.nan)
    return Interval(value, float(low), float(high), frames)


def set_intervals(metric: SetMetric, *, most: int = 10) -> dict[str, Interval]:
    """Compute 95 % intervals of a set distance's values by the jackknife over groups of images.

    Shao and Tu 1995, section 2.3, with Student's t: value -+ t ((G - 1) / G sum (v_g - mean)^2)^(1/2) over up to `most`
    groups G; NaN for fewer than LEAST_IMAGES images, and for undefined values. Distances never are below zero.
    """
    values, images = metric.values(), len(metric)
    groups = metric.groups(most) if images >= LEAST_IMAGES else []
    parts = [metric.without(group).values() for group in groups]
    intervals: dict[str, Interval] = {}
    for name, value in values.items():
        left = np.array([part[name] for part in parts])
        half = np.nan
        if len(left) > 1:
            spread = np.sqrt((len(left) - 1) / len(left) * np.square(left - left.mean()).sum())
            half = STUDENT_T[len(left) - 1] * spread
        intervals[name] = Interval(value, float(np.maximum(value - half, 0.0)), float(value + half), images)
    return intervals


def multiplicities(frames: int, resamples: int, generator: np.random.Generator) -> np.ndarray:
    """Count each frame in each resample: (resamples, frames) float64, each row's sum is `frames`."""
    draws = generator.integers(frames, size=(resamples, frames))
    cells = draws + frames * np.arange(resamples)[:, None]
    return np.bincount(cells.ravel(), minlength=resamples * frames).reshape(resamples, frames).astype(np.float64)


def _value(metric: FrameMetric, sums: np.ndarray, name: str | None) -> np.ndarray:
    with np.errstate(invalid="ignore", divide="ignore"):
        values = metric.values_of(sums)
    return np.asarray(next(iter(values.values())) if name is None else values[name])
