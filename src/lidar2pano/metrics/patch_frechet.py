"""Patch Frechet distance: how far pictures are from real ones, patch by patch.

Frechet distance (Heusel et al. 2017) between normal distributions of the features of patches, PATCH pixels wide at
every STRIDE-th pixel: features at 1/16 of the raster, averaged over each patch. A few images hold many patches, and
what is compared is texture and parts of things, not the layout. Divided by the same distance between two halves of the
real images it says how many times farther they are than those from each other.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from lidar2pano.metrics.accumulation import SIDES, SetMetric
from lidar2pano.metrics.input_checks import Array, image_tensor

PATCH, STRIDE, DOWN = 128, 64, 16  # pixels; DOWN: of the picture per pixel of the features


class PatchFrechetDistance(SetMetric):
    """Patch Frechet distance; of each image the count, sum and sum of products of its patches' features are kept."""

    MOST = 10_000  # images of a side

    def __init__(self, extract: Callable[[Tensor], Tensor]) -> None:
        """extract: (B, 3, H, W) uint8 -> (B, D, H / DOWN, W / DOWN) float features."""
        self.extract = extract
        super().__init__()

    def update(self, predicted: Array, target: Array, name: str, valid: np.ndarray | None = None) -> None:
        """Count two images (H, W, 3) uint8 of the frame `name`, but for patches with a pixel not `valid` (H, W)."""
        for side, image in zip(SIDES, (predicted, target), strict=True):
            if self._makes_room(name, side):
                with torch.inference_mode():
                    features = self.extract(image_tensor(image)[None])[0]
                found = patch_features(features, valid)
                count = np.full(found.shape[1], len(found))
                self.kept[side][name] = np.vstack([found.sum(0), found.T @ found, count]).astype(np.float64)

    def values(self) -> dict[str, float]:
        """The distance over that between the halves of the real images by name, and both; NaN for too few patches."""
        painted, real = ([self.kept[side][name] for name in sorted(self.kept[side])] for side in SIDES)
        first, second = (_normal(half) for half in (real[: len(real) // 2], real[len(real) // 2 :]))
        distance, among = normal_distance(_normal(painted), _normal(real)), normal_distance(first, second)
        ratio = distance / among if among > 0 else float("nan")
        return {"ratio": ratio, "distance": distance, "real to real": among}


class Normal(NamedTuple):
    """A normal distribution: mean (D,), covariance (D, D), and of how many samples it was estimated."""

    mean: np.ndarray
    spread: np.ndarray
    samples: int


def patch_features(features: Tensor, valid: np.ndarray | None = None) -> np.ndarray:
    """Features (P, D) float64 of the patches of a picture.

    features  (D, H / DOWN, W / DOWN) of the whole picture.
    valid     (H, W) bool: patches with any other pixel are left out.
    """
    found = avg_pool2d(features.float(), PATCH // DOWN, STRIDE // DOWN).flatten(1).T
    if valid is not None:
        rows, columns = (DOWN * size for size in features.shape[1:])
        holes = torch.ones(rows, columns)
        holes[: valid.shape[0], : valid.shape[1]] = torch.from_numpy(~valid[:rows, :columns]).float()
        found = found[avg_pool2d(holes[None], PATCH, STRIDE).flatten() == 0]
    return found.double().cpu().numpy()


def normal_distance(one: Normal, other: Normal) -> float:
    """Frechet distance |m1 - m2|^2 + tr(C1 + C2 - 2 (C1^1/2 C2 C1^1/2)^1/2), after Dowson and Landau 1982.

    NaN where one was estimated of fewer than two samples.
    """
    if min(one.samples, other.samples) < 2:
        return float("nan")
    values, vectors = np.linalg.eigh(one.spread)
    root = (vectors * np.sqrt(values.clip(0))) @ vectors.T
    cross = np.sqrt(np.linalg.eigvalsh(root @ other.spread @ root).clip(0)).sum()
    distance = np.square(one.mean - other.mean).sum() + np.trace(one.spread) + np.trace(other.spread) - 2 * cross
    return max(float(distance), 0.0)


def _normal(kept: list[np.ndarray]) -> Normal:
    total = np.sum(kept, axis=0) if kept else np.zeros((2, 0))
    samples = int(total[-1, 0]) if total.size else 0
    if samples < 2:
        return Normal(np.zeros(0), np.zeros((0, 0)), samples)
    mean = total[0] / samples
    return Normal(mean, (total[1:-1] - samples * np.outer(mean, mean)) / (samples - 1), samples)
