"""Slow definitions of the metrics, and the same metrics of independent libraries."""

from __future__ import annotations

import importlib
import os
import sys
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg
import scipy.ndimage
import scipy.stats
import torch
from PIL import Image
from skimage.metrics import structural_similarity

from lidar2pano.metrics.sliced_wasserstein import LEVELS, PATCH, REPEATS, draw_directions, draw_places, stream

BINOMIAL = np.outer([1, 4, 6, 4, 1], [1, 4, 6, 4, 1]) / 256


def scikit_ssim(predicted: np.ndarray, target: np.ndarray, full: bool = False) -> Any:
    """scikit-image, set to Wang et al. 2004: the mean, or with `full` the map (H, W, 3) with its borders."""
    given = structural_similarity(
        predicted, target, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=255,
        channel_axis=2, full=full,
    )  # fmt: skip
    return given[1] if full else given


def torchmetrics_ssim(predicted: np.ndarray, target: np.ndarray) -> tuple[float, float]:
    """torchmetrics: the mean of its map's inner part, and of all; its map goes up to the borders, which it mirrors."""
    from torchmetrics.functional.image import structural_similarity_index_measure

    first, second = (torch.from_numpy(image.copy()).permute(2, 0, 1)[None].double() for image in (predicted, target))
    mean, values = structural_similarity_index_measure(
        first, second, sigma=1.5, kernel_size=11, data_range=255.0, return_full_image=True
    )
    return float(values[..., 5:-5, 5:-5].mean()), float(mean)


# --- sliced Wasserstein distance ------------------------------------------------------------------------------------


def laplacian_slowly(image: np.ndarray) -> list[np.ndarray]:
    """(H, W, 3) uint8 -> the Laplacian pyramid of Karras et al., (3, L, L) float64 each: whole convolutions."""
    side = (LEVELS[0], LEVELS[0])
    colours = [
        Image.fromarray(image[..., c].astype(np.float32)).resize(side, Image.Resampling.BILINEAR) for c in range(3)
    ]
    pyramid = [np.stack([np.asarray(colour, dtype=np.float64) for colour in colours])]
    for _ in LEVELS[1:]:
        small = scipy.ndimage.convolve(pyramid[-1], BINOMIAL[None], mode="mirror")[:, ::2, ::2]
        spread = np.zeros_like(pyramid[-1])
        spread[:, ::2, ::2] = small
        pyramid[-1] = pyramid[-1] - scipy.ndimage.convolve(spread, 4 * BINOMIAL[None], mode="mirror")
        pyramid.append(small)
    return pyramid


def patches_slowly(image: np.ndarray, places: np.ndarray) -> list[np.ndarray]:
    """Per level (PATCHES, 3, 7, 7) of a image, one patch at a time."""
    reach = PATCH // 2
    return [
        np.stack([level[:, i - reach : i + reach + 1, j - reach : j + reach + 1] for i, j in middles])
        for level, middles in zip(laplacian_slowly(image), places, strict=True)
    ]


def swd_of_a_pair_slowly(predicted: np.ndarray, target: np.ndarray, seed: int, name: str) -> list[float]:
    """SWD of one pair at each level as https://github.com/koshian2/swd-pytorch defines it, / 1000, patch by patch."""
    line = np.array([1, 4, 6, 4, 1]) / 16

    def blurred(x: np.ndarray) -> np.ndarray:
        for axis in (0, 1):
            x = scipy.ndimage.convolve1d(x, line, axis=axis, mode="constant")
        return x

    def levels(image: np.ndarray) -> list[np.ndarray]:
        wide = torch.from_numpy(image.copy()).movedim(2, 0)[None].float()
        wide = torch.nn.functional.interpolate(wide, (1024, 1024), mode="bilinear", antialias=True)
        gaussian = [wide[0].movedim(0, 2).double().numpy()]
        for _ in range(6):
            gaussian.append(blurred(gaussian[-1])[::2, ::2])
        doubled = [blurred(level.repeat(2, 0).repeat(2, 1)) for level in gaussian[1:]]
        return [*(a - b for a, b in zip(gaussian, doubled, strict=False)), gaussian[-1]]

    distances = []
    for first, second in zip(levels(predicted), levels(target), strict=True):
        generator, across = stream(seed, "pairs", name, str(len(first))), len(first) - 6
        places = [divmod(int(place), across) for place in generator.permutation(across * across)[:128]]
        directions = generator.standard_normal((147, 512), dtype=np.float32).astype(np.float64)
        directions /= directions.std(0, ddof=1)
        lines = []
        for level in (first, second):
            cut = np.stack([level[row : row + 7, column : column + 7] for row, column in places])
            cut = (cut - cut.mean((0, 1, 2))) / (cut.std((0, 1, 2), ddof=1) + 1e-8)
            lines.append(cut.transpose(0, 3, 1, 2).reshape(len(places), 147) @ directions)
        pairs = zip(lines[0].T, lines[1].T, strict=True)
        distances.append(np.mean([scipy.stats.wasserstein_distance(*pair) for pair in pairs]))
    return distances


