"""Intersection over union from one confusion matrix over a whole split, also frame by frame, with an interval."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from lidar2pano.labels import LabelSet
from lidar2pano.metrics.accumulation import Array, FrameMetric, as_tensor


class Confusion:
    """A confusion matrix over a whole split.

    update    predicted, target: integer tensors or arrays of one shape; ids outside [0, K) in target are not scored,
              nor are those of `unscored`. A prediction of `unscored` counts as wrong.
    iou       (K,) float64, NaN for a class without scored pixels on either side, and for `unscored`.
    miou      the mean of iou over the requested classes, without the NaN.
    counts    (K, K) int64 on the CPU; row = target, column = predicted.

    The paper's mIoU over common-14 is `Confusion(COMMON14, unscored=(0,)).miou()`: class 0 of the target is not scored,
    predictions of 0 are counted as misses.
    """

    def __init__(self, classes: int | LabelSet, *, unscored: Iterable[int] = ()) -> None:
        """classes: their number, or a label set; unscored: target ids left out, each in [0, K)."""
        self.names = tuple(str(c) for c in (range(classes) if isinstance(classes, int) else classes.classes))
        self.unscored = tuple(sorted(set(unscored)))
        self.counts = torch.zeros(len(self.names), len(self.names), dtype=torch.int64)
        if not self.names:
            raise ValueError("Confusion needs at least one class")
        if wrong := [c for c in self.unscored if not 0 <= c < len(self.names)]:
            raise ValueError(f"unscored classes {wrong} are outside [0, {len(self.names)})")

    def update(self, predicted: Tensor | np.ndarray, target: Tensor | np.ndarray) -> None:
        """Count one image, one batch or one scan.

        Raises ValueError when the shapes differ, when either is not of integers, and for predicted ids outside [0, K)
        of scored pixels.
        """
        predicted, target = torch.as_tensor(predicted), torch.as_tensor(target)
        if predicted.shape != target.shape:
            raise ValueError(f"predicted {tuple(predicted.shape)} and target {tuple(target.shape)} differ in shape")
        if predicted.is_floating_point() or target.is_floating_point():
            raise ValueError("Confusion compares class ids: take the argmax of scores first")
        count = len(self.names)
        target, predicted = target.flatten().long(), predicted.flatten().long()
        scored = self._scored(target)
        outside = ((predicted < 0) | (predicted >= count)) & scored
        if outside.any():
            raise ValueError(f"predicted id {int(predicted[outside][0])} is outside [0, {count})")
        cell = (target * count + predicted).masked_fill_(~scored, count * count)  # one more bin for unscored pixels
        self.counts += torch.bincount(cell, minlength=count * count + 1)[:-1].view(count, count).cpu()

    def _scored(self, target: Tensor) -> Tensor:
        scored = (target >= 0) & (target < len(self.names))
        for ignored in self.unscored:
            scored &= target != ignored
        return scored

    def iou(self) -> Tensor:
        """Return (K,) float64: intersection / union."""
        return torch.from_numpy(class_ious(self.counts.double().numpy(), self.unscored))

    def miou(self, over: Sequence[int] | None = None) -> float:
        """Return the mean IoU over the ids in `over` (all when None), without undefined ones; NaN when none is left."""
        iou = self.iou()
        return float((iou if over is None else iou[list(over)]).nanmean())

    def accuracy(self) -> float:
        """Return the share of correct pixels among the scored ones; NaN when none was scored."""
        return float(self.counts.diag().sum().double() / self.counts.sum())

    def table(self) -> list[dict[str, Any]]:
        """Return a row per scored class, ready for JSON: class, iou, precision, recall (undefined: None), pixels."""
        hit, predicted, targets = self.counts.diag().double(), self.counts.sum(0), self.counts.sum(1)
        columns = (self.iou(), hit / predicted, hit / targets)
        return [
            {"class": name}
            | {
                key: None if column[c].isnan() else float(column[c])
                for key, column in zip(("iou", "precision", "recall"), columns, strict=True)
            }
            | {"pixels": int(targets[c])}
            for c, name in enumerate(self.names)
            if c not in self.unscored
        ]


class MeanIoU(FrameMetric):
    """A `Confusion` per frame: "mIoU", "accuracy", "published mIoU" of their sum, of each frame and of each resample.

    A class of neither side is undefined and not in the mean: with `over` None, the mean of one frame or of one resample
    is over its own classes.
    """

    def __init__(
        self, classes: int | LabelSet, *, unscored: Iterable[int] = (), over: Sequence[int] | None = None
    ) -> None:
        """classes, unscored: as for Confusion; over: ids of the mean, None for all scored ones."""
        self.blank = Confusion(classes, unscored=unscored)
        self.over = tuple(range(len(self.blank.names)) if over is None else over)
        names = self.blank.names
        super().__init__(*(f"{target}/{predicted}" for target in names for predicted in names))

    def update(self, predicted: Array, target: Array, name: str) -> None:
        """Count the frame `name`: ids of one shape; raises as Confusion.update."""
        frame = self._empty()
        frame.update(as_tensor(predicted), as_tensor(target))
        self._keep(name, *frame.counts.flatten().tolist())

    def averaged_over(self, ids: Sequence[int]) -> Self:
        """Return the same counts with the mean over other classes."""
        metric = copy.copy(self)
        metric.over = tuple(ids)
        return metric

    def values_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """Return mean IoU, accuracy and the published code's mean IoU from counts (..., K * K).

        The published code (evaluate_iou.py, ioueval.py) leaves out predictions of unscored classes, too, instead of
        counting them as misses.
        """
        count = len(self.blank.names)
        cells = sums.reshape(*sums.shape[:-1], count, count)
        hit = cells.diagonal(axis1=-2, axis2=-1)
        lenient = cells.copy()
        lenient[..., list(self.blank.unscored)] = 0
        return {
            "mIoU": self._mean(cells),
            "accuracy": hit.sum(-1) / cells.sum((-1, -2)),
            "published mIoU": self._mean(lenient),
        }

    def _mean(self, cells: np.ndarray) -> np.ndarray:
        iou = class_ious(cells, self.blank.unscored)[..., list(self.over)]
        defined = ~np.isnan(iou)
        return np.where(defined, iou, 0).sum(-1) / defined.sum(-1)

    def confusion(self) -> Confusion:
        """Return the counts of all frames together."""
        whole = self._empty()
        whole.counts += torch.from_numpy(self.sums().sum(0).reshape(whole.counts.shape)).long()
        return whole

    def _empty(self) -> Confusion:
        empty = copy.copy(self.blank)
        empty.counts = torch.zeros_like(self.blank.counts)
        return empty


def class_ious(cells: np.ndarray, unscored: Iterable[int]) -> np.ndarray:
    """Return intersection / union (..., K) of confusion matrices (..., K, K); NaN for unscored and absent classes."""
    hit = cells.diagonal(axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore"):
        iou = hit / (cells.sum(-1) + cells.sum(-2) - hit)
    iou[..., list(unscored)] = np.nan
    return iou
