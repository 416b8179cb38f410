"""Intersection over union from one confusion matrix over a whole split, also frame by frame, with an interval."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import Any, Self

import numpy as np
import torch

from lidar2pano.labels import LabelSet
from lidar2pano.metrics.accumulation import Array, FrameMetric, as_tensor


class MeanIoU(FrameMetric):
    """A confusion matrix per frame: "mIoU", "accuracy", "published mIoU" of their sum, of each frame, of each resample.

    Target ids outside [0, K) are not scored, nor are those of `unscored`; a prediction of `unscored` counts as wrong.
    A class of neither side is undefined and not in the mean, which is over the classes `over`.

    `MeanIoU(COMMON14, unscored=(0,))` has the paper's mIoU over common-14: class 0 of the target is not scored,
    predictions of 0 are counted as misses.
    """

    def __init__(self, classes: int | LabelSet, *, unscored: Iterable[int] = ()) -> None:
        """classes: their number, or a label set; unscored: target ids left out, each in [0, K)."""
        self.names = tuple(str(c) for c in (range(classes) if isinstance(classes, int) else classes.classes))
        self.unscored, self.over = list(unscored), list(range(len(self.names)))
        super().__init__(*(f"{target}/{predicted}" for target in self.names for predicted in self.names))

    def update(self, predicted: Array, target: Array, name: str) -> None:
        """Count the frame `name`: integer ids of one shape.

        Raises ValueError when the shapes differ, when either is not of integers, and for predicted ids outside [0, K)
        of scored pixels.
        """
        predicted, target = as_tensor(predicted), as_tensor(target)
        if predicted.shape != target.shape:
            raise ValueError(f"predicted {tuple(predicted.shape)} and target {tuple(target.shape)} differ in shape")
        if predicted.is_floating_point() or target.is_floating_point():
            raise ValueError("MeanIoU compares class ids: take the argmax of scores first")
        count = len(self.names)
        target, predicted = target.flatten().long(), predicted.flatten().long()
        scored = (target >= 0) & (target < count) & ~torch.isin(target, target.new_tensor(self.unscored))
        target, predicted = target[scored], predicted[scored]
        outside = predicted[(predicted < 0) | (predicted >= count)]
        if len(outside):
            raise ValueError(f"predicted id {int(outside[0])} is outside [0, {count})")
        self._keep(name, *torch.bincount(target * count + predicted, minlength=count * count).tolist())

    def averaged_over(self, ids: Iterable[int]) -> Self:
        """Return the same counts with the mean over other classes."""
        metric = copy.copy(self)
        metric.over = list(ids)
        return metric

    def values_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """Return mean IoU, accuracy and the published code's mean IoU from counts (..., K * K).

        The published code (evaluate_iou.py, ioueval.py) leaves out predictions of unscored classes, too, instead of
        counting them as misses.
        """
        cells = sums.reshape(*sums.shape[:-1], len(self.names), len(self.names))
        hit = cells.diagonal(axis1=-2, axis2=-1)
        lenient = cells.copy()
        lenient[..., self.unscored] = 0
        return {
            "mIoU": self._mean(cells),
            "accuracy": hit.sum(-1) / cells.sum((-1, -2)),
            "published mIoU": self._mean(lenient),
        }

    def _mean(self, cells: np.ndarray) -> np.ndarray:
        iou = class_ious(cells, self.unscored)[..., self.over]
        defined = ~np.isnan(iou)
        return np.where(defined, iou, 0).sum(-1) / defined.sum(-1)

    def counts(self) -> np.ndarray:
        """Return the counts of all frames together (K, K) int64; row = target, column = predicted."""
        return self.sums().sum(0).astype(np.int64).reshape(len(self.names), len(self.names))

    def ious(self) -> np.ndarray:
        """Return each class's intersection / union over all frames (K,); NaN for unscored and absent classes."""
        return class_ious(self.counts(), self.unscored)

    def table(self) -> list[dict[str, Any]]:
        """Return a row per scored class, ready for JSON: class, iou, precision, recall (undefined: None), pixels."""
        counts = self.counts()
        hit, predicted, targets = counts.diagonal(), counts.sum(0), counts.sum(1)
        with np.errstate(invalid="ignore"):
            columns = {"iou": self.ious(), "precision": hit / predicted, "recall": hit / targets}
        return [
            {"class": name}
            | {key: None if np.isnan(column[c]) else float(column[c]) for key, column in columns.items()}
            | {"pixels": int(targets[c])}
            for c, name in enumerate(self.names)
            if c not in self.unscored
        ]


def class_ious(cells: np.ndarray, unscored: Iterable[int]) -> np.ndarray:
    """Return intersection / union (..., K) of confusion matrices (..., K, K); NaN for unscored and absent classes."""
    hit = cells.diagonal(axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore"):
        iou = hit / (cells.sum(-1) + cells.sum(-2) - hit)
    iou[..., list(unscored)] = np.nan
    return iou
