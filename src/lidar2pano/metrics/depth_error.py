"""Errors of depth maps."""

from __future__ import annotations

import numpy as np

from lidar2pano.metrics.accumulation import FrameMetric
from lidar2pano.metrics.input_checks import Array, as_tensor, finite

NEAR_ENOUGH = 1.25  # Eigen et al. 2014, section 4.3: delta1


class DepthError(FrameMetric):
    """AbsRel, RMSE (metres) and delta1 (share within 25 %) over all scored pixels of all frames.

    Eigen et al. 2014 (arXiv:1406.2283), section 4.3. A frame with more measured pixels weighs more.
    """

    def __init__(self) -> None:
        super().__init__("relative", "squares", "near enough", "pixels")

    def update(self, predicted_m: Array, target_m: Array, name: str) -> None:
        """Count the frame `name`: depths (H, W), metres; pixels are scored where the target is above zero.

        A predicted depth of zero (none) where a pixel is scored counts as wrong. Raises ValueError when the shapes
        differ, for a NaN in the target, and for NaN or infinite depths where pixels are scored.
        """
        predicted, target = as_tensor(predicted_m), as_tensor(target_m)
        if predicted.shape != target.shape:
            raise ValueError(f"predicted {tuple(predicted.shape)} and target {tuple(target.shape)} differ in shape")
        if target.isnan().any():
            raise ValueError("the target depth has values that are NaN or infinite")
        scored = target > 0
        given, true = finite(predicted[scored], "the predicted depth"), finite(target[scored], "the target depth")
        error = given - true
        near = (given < NEAR_ENOUGH * true) & (true < NEAR_ENOUGH * given)
        sums = ((error.abs() / true).sum(), error.square().sum(), near.sum(), near.numel())
        self._keep(name, *(float(value) for value in sums))

    def values_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """AbsRel first."""
        relative, squares, near, pixels = np.moveaxis(sums, -1, 0)
        return {"AbsRel": relative / pixels, "RMSE": np.sqrt(squares / pixels), "delta1": near / pixels}