def swd_slowly(predicted: dict[str, np.ndarray], target: dict[str, np.ndarray], seed: int = 0) -> dict[str, float]:
    """SWD x 1000 per level and their mean, one projection at a time, by scipy's Wasserstein distance."""
    sides = []
    for side, images in (("predicted", predicted), ("target", target)):
        cut = [patches_slowly(image, draw_places(seed, name, side)) for name, image in images.items()]
        sides.append([np.concatenate([of_image[level] for of_image in cut]) for level in range(len(LEVELS))])
    levels = {}
    for number, level in enumerate(LEVELS):
        normal = []
        for side in sides:
            patches = side[number]
            patches = (patches - patches.mean((0, 2, 3), keepdims=True)) / patches.std((0, 2, 3), keepdims=True)
            normal.append(patches.reshape(len(patches), -1))
        distances = [
            scipy.stats.wasserstein_distance(normal[0] @ direction, normal[1] @ direction)
            for repeat in range(REPEATS)
            for direction in draw_directions(seed, level, repeat).astype(np.float64)
        ]
        levels[str(level)] = 1e3 * float(np.mean(distances))
    return {"mean": float(np.mean(list(levels.values()))), **levels}


# --- Frechet distance -----------------------------------------------------------------------------------------------


def frechet_by_square_root(first: np.ndarray, second: np.ndarray) -> float:
    """The formula as it stands, with scipy's root of the product of the covariances."""
    covariances = [np.cov(side.astype(np.float64), rowvar=False) for side in (first, second)]
    root = np.real(np.asarray(scipy.linalg.sqrtm(covariances[0] @ covariances[1])))
    means = [side.astype(np.float64).mean(0) for side in (first, second)]
    return float(np.sum((means[0] - means[1]) ** 2) + np.trace(covariances[0] + covariances[1] - 2 * root))


def frechet_by_torchmetrics(first: np.ndarray, second: np.ndarray) -> float:
    from torchmetrics.image.fid import _compute_fid  # the class itself wants torch-fidelity

    sides = [torch.from_numpy(side).double() for side in (first, second)]
    (m1, c1), (m2, c2) = ((side.mean(0), side.T.cov()) for side in sides)
    return float(_compute_fid(m1, c1, m2, c2))


def fidelity_inception(weights: Path) -> Any | None:
    """torch-fidelity's extractor of the 2048 features with the weights of a file; None where it is not at hand.

    The package imports torchvision at once, its extractor does not need it: so the package's own __init__ is left out,
    and it lies in a folder of its own, TORCH_FIDELITY: `pip install --no-deps --target FOLDER torch-fidelity`.
    """
    folder = Path(os.environ.get("TORCH_FIDELITY", "")) / "torch_fidelity"
    if not (folder / "feature_extractor_inceptionv3.py").is_file():
        return None
    package = types.ModuleType("torch_fidelity")
    package.__path__ = [str(folder)]
    sys.modules["torch_fidelity"] = package
    try:
        module = importlib.import_module("torch_fidelity.feature_extractor_inceptionv3")
        return module.FeatureExtractorInceptionV3("inception", ["2048"], str(weights))
    finally:
        for name in [name for name in sys.modules if name.partition(".")[0] == "torch_fidelity"]:
            del sys.modules[name]


# --- one pixel at a time --------------------------------------------------------------------------------------------


def depth_slowly(predicted: Sequence[np.ndarray], target: Sequence[np.ndarray]) -> dict[str, float]:
    relative, squares, near = [], [], []
    for p, t in zip(np.concatenate([p.ravel() for p in predicted]).tolist(),
                    np.concatenate([t.ravel() for t in target]).tolist(), strict=True):  # fmt: skip
        if t > 0:
            relative.append(abs(p - t) / t)
            squares.append((p - t) ** 2)
            near.append(p > 0 and max(p / t, t / p) < 1.25)
    return {
        "AbsRel": float(np.mean(relative)),
        "RMSE": float(np.sqrt(np.mean(squares))),
        "delta1": float(np.mean(near)),
    }


def warping_slowly(
    previous: np.ndarray, current: np.ndarray, flow: np.ndarray, scored: np.ndarray, circular: bool
) -> float:
    """Bilinear between pixel centres; beyond the outermost centres the outermost pixel, or the other end's columns."""
    rows, columns = scored.shape
    errors = []
    for i, j in zip(*scored.nonzero(), strict=True):
        row, column = i + float(flow[1, i, j]), j + float(flow[0, i, j])
        if not -0.5 <= row < rows - 0.5 or not (circular or -0.5 <= column < columns - 0.5):
            continue
        top, left = int(np.floor(row)), int(np.floor(column))
        warped = np.zeros(3)
        for a, b in ((0, 0), (0, 1), (1, 0), (1, 1)):
            weight = abs(1 - a - (row - top)) * abs(1 - b - (column - left))
            c = (left + b) % columns if circular else min(max(left + b, 0), columns - 1)
            warped += weight * previous[min(max(top + a, 0), rows - 1), c]
        errors.append((((warped - current[i, j]) / 255) ** 2).sum())
    return float(np.mean(errors))


def seam_slowly(panorama: np.ndarray, near: int = 0) -> float:
    """Over all other steps, or over `near` of them on either side."""
    rows, columns = panorama.shape[:2]
    steps = []
    for j in range(columns):
        beyond = (j + 1) % columns
        steps.append(
            np.mean([abs(int(panorama[i, beyond, c]) - int(panorama[i, j, c])) for i in range(rows) for c in range(3)])
        )
    seam = columns - 1
    others = {j % columns for away in range(1, near + 1) for j in (seam - away, seam + away)} - {seam}
    return float(steps[-1] / np.mean([steps[j] for j in others or range(columns - 1)]))
