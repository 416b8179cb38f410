"""The confusion matrix frame by frame: mIoU with an interval, and of each frame alone."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import torch

from lidar2pano.metrics.confusion import Confusion, NamesClasses
from lidar2pano.metrics.frames import FrameMetric
from lidar2pano.metrics.inputs import Array, as_tensor


class ClassCounts(FrameMetric):
    """One `Confusion` per frame; the figures are those of their sum.

    Figures: "mIoU" over the classes `over`, and "accuracy". A class that neither side names has no IoU and is not in
    the mean: with `over` None, the mean of one frame or of one resample is over the classes that it has.
    """

    def __init__(
        self, classes: int | NamesClasses, *, unscored: Iterable[int] = (), over: Sequence[int] | None = None
    ) -> None:
        """classes, unscored: as for Confusion; over: ids of the mean, None for all that are scored."""
        self.blank = Confusion(classes, unscored=unscored)
        self.over = tuple(range(len(self.blank.names)) if over is None else over)
        super().__init__(*(f"{target}/{given}" for target in self.blank.names for given in self.blank.names))

    def update(self, predicted: Array, target: Array, name: str) -> None:
        """Count the frame `name`: ids of one shape; raises what Confusion.update raises."""
        frame = self._empty()
        frame.update(as_tensor(predicted), as_tensor(target))
        self._keep(name, *frame.counts.flatten().tolist())

    def figures_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """Mean IoU and accuracy from counts (..., K * K)."""
        count = len(self.blank.names)
        cells = sums.reshape(*sums.shape[:-1], count, count)
        hit = cells.diagonal(axis1=-2, axis2=-1)
        iou = hit / (cells.sum(-1) + cells.sum(-2) - hit)
        iou[..., list(self.blank.unscored)] = np.nan
        iou = iou[..., list(self.over)]
        there = ~np.isnan(iou)
        miou = np.where(there, iou, 0).sum(-1) / there.sum(-1)
        return {"mIoU": miou, "accuracy": hit.sum(-1) / cells.sum((-1, -2))}

    def confusion(self) -> Confusion:
        """The counts of all frames together."""
        whole = self._empty()
        count = len(whole.names)
        whole.counts += torch.from_numpy(self.table()[1].sum(0).reshape(count, count)).long()
        return whole

    def _empty(self) -> Confusion:
        fresh = Confusion(len(self.blank.names), unscored=self.blank.unscored)
        fresh.names = self.blank.names
        return fresh

    def _counted(self) -> tuple:
        return (*super()._counted(), self.blank.unscored, self.over)
