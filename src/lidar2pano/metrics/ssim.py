"""Structural similarity of two images."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lidar2pano.metrics.accumulation import FrameMetric
from lidar2pano.metrics.input_checks import Array, image_pair, mask_tensor

WINDOW, SIGMA = 11, 1.5  # pixels; Wang et al. 2004, section III-B
K1, K2, RANGE = 0.01, 0.03, 255.0  # ditto, section III-C
REACH = WINDOW // 2
STRIP = 64  # rows worked on at a time: intermediate results stay in the processor's cache


class SSIM(FrameMetric):
    """Structural similarity, Wang et al. 2004, equation 13: the mean over the frames of each frame's mean.

    Gaussian window of 11 x 11 pixels, sigma 1.5; K 0.01 and 0.03; a data range of 255; each colour on its own, then
    their mean. Borders: only windows that lie wholly in the image count, so (H - 10) x (W - 10) of them (as Wang et
    al. and scikit-image have it; torchmetrics mirrors the image beyond its borders and counts those windows too).
    """

    def __init__(self) -> None:
        super().__init__("ssim", "frames")

    def update(self, predicted: Array, target: Array, name: str, *, valid: Array | None = None) -> None:
        """Count the frame `name`: images (H, W, 3) uint8.

        valid  (H, W) bool: where the target is known; a window counts where all of it is. A frame without such a
               window does not count.
        Raises ValueError for other types, shapes that differ and images smaller than the window.
        """
        values = ssim_map(predicted, target)
        known = mask_tensor(valid, (values.shape[0] + 2 * REACH, values.shape[1] + 2 * REACH), "valid")
        if known is not None:
            unknown = (~known).float()[None, None]
            values = values[torch.nn.functional.max_pool2d(unknown, WINDOW, 1)[0, 0] == 0]
        self._keep(name, float(values.double().mean()) if values.numel() else 0.0, float(values.numel() > 0))

    def values_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """The mean over frames."""
        return {"SSIM": sums[..., 0] / sums[..., 1]}


def ssim_map(predicted: Array, target: Array) -> Tensor:
    """SSIM of every window, mean of the three colours: two (H, W, 3) uint8 -> (H - 10, W - 10) float32.

    Wang et al. 2004, equation 13 with weighted means, deviations and covariance (equations 14 to 16) that are those of
    the window, not estimates of a population's. Raises ValueError unless both are images of one size.
    """
    first, second = image_pair(predicted, target)
    rows, columns = (length - 2 * REACH for length in first.shape[1:])
    if rows < 1 or columns < 1:
        raise ValueError(f"an image of {tuple(first.shape[1:])} is smaller than the window of {WINDOW} x {WINDOW}")
    weights = _window()
    # variances do not depend on the offset, and float32 is most precise around zero
    a, b = first.float() - RANGE / 2, second.float() - RANGE / 2
    strips = []
    for top in range(0, rows, STRIP):
        x, y = (image[:, top : top + STRIP + 2 * REACH] for image in (a, b))
        means = torch.stack([x, y, torch.addcmul(x * x, y, y), x * y])
        strips.append(_similarity(_blurred(means, weights)).mean(0))
    return torch.cat(strips)


def _window() -> list[float]:
    offset = np.arange(-REACH, REACH + 1)
    weight = np.exp(-(offset**2) / (2 * SIGMA**2))
    return (weight / weight.sum()).tolist()


def _blurred(x: Tensor, weights: list[float]) -> Tensor:
    """(..., H, W) -> (..., H - 10, W - 10): the window is the product of one over rows and one over columns."""
    for dim in (-2, -1):
        length = x.shape[dim] - 2 * REACH
        blurred = x.narrow(dim, 0, length) * weights[0]
        for place, weight in enumerate(weights[1:], 1):
            blurred.add_(x.narrow(dim, place, length), alpha=weight)
        x = blurred
    return x


def _similarity(means: Tensor) -> Tensor:
    """From the windows' means of a, b, a^2 + b^2 and a b, a and b measured from the middle of the range."""
    mean_a, mean_b, squares, product = means.unbind(0)
    c1, c2 = (K1 * RANGE) ** 2, (K2 * RANGE) ** 2
    variances = squares - mean_a * mean_a - mean_b * mean_b
    covariance = product - mean_a * mean_b
    mean_a, mean_b = mean_a + RANGE / 2, mean_b + RANGE / 2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a * mean_a + mean_b * mean_b + c1)
    return luminance * (2 * covariance + c2) / (variances + c2)
