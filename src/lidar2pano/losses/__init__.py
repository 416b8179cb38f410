"""Losses: supervised, adversarial, and of painted pictures.

Each takes tensors and returns a scalar tensor in float32 (or the dtype of the scores given), a mean over the batch,
without any weight.
"""

from __future__ import annotations

from lidar2pano.losses.painting import Patches, PatchStatistics, pooled
from lidar2pano.losses.supervised import lovasz_softmax

__all__ = ["PatchStatistics", "Patches", "lovasz_softmax", "pooled"]
