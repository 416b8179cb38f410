"""Re-segmentation: what a camera segmenter sees in a painted picture, against what should be in it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from lidar2pano.metrics.classes import ClassCounts
from lidar2pano.metrics.confusion import NamesClasses
from lidar2pano.metrics.inputs import Array, as_tensor, picture

Segment = Callable[[np.ndarray], Array]


class Resegmentation(ClassCounts):
    """mIoU and accuracy of a painted picture, segmented again.

    The segmenter errs too: what it makes of the true pictures is the ceiling.
    """

    def __init__(
        self,
        segment: Segment,
        classes: int | NamesClasses,
        *,
        segmenter: str,
        unscored: Iterable[int] = (),
        over: Sequence[int] | None = None,
    ) -> None:
        """segment: picture (H, W, 3) uint8 -> ids (H, W); segmenter: what it is, best the hash of its weights."""
        self.segment, self.segmenter = segment, segmenter
        super().__init__(classes, unscored=unscored, over=over)

    def update(self, predicted: Array, target: Array, name: str) -> None:
        """Count the frame `name`: a painted picture (H, W, 3) uint8 and the ids (H, W) that should be in it."""
        painted = picture(predicted, "the painted picture").movedim(0, 2).numpy()
        super().update(as_tensor(self.segment(painted)), target, name)

    def _counted(self) -> tuple:
        return (*super()._counted(), self.segmenter)
