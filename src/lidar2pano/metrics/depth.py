"""How far off a panorama's depth is."""

from __future__ import annotations

import numpy as np

from lidar2pano.metrics.frames import FrameMetric
from lidar2pano.metrics.inputs import Array, as_tensor, finite, mask

NEAR_ENOUGH = 1.25  # Eigen et al. 2014, section 4.3: delta1


class DepthError(FrameMetric):
    """AbsRel, RMSE (metres) and delta1 (share within 25 %) of depths, over all scored pixels of all frames alike.

    Eigen et al. 2014 (arXiv:1406.2283), section 4.3. A frame with more truth weighs more; `per_frame` has the rest.
    """

    def __init__(self) -> None:
        super().__init__("relative", "squares", "near enough", "pixels")

    def update(self, predicted_m: Array, target_m: Array, name: str, *, valid: Array | None = None) -> None:
        """Count the frame `name`: depths (H, W), metres, a LiDAR's or the truth's as target.

        valid  (H, W) bool: which pixels are scored; by default, and at most, those with a target above zero.
        A predicted depth of zero (none) where something is scored is an answer like any other: wrong. Raises
        ValueError when the shapes differ, and for NaN or infinite depths where pixels are scored.
        """
        predicted, target = as_tensor(predicted_m), as_tensor(target_m)
        if predicted.shape != target.shape:
            raise ValueError(f"predicted {tuple(predicted.shape)} and target {tuple(target.shape)} differ in shape")
        known = mask(valid, target.shape, "valid")
        unknown = target.isnan() if known is None else target.isnan() & known
        if unknown.any():
            raise ValueError("the target depth has values that are NaN or infinite")
        scored = target > 0 if known is None else known & (target > 0)
        given, truth = finite(predicted[scored], "the predicted depth"), finite(target[scored], "the target depth")
        off = given - truth
        near = (given < NEAR_ENOUGH * truth) & (truth < NEAR_ENOUGH * given)
        sums = ((off.abs() / truth).sum(), off.square().sum(), near.sum(), near.numel())
        self._keep(name, *(float(value) for value in sums))

    def figures_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """AbsRel first."""
        relative, squares, near, pixels = np.moveaxis(sums, -1, 0)
        return {"AbsRel": relative / pixels, "RMSE": np.sqrt(squares / pixels), "delta1": near / pixels}
