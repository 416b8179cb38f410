"""Patch Frechet distance: how far pictures are from real ones, patch by patch.

Frechet distance (Heusel et al. 2017) between normal distributions of the features of patches, PATCH pixels wide at
every STRIDE-th pixel: the features of EfficientNet-Lite2, at 1/16 of the raster, averaged over each patch. A few
images hold many patches, and what is judged is texture and parts of things, not the layout. Divided by the same
distance between two halves of the real images it says how many times farther they are than those from each other.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

PATCH, STRIDE, DOWN = 128, 64, 16  # pixels; DOWN: of the picture per pixel of the features


def patch_features(features: Tensor, valid: np.ndarray | None = None) -> np.ndarray:
    """Features (P, F) float64 of the patches of a picture.

    features  (F, H / DOWN, W / DOWN) of the whole picture.
    valid     (H, W) bool: patches with any other pixel are left out.
    """
    found = avg_pool2d(features.float(), PATCH // DOWN, STRIDE // DOWN).flatten(1).T
    if valid is not None:
        rows, columns = (DOWN * size for size in features.shape[1:])
        holes = np.ones((rows, columns), dtype=np.float32)
        holes[: valid.shape[0], : valid.shape[1]] = ~valid[:rows, :columns]
        found = found[avg_pool2d(torch.from_numpy(holes)[None], PATCH, STRIDE).flatten() == 0]
    return found.double().numpy()


def frechet(one: np.ndarray, other: np.ndarray) -> float:
    """Frechet distance between the normal distributions of two sets of features (P, F), (Q, F).

    |m1 - m2|^2 + tr(C1 + C2 - 2 (C1^1/2 C2 C1^1/2)^1/2): Dowson and Landau 1982.
    """
    means, spreads = zip(*((part.mean(0), np.cov(part.T)) for part in (one, other)), strict=True)
    values, vectors = np.linalg.eigh(spreads[0])
    root = (vectors * np.sqrt(values.clip(0))) @ vectors.T
    cross = np.sqrt(np.linalg.eigvalsh(root @ spreads[1] @ root).clip(0)).sum()
    return float(np.square(means[0] - means[1]).sum() + np.trace(spreads[0]) + np.trace(spreads[1]) - 2 * cross)


def patch_frechet(painted: list[np.ndarray], real: list[np.ndarray]) -> tuple[float, float]:
    """The distance of painted pictures from real ones, and that between the two halves of the real ones.

    painted, real  features (P, F) per picture, in the same order: the halves are the first and the last pictures.
    """
    half = sum(len(part) for part in real) // 2
    everything = np.concatenate(real)
    return frechet(np.concatenate(painted), everything), frechet(everything[:half], everything[half:])
