"""Consistency of panoramas over the seam and under rotation, and of videos over time."""

from __future__ import annotations

import numpy as np
import torch

from lidar2pano.geometry.camera import Lookup
from lidar2pano.metrics.accumulation import FrameMetric
from lidar2pano.metrics.input_checks import Array, as_tensor, image_pair, image_tensor, mask_tensor

NEAR = 8  # steps between columns, on either side of the seam


class SeamRatio(FrameMetric):
    """Mean step of colour across the seam (last column to first) over the mean step between all other columns.

    A step is |difference| of neighbouring pixels of a row, mean over rows and colours. It is about 1 when there is no
    seam, but depends on what is behind the vehicle, in camera images too. "seam ratio nearby" compares with the NEAR
    steps on either side of the seam. NaN for images of one colour.
    """

    def __init__(self) -> None:
        super().__init__("seam", "other", "near")

    def update(self, panorama: Array, name: str) -> None:
        """Count the frame `name`: (H, W, 3) uint8, W >= 2; ValueError for anything else."""
        colours = image_tensor(panorama, "a panorama").double()
        if colours.shape[2] < 2:
            raise ValueError("a panorama of one column has no seam")
        seam, *others = (colours.roll(-1, 2) - colours).abs().mean((0, 1)).roll(1).tolist()
        near = [*others[:NEAR], *others[max(len(others) - NEAR, NEAR) :]]
        self._keep(name, seam, float(np.mean(others)), float(np.mean(near)))

    def values_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """Seam over all other steps, and over the steps near it."""
        return {"seam ratio": sums[..., 0] / sums[..., 1], "seam ratio nearby": sums[..., 0] / sums[..., 2]}


class RollError(FrameMetric):
    """Difference between f(rotated x) and rotated f(x): zero for a network that treats all directions alike.

    Of quantities (colours, depth, logits) the mean |difference| in their own unit; of class ids the share of pixels
    that differ.
    """

    def __init__(self, *, ids: bool = False) -> None:
        """ids: the outputs are class ids."""
        self.ids = ids
        super().__init__("off", "values")

    def update(self, output: Array, rotated_output: Array, columns: int, name: str) -> None:
        """Count the frame `name`.

        output, rotated_output  f(x) and f(x.roll(columns)), of one shape (..., W): columns are the last axis.
        Raises ValueError when the shapes differ, and for NaN or infinite values.
        """
        straight, rotated = as_tensor(output).double(), as_tensor(rotated_output).double()
        if straight.shape != rotated.shape:
            raise ValueError(f"output {tuple(straight.shape)} and rotated {tuple(rotated.shape)} differ in shape")
        off = rotated - straight.roll(columns, -1)
        if not off.isfinite().all():
            raise ValueError("an output has values that are NaN or infinite")
        self._keep(name, float((off != 0).sum() if self.ids else off.abs().sum()), off.numel())

    def values_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """The mean over values."""
        return {"roll error": sums[..., 0] / sums[..., 1]}


class WarpingError(FrameMetric):
    """Mean squared difference (R, G, B in [0, 1]) between an image and the warped previous one, where both are visible.

    Lai et al. 2018 (arXiv:1808.00449), section 4.2: sum of M |V_t - warped V_(t-1)|^2 / sum of M; here over all pixels
    of all frames. Camera images have an error of their own (reflections, exposure, resampling): compare with it.
    """

    def __init__(self, *, circular: bool = False) -> None:
        """circular: the images' last column is next to their first."""
        self.circular = circular
        super().__init__("squares", "pixels")

    def update(self, previous: Array, current: Array, flow: Array, name: str, *, valid: Array | None = None) -> None:
        """Count the frame `name`.

        previous, current  (H, W, 3) uint8: the images at t - 1 and t.
        flow               (2, H, W) float, pixels: the content of (column, row) of `current` was at
                           (column + flow[0], row + flow[1]) of `previous`.
        valid              (H, W) bool: where the flow is known.
        Pixels that come from outside of the previous image do not count. Raises ValueError for other shapes or types,
        and for NaN or infinite flow where it is valid.
        """
        now, before = image_pair(current, previous)
        shape = now.shape[1:]
        shift = as_tensor(flow)
        if shift.shape != (2, *shape) or not shift.is_floating_point():
            raise ValueError(f"flow must be {(2, *shape)} float, not {tuple(shift.shape)} {shift.dtype}")
        scored = mask_tensor(valid, shape, "valid")
        if scored is None:
            scored = torch.ones(shape, dtype=torch.bool)
        if not shift[:, scored].isfinite().all():
            raise ValueError("the flow has values that are NaN or infinite where it is valid")
        lookup = self._lookup(torch.where(scored, shift.double(), 0.0), scored)
        off = (lookup.linear(before.double()) - now.double())[:, lookup.valid] / 255
        self._keep(name, float(off.square().sum()), float(lookup.valid.sum()))

    def _lookup(self, flow: torch.Tensor, scored: torch.Tensor) -> Lookup:
        rows, columns = scored.shape
        row = torch.arange(rows, dtype=torch.float64)[:, None] + 0.5 + flow[1]
        column = torch.arange(columns, dtype=torch.float64) + 0.5 + flow[0]
        inside = scored & (row >= 0) & (row < rows)
        if not self.circular:
            inside &= (column >= 0) & (column < columns)
        return Lookup(row=row, column=column, valid=inside, circular=self.circular)

    def values_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """The mean over pixels."""
        return {"warping error": sums[..., 0] / sums[..., 1]}
