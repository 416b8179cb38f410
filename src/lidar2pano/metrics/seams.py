"""Whether every direction is treated alike: the seam where a panorama closes, and turns of the input."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from torch import Tensor

from lidar2pano.metrics.frames import FrameMetric
from lidar2pano.metrics.inputs import Array, as_tensor, picture

NEAR = 8  # steps between columns, on either side of the seam


class SeamRatio(FrameMetric):
    """Mean step of colour across the seam (last column to first) over the mean step between all other columns.

    A step is |difference| of neighbouring pixels of a row, mean over rows and colours. About 1 when there is no seam,
    but what stands behind the vehicle moves it, in true pictures too. "seam ratio nearby" compares with what stands in
    the same place: the NEAR steps on either side of the seam. NaN for pictures of one colour.
    """

    def __init__(self) -> None:
        super().__init__("seam", "other", "near")

    def update(self, panorama: Array, name: str) -> None:
        """Count the frame `name`: (H, W, 3) uint8, W >= 2; ValueError for anything else."""
        colours = picture(panorama, "a panorama").double()
        if colours.shape[2] < 2:
            raise ValueError("a panorama of one column has no seam")
        seam, *others = (colours.roll(-1, 2) - colours).abs().mean((0, 1)).roll(1).tolist()
        near = [*others[:NEAR], *others[max(len(others) - NEAR, NEAR) :]]
        self._keep(name, seam, float(np.mean(others)), float(np.mean(near)))

    def figures_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """Seam over the rest, and over what is near."""
        return {"seam ratio": sums[..., 0] / sums[..., 1], "seam ratio nearby": sums[..., 0] / sums[..., 2]}


class RollError(FrameMetric):
    """How far f(turned x) is from turned f(x): a network that treats all directions alike has zero.

    Of quantities (colours, depth, logits) the mean |difference| in their own unit; of class ids the share of pixels
    that differ.
    """

    def __init__(self, *, ids: bool = False) -> None:
        """ids: the answers are class ids."""
        self.ids = ids
        super().__init__("off", "values")

    def update(self, answer: Array, turned_answer: Array, columns: int, name: str) -> None:
        """Count the frame `name`.

        answer, turned_answer  f(x) and f(x.roll(columns)), of one shape (..., W): columns are the last axis.
        Raises ValueError when the shapes differ, and for NaN or infinite values.
        """
        straight, turned = as_tensor(answer).double(), as_tensor(turned_answer).double()
        if straight.shape != turned.shape:
            raise ValueError(f"answer {tuple(straight.shape)} and turned {tuple(turned.shape)} differ in shape")
        off = turned - straight.roll(columns, -1)
        if not off.isfinite().all():
            raise ValueError("an answer has values that are NaN or infinite")
        self._keep(name, float((off != 0).sum() if self.ids else off.abs().sum()), off.numel())

    def probe(self, f: Callable[[Tensor], Tensor], x: Tensor, columns: int, name: str) -> None:
        """Ask f about x (..., W) and about x turned by so many columns, and count the frame `name`."""
        self.update(f(x), f(x.roll(columns, -1)), columns, name)

    def figures_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """The mean over values."""
        return {"roll error": sums[..., 0] / sums[..., 1]}

    def _counted(self) -> tuple:
        return (*super()._counted(), self.ids)
