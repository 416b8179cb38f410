"""Frechet distance between the features of two sets of images: FID, and FSD with a segmenter's features."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from lidar2pano.metrics.accumulation import SIDES, SetMetric
from lidar2pano.metrics.input_checks import Array, image_tensor


class FrechetDistance(SetMetric):
    """Frechet distance of the Gaussians that fit the features of the predicted and of the target images.

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
        """The distance under its own name; NaN while a side has fewer than two images."""
        enough = min(map(len, self.kept.values())) > 1
        sides = (self.kept[side].stacked() for side in SIDES)
        return {self.name: frechet_distance(*sides) if enough else float("nan")}


def frechet_distance(first: np.ndarray, second: np.ndarray) -> float:
    """|m1 - m2|^2 + tr(C1 + C2 - 2 (C1 C2)^(1/2)) of features (N, D) and (M, D), in float64.

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


def fingerprint(network: nn.Module) -> str:
    """SHA-256 over name, type, shape and bytes of all of a network's tensors, in the order of their names."""
    digest = hashlib.sha256()
    for key, tensor in sorted(network.state_dict().items()):
        plain = tensor.detach().cpu().contiguous()
        digest.update(f"{key} {plain.dtype} {list(plain.shape)}\n".encode())
        digest.update(plain.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
