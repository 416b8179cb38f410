"""Flicker: a picture against the one before it, carried over by the flow."""

from __future__ import annotations

import numpy as np
import torch

from lidar2pano.geometry.camera import Lookup
from lidar2pano.metrics.frames import FrameMetric
from lidar2pano.metrics.inputs import Array, as_tensor, mask, pictures


class WarpingError(FrameMetric):
    """Mean squared distance (R, G, B in [0, 1]) of a picture from the one before it, warped, where that can be seen.

    Lai et al. 2018 (arXiv:1808.00449), section 4.2: sum of M |V_t - warped V_(t-1)|^2 / sum of M; here over all pixels
    of all frames alike. Truth has an error of its own (reflections, exposure, resampling): compare with it.
    """

    def __init__(self, *, circular: bool = False) -> None:
        """circular: the pictures' last column meets their first."""
        self.circular = circular
        super().__init__("squares", "pixels")

    def update(
        self,
        previous: Array,
        current: Array,
        flow: Array,
        name: str,
        *,
        valid: Array | None = None,
        occluded: Array | None = None,
    ) -> None:
        """Count the frame `name`.

        previous, current  (H, W, 3) uint8: the pictures at t - 1 and t.
        flow               (2, H, W) float, pixels: what is at (column, row) of `current` was at
                           (column + flow[0], row + flow[1]) of `previous`.
        valid              (H, W) bool: where the flow is known.
        occluded           (H, W) bool: what could not be seen at t - 1.
        Pixels whose place lies outside of the previous picture do not count. Raises ValueError when shapes or types
        are others, and where the flow is NaN or infinite but said to be known.
        """
        now, before = pictures(current, previous)
        shape = now.shape[1:]
        shift = as_tensor(flow)
        if shift.shape != (2, *shape) or not shift.is_floating_point():
            raise ValueError(f"flow must be {(2, *shape)} float, not {tuple(shift.shape)} {shift.dtype}")
        known = mask(valid, shape, "valid")
        hidden = mask(occluded, shape, "occluded")
        scored = torch.ones(shape, dtype=torch.bool) if known is None else known.clone()
        if hidden is not None:
            scored &= ~hidden
        if not shift[:, scored].isfinite().all():
            raise ValueError("the flow has values that are NaN or infinite where it is said to be known")
        lookup = self._places(torch.where(scored, shift.double(), 0.0), scored)
        off = (lookup.linear(before.double()) - now.double())[:, lookup.valid] / 255
        self._keep(name, float(off.square().sum()), float(lookup.valid.sum()))

    def _places(self, flow: torch.Tensor, scored: torch.Tensor) -> Lookup:
        rows, columns = scored.shape
        row = torch.arange(rows, dtype=torch.float64)[:, None] + 0.5 + flow[1]
        column = torch.arange(columns, dtype=torch.float64) + 0.5 + flow[0]
        inside = scored & (row >= 0) & (row < rows)
        if not self.circular:
            inside &= (column >= 0) & (column < columns)
        return Lookup(row=row, column=column, valid=inside, circular=self.circular)

    def figures_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """The mean over pixels."""
        return {"warping error": sums[..., 0] / sums[..., 1]}

    def _counted(self) -> tuple:
        return (*super()._counted(), self.circular)
