"""Intersection over union from one confusion matrix over a whole split."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor


class NamesClasses(Protocol):
    """Anything with the names of classes, index = id: a LabelSet."""

    @property
    def classes(self) -> Sequence[str]:
        """The names."""
        ...


class Confusion:
    """Counts over a whole split; classes first, averages last.

    update    predicted, target: integer tensors or arrays of one shape; ids outside [0, K) in target are not scored,
              nor are those of `unscored`. A predicted id of `unscored` is an answer like any other: wrong.
    +=        adds the counts of another part of the split (another process, another half).
    iou       (K,) float64, NaN for a class that neither side ever named where it was scored, and for `unscored`.
    miou      the mean of iou over the classes asked for, without the NaN.
    counts    (K, K) int64 on the CPU; row = target, column = predicted.

    The paper's mIoU over common-14 is `Confusion(COMMON14, unscored=(0,)).miou()`: class 0 of the target is not scored,
    predictions of 0 are counted as misses.
    """

    def __init__(self, classes: int | NamesClasses, *, unscored: Iterable[int] = ()) -> None:
        """classes: their number, or a label set; unscored: target ids that are not scored, each in [0, K)."""
        self.names = tuple(str(c) for c in (range(classes) if isinstance(classes, int) else classes.classes))
        self.unscored = tuple(sorted(set(unscored)))
        self.counts = torch.zeros(len(self.names), len(self.names), dtype=torch.int64)
        if not self.names:
            raise ValueError("Confusion needs at least one class")
        if wrong := [c for c in self.unscored if not 0 <= c < len(self.names)]:
            raise ValueError(f"unscored classes {wrong} are outside [0, {len(self.names)})")

    def update(self, predicted: Tensor | np.ndarray, target: Tensor | np.ndarray) -> None:
        """Count one image, one batch or one scan.

        Raises ValueError when the shapes differ, when either is not of integers, and when a predicted id outside
        [0, K) stands where the target is scored.
        """
        predicted, target = torch.as_tensor(predicted), torch.as_tensor(target)
        if predicted.shape != target.shape:
            raise ValueError(f"predicted {tuple(predicted.shape)} and target {tuple(target.shape)} differ in shape")
        if predicted.is_floating_point() or target.is_floating_point():
            raise ValueError("Confusion compares class ids: take the argmax of scores first")
        count = len(self.names)
        target, given = target.flatten().long(), predicted.flatten().long()
        scored = self._scored(target)
        outside = ((given < 0) | (given >= count)) & scored
        if outside.any():
            raise ValueError(f"predicted id {int(given[outside][0])} is outside [0, {count})")
        cell = (target * count + given).masked_fill_(~scored, count * count)  # one bin more for what is not scored
        self.counts += torch.bincount(cell, minlength=count * count + 1)[:-1].view(count, count).cpu()

    def _scored(self, target: Tensor) -> Tensor:
        scored = (target >= 0) & (target < len(self.names))
        for left_out in self.unscored:
            scored &= target != left_out
        return scored

    def __iadd__(self, other: Confusion) -> Confusion:
        """Take in the counts of another; ValueError when it does not count the same classes."""
        if (self.names, self.unscored) != (other.names, other.unscored):
            raise ValueError(f"{self!r} and {other!r} do not count the same")
        self.counts += other.counts
        return self

    def __repr__(self) -> str:
        """Classes, what is not scored and how many pixels have been."""
        return f"Confusion(classes={len(self.names)}, unscored={self.unscored}, scored={int(self.counts.sum())})"

    def iou(self) -> Tensor:
        """(K,) float64: hits / (named by either side)."""
        hit = self.counts.diag().double()
        iou = hit / (self.counts.sum(0) + self.counts.sum(1) - hit)
        iou[list(self.unscored)] = torch.nan
        return iou

    def miou(self, over: Sequence[int] | None = None) -> float:
        """Mean IoU over the ids in `over` (all when None) that have one; NaN when none has."""
        iou = self.iou()
        return float((iou if over is None else iou[list(over)]).nanmean())

    def accuracy(self) -> float:
        """Share of scored pixels that are right; NaN when none was scored."""
        return float(self.counts.diag().sum().double() / self.counts.sum())

    def table(self) -> list[dict[str, Any]]:
        """One row per scored class, ready for JSON: class, iou, precision, recall (None where undefined), pixels."""
        hit, named, there = self.counts.diag().double(), self.counts.sum(0), self.counts.sum(1)
        columns = (self.iou(), hit / named, hit / there)
        return [
            {"class": name}
            | {
                key: None if column[c].isnan() else float(column[c])
                for key, column in zip(("iou", "precision", "recall"), columns, strict=True)
            }
            | {"pixels": int(there[c])}
            for c, name in enumerate(self.names)
            if c not in self.unscored
        ]
