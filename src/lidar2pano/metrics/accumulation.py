"""Base of metrics: checks of inputs, accumulation of frames' sums and of images' arrays, confidence intervals.

The result is the same, to the last bit, in any order of frames; a frame counted twice is an error.
"""

from __future__ import annotations

import copy
import hashlib
import os
from abc import ABC, abstractmethod
from collections.abc import Collection
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import ClassVar, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

Array = Tensor | np.ndarray

LEAST_FRAMES = 5  # of a value with an interval
SHARE = 0.975  # of Student's distribution below the upper end of a 95 % interval
ANGLES = 1 << 16  # at which its density is summed
GROUPS = 10  # of images, for intervals of set distances
BLOCK = 1 << 23  # multiplicities in memory at a time, 64 MB


def as_tensor(values: Array) -> Tensor:
    """Return the same values as a tensor on the CPU.

    An array beyond torch's sharing (read-only, as from Pillow, or with negative strides) is copied.
    """
    if isinstance(values, np.ndarray) and (not values.flags.writeable or min(values.strides, default=0) < 0):
        values = values.copy()
    return torch.as_tensor(values).cpu()


def image_tensor(values: Array, name: str = "an image") -> Tensor:
    """Return an image (H, W, 3) uint8 RGB as a tensor (3, H, W) uint8; ValueError with the name otherwise."""
    tensor = as_tensor(values)
    if tensor.dtype != torch.uint8 or tensor.ndim != 3 or tensor.shape[2] != 3 or not tensor.numel():
        raise ValueError(f"{name} must be (H, W, 3) uint8, not {tuple(tensor.shape)} {tensor.dtype}")
    return tensor.movedim(2, 0)


def image_pair(predicted: Array, target: Array) -> tuple[Tensor, Tensor]:
    """Return two images of one size, each (3, H, W) uint8; ValueError otherwise."""
    first, second = image_tensor(predicted, "the predicted image"), image_tensor(target, "the target image")
    if first.shape != second.shape:
        raise ValueError(f"predicted {tuple(first.shape[1:])} and target {tuple(second.shape[1:])} differ in shape")
    return first, second


def mask_tensor(values: Array | None, shape: tuple[int, ...] | torch.Size, name: str) -> Tensor | None:
    """Return a mask of this shape as a bool tensor; None stays None; ValueError otherwise."""
    if values is None:
        return None
    tensor = as_tensor(values)
    if tensor.dtype != torch.bool or tensor.shape != tuple(shape):
        raise ValueError(f"{name} must be {tuple(shape)} bool, not {tuple(tensor.shape)} {tensor.dtype}")
    return tensor


# --- accumulation -----------------------------------------------------------------------------------------------------


class FrameMetric(ABC):
    """A metric of sums over frames; `update` of a subclass keeps each frame's sums by name.

    Since each frame's own sums are kept, the worst frames can be named and `interval` can resample the frames.
    sum_names  names of the S sums;  rows: frame name -> (S,) float64.
    """

    def __init__(self, *sum_names: str) -> None:
        self.sum_names = sum_names
        self.rows: dict[str, np.ndarray] = {}

    @abstractmethod
    def values_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """Return values by name, each (...), from sums (..., S) float64; the leading one first; undefined: NaN."""

    def sums(self) -> np.ndarray:
        """Return the sums of the frames (F, S) float64, in the order of the frames' names."""
        rows = [self.rows[name] for name in sorted(self.rows)]
        return np.array(rows, dtype=np.float64).reshape(len(self), len(self.sum_names))

    def values(self) -> dict[str, float]:
        """Return every value over all frames; NaN if nothing was counted."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return {name: float(value) for name, value in self.values_of(self.sums().sum(0)).items()}

    def compute(self) -> float:
        """Return the leading value over all frames; NaN if nothing was counted."""
        return next(iter(self.values().values()))

    def value_of_frame(self, frame: str, name: str) -> float:
        """Return a value of one frame alone; NaN if it is undefined or the frame was not counted."""
        if frame not in self.rows:
            return float("nan")
        with np.errstate(invalid="ignore", divide="ignore"):
            return float(self.values_of(self.rows[frame])[name])

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.rows)

    def _keep(self, name: str, *sums: float) -> None:
        """Keep a frame's sums; ValueError when the frame was counted before or a sum is not finite."""
        if name in self.rows:
            raise ValueError(f"frame {name!r} was counted twice")
        row = np.array(sums, dtype=np.float64)
        if not np.isfinite(row).all():
            raise ValueError(f"frame {name!r}: {dict(zip(self.sum_names, sums, strict=True))} is not finite")
        self.rows[name] = row


