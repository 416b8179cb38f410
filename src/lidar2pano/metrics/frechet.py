"""Frechet distances between features of two sets of images: FID, FSD with a segmenter's features, and of patches."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from lidar2pano.metrics.accumulation import SIDES, Array, SetMetric, image_tensor

PATCH, STRIDE, DOWN = 128, 64, 16  # pixels; DOWN: of the image per pixel of EfficientNet-Lite2's features


class FrechetDistance(SetMetric):
    """Frechet distance of the Gaussians fitted to the features of the predicted and of the target images.

    Heusel et al. 2017 (arXiv:1706.08500), equation 6. It is biased: it falls with the number of images, so compare
    only over equally many, and only values of the same feature extractor.
    """

    MOST = 50_000  # images of a side, as in Heusel et al. 2017

    def __init__(self, extract: Callable[[Tensor], Tensor], *, name: str) -> None:
        """extract: (B, 3, H, W) uint8 -> (B, D) float features; name: "FID" if Inception's, "FSD" if a segmenter's."""
        self.extract, self.name = extract, name
        super().__init__()

    def update(self, predicted: Array, target: Array, name: str) -> None:
        """Count the frame `name`: two images (H, W, 3) uint8, not necessarily of one size."""
        self.take(predicted, name, "predicted")
        self.take(target, name, "target")

    def take(self, image: Array, name: str, side: str) -> None:
        """Count one image (H, W, 3) uint8 of the "predicted" or the "target"; the sets may differ in size.

        Raises ValueError when its features are not (1, D), or NaN or infinite.
        """
        if not self._makes_room(name, side):
            return
        with torch.inference_mode():
            features = self.extract(image_tensor(image)[None])
        if features.ndim != 2 or len(features) != 1 or not features.isfinite().all():
            raise ValueError(f"{self.name}: features of {name!r} are {tuple(features.shape)}, or NaN or infinite")
        self.kept[side][name] = features[0].float().cpu().numpy()

    def values(self) -> dict[str, float]:
        """Return the distance under its own name; NaN while a side has fewer than two images."""
        enough = min(map(len, self.kept.values())) > 1
        sides = (self.kept[side].stacked() for side in SIDES)
        return {self.name: frechet_distance(*sides) if enough else float("nan")}


def frechet_distance(first: np.ndarray, second: np.ndarray) -> float:
    """Return |m1 - m2|^2 + tr(C1 + C2 - 2 (C1 C2)^(1/2)) of features (N, D) and (M, D), in float64.

    m: means, C: sample covariances (N - 1). With C = X^T X, X the centred features over (N - 1)^(1/2), the eigenvalues
    of C1 C2 are the squares of the singular values of X1 X2^T, so the trace of the root is their sum: no root of a
    product of nearly singular matrices is taken, and with fewer images than features nothing is lost.
    Raises ValueError for fewer than two rows, for different D, and for NaN or infinite features.
    """
    sides = [torch.from_numpy(np.ascontiguousarray(side, dtype=np.float64)) for side in (first, second)]
    if any(side.ndim != 2 or len(side) < 2 for side in sides) or sides[0].shape[1] != sides[1].shape[1]:
        raise ValueError(f"features of shapes {np.shape(first)} and {np.shape(second)} have no Frechet distance")
    if not all(side.isfinite().all() for side in sides):
        raise ValueError("features are NaN or infinite")
    means = [side.mean(0) for side in sides]
    factors = [(side - mean) / np.sqrt(len(side) - 1) for side, mean in zip(sides, means, strict=True)]
    traces = sum(factor.square().sum() for factor in factors)
    short = [torch.linalg.qr(x, mode="r").R if len(x) > x.shape[1] else x for x in factors]  # the same X^T X
    root = torch.linalg.svdvals(short[0] @ short[1].T).sum()
    distance = (means[0] - means[1]).square().sum() + traces - 2 * root
    return max(float(distance), 0.0)  # equal sets: rounding on either side of zero


# --- patches ----------------------------------------------------------------------------------------------------------


class PatchFrechetDistance(SetMetric):
    """Patch Frechet distance: how far images are from real ones, patch by patch.

    Frechet distance (Heusel et al. 2017) between normal distributions of the features of patches, PATCH pixels wide at
    every STRIDE-th pixel: features at 1/down of the raster, averaged over each patch. A few images hold many patches;
    texture and parts of things are compared, not the layout. Divided by the same distance between two halves of the
    real images it says how many times farther they are than those from each other. Of each image the count, sum and sum
    of products of its patches' features are kept.
    """

    MOST = 10_000  # images of a side

    def __init__(self, extract: Callable[[Tensor], Tensor], down: int = DOWN, shrink: int = 1) -> None:
        """extract: (B, 3, H, W) uint8 -> (B, D, H / down, W / down) float features.

        shrink: by how much images are reduced before, by means of pixels.
        """
        self.extract, self.down, self.shrink = extract, down, shrink
        super().__init__()

    def update(self, predicted: Array, target: Array, name: str, valid: np.ndarray | None = None) -> None:
        """Count two images (H, W, 3) uint8 of the frame `name`, but for patches with a pixel not `valid` (H, W)."""
        if valid is not None and self.shrink > 1:
            valid = avg_pool2d(torch.from_numpy(valid).float()[None], self.shrink)[0].numpy() == 1
        for side, image in zip(SIDES, (predicted, target), strict=True):
            if self._makes_room(name, side):
                pixels = image_tensor(image)[None]
                if self.shrink > 1:
                    pixels = avg_pool2d(pixels.float(), self.shrink).round().to(pixels.dtype)
                with torch.inference_mode():
                    features = self.extract(pixels)[0]
                patches = patch_features(features, valid, self.down)
                count = np.full(patches.shape[1], len(patches))
                self.kept[side][name] = np.vstack([patches.sum(0), patches.T @ patches, count]).astype(np.float64)

    def values(self) -> dict[str, float]:
        """Return the distance over that of the halves of the real images, and both; NaN for too few patches."""
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


def patch_features(features: Tensor, valid: np.ndarray | None = None, down: int = DOWN) -> np.ndarray:
    """Return features (P, D) float64 of the patches of an image.

    features  (D, H / down, W / down) of the whole image.
    valid     (H, W) bool: patches with any other pixel are left out.
    """
    patches = avg_pool2d(features.float(), PATCH // down, STRIDE // down).flatten(1).T
    if valid is not None:
        rows, columns = (down * size for size in features.shape[1:])
        holes = torch.ones(rows, columns)
        holes[: valid.shape[0], : valid.shape[1]] = torch.from_numpy(~valid[:rows, :columns]).float()
        patches = patches[avg_pool2d(holes[None], PATCH, STRIDE).flatten() == 0]
    return patches.double().cpu().numpy()


def normal_distance(first: Normal, second: Normal) -> float:
    """Return the Frechet distance |m1 - m2|^2 + tr(C1 + C2 - 2 (C1^1/2 C2 C1^1/2)^1/2), after Dowson and Landau 1982.

    NaN if either was estimated of fewer than two samples.
    """
    if min(first.samples, second.samples) < 2:
        return float("nan")
    values, vectors = np.linalg.eigh(first.spread)
    root = (vectors * np.sqrt(values.clip(0))) @ vectors.T
    cross = np.sqrt(np.linalg.eigvalsh(root @ second.spread @ root).clip(0)).sum()
    traces = np.trace(first.spread) + np.trace(second.spread)
    distance = np.square(first.mean - second.mean).sum() + traces - 2 * cross
    return max(float(distance), 0.0)


def _normal(kept: list[np.ndarray]) -> Normal:
    total = np.sum(kept, axis=0) if kept else np.zeros((2, 0))
    samples = int(total[-1, 0]) if total.size else 0
    if samples < 2:
        return Normal(np.zeros(0), np.zeros((0, 0)), samples)
    mean = total[0] / samples
    return Normal(mean, (total[1:-1] - samples * np.outer(mean, mean)) / (samples - 1), samples)
