"""Confidence intervals: how a figure would scatter had other frames of the same kind been looked at."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import NamedTuple

import numpy as np

from lidar2pano.metrics.frames import FrameMetric


class Interval(NamedTuple):
    """A figure, and where it lies in `level` of the resamples; low and high are NaN where there is no frame."""

    value: float
    low: float
    high: float
    level: float
    resamples: int
    units: int  # frames, or groups of frames, that were drawn from


def interval(
    metric: FrameMetric,
    figure: str | None = None,
    *,
    against: FrameMetric | None = None,
    group: Callable[[str], Hashable] | None = None,
    level: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Interval:
    """Percentile bootstrap of a figure over frames (Efron and Tibshirani 1993, chapter 13).

    Frames are drawn with replacement, as many as there are; their sums give the figure as all frames' sums do.
    figure   name, the leading one when None.
    against  the same metric of another contender over the same frames: the interval is that of the difference
             metric - against, both over the same draws.
    group    frame name -> what it belongs to; then whole groups are drawn. Frames of one drive are alike, so an
             interval over single frames is too narrow for what another drive would give.
    A resample in which the figure is undefined is left out. Raises ValueError when the two have not the same frames,
    and for a level outside (0, 1).
    """
    if not 0 < level < 1 or resamples < 1:
        raise ValueError(f"an interval needs a level in (0, 1) and a resample, not {level} and {resamples}")
    names, sums = metric.table()
    parts = [(metric, sums)]
    if against is not None:
        others, other_sums = against.table()
        if others != names or type(against) is not type(metric):
            raise ValueError(f"{metric!r} and {against!r} have not been counted over the same frames")
        parts.append((against, other_sums))
    value = _difference([_figure(one, rows.sum(0), figure) for one, rows in parts])
    if group is not None:
        of_frame = [group(name) for name in names]
        places = {unit: place for place, unit in enumerate(dict.fromkeys(of_frame))}
        belongs = np.array([places[unit] for unit in of_frame], dtype=np.int64)
        parts = [(one, _grouped(rows, belongs, len(places))) for one, rows in parts]
    units = len(parts[0][1])
    if not units:
        return Interval(float(value), np.nan, np.nan, level, resamples, 0)
    times = multiplicities(units, resamples, seed)
    drawn = _difference([_figure(one, times @ rows, figure) for one, rows in parts])
    drawn = drawn[~np.isnan(drawn)]
    low, high = np.quantile(drawn, [(1 - level) / 2, (1 + level) / 2]) if len(drawn) else (np.nan, np.nan)
    return Interval(float(value), float(low), float(high), level, resamples, units)


def multiplicities(units: int, resamples: int, seed: int) -> np.ndarray:
    """How often each unit is in each resample: (resamples, units) float64, each row's sum is `units`."""
    draws = np.random.default_rng(seed).integers(units, size=(resamples, units))
    cells = draws + units * np.arange(resamples)[:, None]
    return np.bincount(cells.ravel(), minlength=resamples * units).reshape(resamples, units).astype(np.float64)


def _figure(metric: FrameMetric, sums: np.ndarray, name: str | None) -> np.ndarray:
    with np.errstate(invalid="ignore", divide="ignore"):
        figures = metric.figures_of(sums)
    return np.asarray(next(iter(figures.values())) if name is None else figures[name])


def _difference(values: list[np.ndarray]) -> np.ndarray:
    return values[0] - values[1] if len(values) > 1 else values[0]


def _grouped(rows: np.ndarray, belongs: np.ndarray, units: int) -> np.ndarray:
    grouped = np.zeros((units, rows.shape[1]))
    np.add.at(grouped, belongs, rows)
    return grouped
