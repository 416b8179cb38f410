"""Frechet distances between features of two sets of images: FID, FSD with a segmenter's features, and of patches."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from lidar2pano.metrics.accumulation import Array, SetMetric, image_tensor

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
        """Count the frame `name`: two images (H, W, 3) uint8, not necessarily of one size.

        Raises ValueError when the features of one are not (1, D), or NaN or infinite.
        """
        if self._makes_room(name):
            self._keep(name, *(self._features(image, name) for image in (predicted, target)))

    def _features(self, image: Array, name: str) -> np.ndarray:
        with torch.inference_mode():
            features = self.extract(image_tensor(image)[None])
        if features.ndim != 2 or len(features) != 1 or not features.isfinite().all():
            raise ValueError(f"{self.name}: features of {name!r} are {tuple(features.shape)}, or NaN or infinite")
        return features[0].float().cpu().numpy()

    def values(self) -> dict[str, float]:
        """Return the distance under its own name; NaN of fewer than two images."""
        if len(self) < 2:
            return {self.name: float("nan")}
        return {self.name: frechet_distance(*(normal_of(self.stacked(side)) for side in (0, 1)))}


class Normal(NamedTuple):
    """A normal distribution: mean (D,), and X (K, D) with the covariance X^T X."""

    mean: np.ndarray
    factor: np.ndarray


def normal_of(features: np.ndarray) -> Normal:
    """Return the normal distribution of features (N, D): their mean and sample covariance (N - 1), in float64."""
    samples = features.astype(np.float64)
    mean = samples.mean(0)
    factor = torch.from_numpy((samples - mean) / np.sqrt(len(samples) - 1))
    short = torch.linalg.qr(factor, mode="r").R if len(factor) > len(mean) else factor  # the same X^T X
    return Normal(mean, short.numpy())


def frechet_distance(first: Normal, second: Normal) -> float:
    """Return |m1 - m2|^2 + tr(C1 + C2 - 2 (C1 C2)^(1/2)), after Dowson and Landau 1982, in float64.

    With C = X^T X the eigenvalues of C1 C2 are the squares of the singular values of X1 X2^T, so the trace of the root
    is their sum: no root of a product of nearly singular matrices is taken, and with fewer images than features nothing
    is lost.
    """
    root = torch.linalg.svdvals(torch.from_numpy(first.factor @ second.factor.T)).sum()
    traces = np.square(first.factor).sum() + np.square(second.factor).sum()
    distance = np.square(first.mean - second.mean).sum() + traces - 2 * float(root)
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
        if self._makes_room(name):
            self._keep(name, *(self._sums(image, valid) for image in (predicted, target)))

    def _sums(self, image: Array, valid: np.ndarray | None) -> np.ndarray:
        pixels = image_tensor(image)[None]
        if self.shrink > 1:
            pixels = avg_pool2d(pixels.float(), self.shrink).round().to(pixels.dtype)
        with torch.inference_mode():
            features = self.extract(pixels)[0]
        patches = patch_features(features, valid, self.down)
        count = np.full(patches.shape[1], len(patches))
        return np.vstack([patches.sum(0), patches.T @ patches, count]).astype(np.float64)

    def values(self) -> dict[str, float]:
        """Return the distance over that of the halves of the real images, and both; NaN for too few patches."""
        painted, real = self.stacked(0), self.stacked(1)
        distance = _distance(painted, real)
        among = _distance(real[: len(real) // 2], real[len(real) // 2 :])
        ratio = distance / among if among > 0 else float("nan")
        return {"ratio": ratio, "distance": distance, "real to real": among}


def patch_features(features: Tensor, valid: np.ndarray | None = None, down: int = DOWN) -> np.ndarray:
    """Return features (P, D) float64 of the patches of an image, none of one smaller than a patch.

    features  (D, H / down, W / down) of the whole image.
    valid     (H, W) bool: patches with any other pixel are left out.
    """
    if min(features.shape[1:]) < PATCH // down:
        return np.zeros((0, len(features)))
    patches = avg_pool2d(features.float(), PATCH // down, STRIDE // down).flatten(1).T
    if valid is not None:
        rows, columns = (down * size for size in features.shape[1:])
        holes = torch.ones(rows, columns)
        holes[: valid.shape[0], : valid.shape[1]] = torch.from_numpy(~valid[:rows, :columns]).float()
        patches = patches[avg_pool2d(holes[None], PATCH, STRIDE).flatten() == 0]
    return patches.double().cpu().numpy()


def _distance(first: np.ndarray, second: np.ndarray) -> float:
    """Return the distance of two sets of images by their sums (N, D + 2, D); NaN for fewer than two patches of one."""
    normals: list[Normal] = []
    for total in (part.sum(0) for part in (first, second)):
        if total.ndim < 2 or (samples := total[-1, 0]) < 2:
            return float("nan")
        mean = total[0] / samples
        values, vectors = np.linalg.eigh((total[1:-1] - samples * np.outer(mean, mean)) / (samples - 1))
        normals.append(Normal(mean, np.sqrt(values.clip(0))[:, None] * vectors.T))
    return frechet_distance(*normals)