class SetMetric(ABC):
    """A distance between two sets of images, the predicted and the target ones; of each image one array is kept.

    Of more than MOST frames a pseudo-random sample of MOST is kept, by their names alone. Memory holds names only.
    kept  frame -> file of the arrays of both sides (2, ...), in a temporary folder (in TMPDIR).
    """

    MOST: ClassVar[int]

    def __init__(self) -> None:
        self.kept: dict[str, Path] = {}
        self._folder = _Folder()

    @abstractmethod
    def values(self) -> dict[str, float]:
        """Return every value, the leading one first; NaN for too few images."""

    def compute(self) -> float:
        """Return the leading value; NaN for too few images."""
        return next(iter(self.values().values()))

    def without(self, names: Collection[str]) -> Self:
        """Return a copy without some frames, for intervals: its values may be less precise; it shares the files."""
        metric = copy.copy(self)
        metric.kept = {name: path for name, path in self.kept.items() if name not in names}
        return metric

    def stacked(self, side: int, part: int | None = None) -> np.ndarray:
        """Return one side's arrays (N, ...) in the order of names, or of each the one at `part`; (0,) for none."""
        index = side if part is None else (side, part)
        arrays = [np.load(self.kept[name], mmap_mode="r")[index] for name in sorted(self.kept)]
        return np.stack(arrays) if arrays else np.zeros(0)

    def __len__(self) -> int:
        """Return the number of frames kept."""
        return len(self.kept)

    def _keep(self, name: str, *sides: np.ndarray) -> None:
        """Keep the arrays of a frame's predicted and target image."""
        self.kept[name] = Path(self._folder.name, f"{_rank(name).hex()}.npy")
        np.save(self.kept[name], np.stack(sides))

    def _makes_room(self, name: str) -> bool:
        """Return whether to keep a frame; another one may be dropped for it. ValueError for one kept already."""
        if name in self.kept:
            raise ValueError(f"frame {name!r} was counted twice")
        if len(self.kept) < self.MOST:
            return True
        last = max(self.kept, key=_rank)
        if _rank(name) > _rank(last):
            return False
        self.kept.pop(last).unlink()
        return True


class _Folder(TemporaryDirectory[str]):
    """A temporary folder, deleted with the last of the metrics with this folder."""

    def __del__(self) -> None:
        """Delete the files."""
        self.cleanup()


def _rank(name: str) -> bytes:
    """Return the position of a name in a pseudo-random order of all names."""
    return hashlib.sha256(os.fsencode(name)).digest()


class Interval(NamedTuple):
    """A value and the ends of its confidence interval; low and high are NaN of fewer than LEAST_FRAMES frames."""

    value: float
    low: float
    high: float
    frames: int


def interval(metric: FrameMetric, name: str | None = None, *, level: float = 0.95, resamples: int = 2000) -> Interval:
    """Compute the percentile bootstrap of a value over frames (Efron and Tibshirani 1993, chapter 13).

    Frames are drawn with replacement, as many as there are; their sums give the value as all frames' sums do.
    name   of the value, the leading one when None;  level: share of resamples within the interval, in (0, 1).
    Resamples of undefined value are left out.
    """
    sums = metric.sums()
    frames, value = len(sums), float(_value(metric, sums.sum(0), name))
    if frames < LEAST_FRAMES:
        return Interval(value, np.nan, np.nan, frames)
    generator, block = np.random.default_rng(0), max(1, BLOCK // frames)
    counts = [min(block, resamples - start) for start in range(0, resamples, block)]
    drawn = np.concatenate([_value(metric, multiplicities(frames, count, generator) @ sums, name) for count in counts])
    drawn = drawn[~np.isnan(drawn)]
    low, high = np.quantile(drawn, [(1 - level) / 2, (1 + level) / 2]) if len(drawn) else (np.nan, np.nan)
    return Interval(value, float(low), float(high), frames)


def set_intervals(metric: SetMetric) -> dict[str, Interval]:
    """Compute 95 % intervals of a set distance's values by the jackknife over groups of images.

    Shao and Tu 1995, section 2.3, with Student's t: value -+ t ((G - 1) / G sum (v_g - mean)^2)^(1/2) over up to GROUPS
    groups G of about equal size, at random but by the names alone; NaN for fewer than LEAST_FRAMES images, and for
    undefined values. Distances never are below zero.
    """
    names, count = sorted(metric.kept, key=_rank), min(GROUPS, len(metric))
    groups = [names[first::count] for first in range(count)] if len(names) >= LEAST_FRAMES else []
    parts = [metric.without(group).values() for group in groups]
    intervals: dict[str, Interval] = {}
    for name, value in metric.values().items():
        left = np.array([part[name] for part in parts])
        half = np.nan
        if parts:
            spread = np.sqrt((count - 1) / count * np.square(left - left.mean()).sum())
            half = student_quantile(count - 1) * spread
        intervals[name] = Interval(value, float(np.maximum(value - half, 0.0)), float(value + half), len(names))
    return intervals


@cache
def student_quantile(degrees: int) -> float:
    """Return the quantile SHARE of Student's t distribution with so many degrees of freedom.

    With t = sqrt(n) tan(a) its density is proportional to cos(a)^(n - 1) in a.
    """
    edges = np.linspace(0, np.pi / 2, ANGLES + 1)
    cumulated = np.cumsum(np.cos((edges[1:] + edges[:-1]) / 2) ** (degrees - 1))
    angle = np.interp(2 * SHARE - 1, cumulated / cumulated[-1], edges[1:])
    return float(degrees**0.5 * np.tan(angle))


def multiplicities(frames: int, resamples: int, generator: np.random.Generator) -> np.ndarray:
    """Count each frame in each resample: (resamples, frames) float64, each row's sum is `frames`."""
    draws = generator.integers(frames, size=(resamples, frames))
    cells = draws + frames * np.arange(resamples)[:, None]
    return np.bincount(cells.ravel(), minlength=resamples * frames).reshape(resamples, frames).astype(np.float64)


def _value(metric: FrameMetric, sums: np.ndarray, name: str | None) -> np.ndarray:
    with np.errstate(invalid="ignore", divide="ignore"):
        values = metric.values_of(sums)
    return np.asarray(next(iter(values.values())) if name is None else values[name])
