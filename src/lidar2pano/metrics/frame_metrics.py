"""Metrics of single images, depth maps and panoramas: similarity, colours, depths, consistency in space and time."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d, normalize, pad

from lidar2pano.geometry.camera import Lookup
from lidar2pano.labels import COMMON15
from lidar2pano.metrics.accumulation import Array, FrameMetric, as_tensor, image_pair, image_tensor, mask_tensor

# IEC 61966-2-1: linear sRGB -> XYZ; the white point is D65
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
WHITE = TO_XYZ.sum(1)
KNEE, SLOPE = (6 / 29) ** 3, (29 / 6) ** 2 / 3  # of Lab's cube root, which is a line below
FAR = 25.0**7  # CIEDE2000's bound of chroma
WINDOW, SIGMA = 11, 1.5  # pixels; Wang et al. 2004, section III-B
K1, K2, RANGE = 0.01, 0.03, 255.0  # ditto, section III-C
REACH = WINDOW // 2


def linear_light(codes: np.ndarray) -> np.ndarray:
    """Return light in [0, 1], float64, of sRGB's codes in [0, 255] (any shape)."""
    share = np.asarray(codes, dtype=np.float64) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def lab(light: np.ndarray) -> np.ndarray:
    """Return CIE Lab (..., 3) of linear sRGB (..., 3) in [0, 1]."""
    share = np.asarray(light) @ TO_XYZ.T / WHITE
    x, y, z = np.moveaxis(np.where(share > KNEE, np.cbrt(share), SLOPE * share + 4 / 29), -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


# Sharma, Wu, Dalal 2005, "The CIEDE2000 color-difference formula", equations 2 to 22; all weights are 1.
def ciede2000(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the differences (...) of colours in CIE Lab (..., 3) each."""
    (l1, a1, b1), (l2, a2, b2) = (np.moveaxis(np.asarray(part, dtype=np.float64), -1, 0) for part in (first, second))
    chroma7 = ((np.hypot(a1, b1) + np.hypot(a2, b2)) / 2) ** 7
    stretch = 1.5 - 0.5 * np.sqrt(chroma7 / (chroma7 + FAR))
    c1, c2 = np.hypot(stretch * a1, b1), np.hypot(stretch * a2, b2)
    h1, h2 = (np.degrees(np.arctan2(b, stretch * a)) % 360 for a, b in ((a1, b1), (a2, b2)))
    grey = c1 * c2 == 0
    turn = np.where(grey, 0.0, (h2 - h1 + 180) % 360 - 180)
    turn = np.where((turn == -180) & (h2 > h1), 180.0, turn)
    delta_l, delta_c = l2 - l1, c2 - c1
    delta_h = 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn) / 2)
    lightness, c = (l1 + l2) / 2, (c1 + c2) / 2
    apart = np.abs(h1 - h2) > 180
    h = np.where(grey, h1 + h2, (h1 + h2 + np.where(apart, np.where(h1 + h2 < 360, 360, -360), 0)) / 2)
    t = 1 - 0.17 * _cos(h - 30) + 0.24 * _cos(2 * h) + 0.32 * _cos(3 * h + 6) - 0.20 * _cos(4 * h - 63)
    rotation = 60 * np.exp(-(((h - 275) / 25) ** 2))
    s_l = 1 + 0.015 * (lightness - 50) ** 2 / np.sqrt(20 + (lightness - 50) ** 2)
    s_c, s_h = 1 + 0.045 * c, 1 + 0.015 * c * t
    r_t = -np.sin(np.radians(rotation)) * 2 * np.sqrt(c**7 / (c**7 + FAR))
    parts = delta_l / s_l, delta_c / s_c, delta_h / s_h
    return np.sqrt(parts[0] ** 2 + parts[1] ** 2 + parts[2] ** 2 + r_t * parts[1] * parts[2])


def _cos(degrees: np.ndarray) -> np.ndarray:
    return np.cos(np.radians(degrees))


class ClassColourError(FrameMetric):
    """CIEDE2000 between the mean light of each class in two images; the mean over classes, by their pixels."""

    def __init__(self) -> None:
        names = COMMON15.classes
        super().__init__(*(f"{kind} {name}" for name in names for kind in ("difference", "pixels")))

    def update(self, predicted: np.ndarray, target: np.ndarray, classes: np.ndarray, name: str) -> None:
        """Count the image `name`: (H, W, 3) uint8 both, and the classes (H, W) uint8 of COMMON15; 0 does not count."""
        if predicted.shape != target.shape or classes.shape != target.shape[:2]:
            raise ValueError(f"images {predicted.shape}, {target.shape} and classes {classes.shape} differ in size")
        light = [linear_light(image[classes > 0]) for image in (predicted, target)]
        ids, sums = classes[classes > 0], []
        for index in range(len(COMMON15)):
            chosen = ids == index
            pixels = int(chosen.sum())
            difference = float(ciede2000(*(lab(part[chosen].mean(0)) for part in light))) if pixels else 0.0
            sums += [difference * pixels, float(pixels)]
        self._keep(name, *sums)

    def values_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """Return the mean, and the means of each class."""
        differences, pixels = sums[..., 0::2], sums[..., 1::2]
        with np.errstate(invalid="ignore", divide="ignore"):
            values = {"class colour error": differences.sum(-1) / pixels.sum(-1)}
            return values | {
                f"class colour error {name}": differences[..., index] / pixels[..., index]
                for index, name in enumerate(COMMON15.classes)
            }


class MeanMetric(FrameMetric):
    """The mean of a quantity over what is counted of all frames; `title` is its name."""

    title: ClassVar[str]

    def __init__(self) -> None:
        super().__init__("sum", "count")

    def values_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """Return the mean."""
        return {self.title: sums[..., 0] / sums[..., 1]}

    def _keep_mean(self, name: str, values: Tensor) -> None:
        """Keep the mean of a frame, as one; a frame without values does not count."""
        self._keep(name, float(values.double().mean()) if values.numel() else 0.0, float(values.numel() > 0))


class SSIM(MeanMetric):
    """Structural similarity, Wang et al. 2004, equation 13: the mean over the frames of each frame's mean.

    Gaussian window of 11 x 11 pixels, sigma 1.5; K 0.01 and 0.03; a data range of 255; each colour on its own, then
    their mean. Borders: only windows wholly in the image count, so (H - 10) x (W - 10) of them (as Wang et
    al. and scikit-image have it; torchmetrics mirrors the image beyond its borders and counts those windows too).
    """

    title = "SSIM"

    def update(self, predicted: Array, target: Array, name: str, *, valid: Array | None = None) -> None:
        """Count the frame `name`: images (H, W, 3) uint8.

        valid  (H, W) bool: known pixels of the target; a window counts if all of its pixels are. A frame without such
               a window does not count.
        Raises ValueError for other types, different shapes and images smaller than the window.
        """
        values = ssim_map(predicted, target)
        mask = mask_tensor(valid, (values.shape[0] + 2 * REACH, values.shape[1] + 2 * REACH), "valid")
        if mask is not None:
            values = values[max_pool2d((~mask).float()[None, None], WINDOW, 1)[0, 0] == 0]
        self._keep_mean(name, values)


def ssim_map(predicted: Array, target: Array) -> Tensor:
    """Return SSIM of every window, mean of the three colours: two (H, W, 3) uint8 -> (H - 10, W - 10) float32.

    Wang et al. 2004, equation 13 with weighted means, deviations and covariance (equations 14 to 16) of the window
    itself, not estimates of a population's. Raises ValueError unless both are images of one size.
    """
    first, second = image_pair(predicted, target)
    rows, columns = (length - 2 * REACH for length in first.shape[1:])
    if rows < 1 or columns < 1:
        raise ValueError(f"an image of {tuple(first.shape[1:])} is smaller than the window of {WINDOW} x {WINDOW}")
    window = torch.exp(-torch.arange(-REACH, REACH + 1.0, dtype=torch.float64).square() / (2 * SIGMA**2))
    window = (window / window.sum()).float()
    # variances do not depend on the offset, and float32 is most precise around zero
    a, b = first.float() - RANGE / 2, second.float() - RANGE / 2
    means = torch.stack([a, b, a * a + b * b, a * b]).flatten(0, 1)[:, None]
    for kernel in (window.view(1, 1, -1, 1), window.view(1, 1, 1, -1)):
        means = conv2d(means, kernel)
    return _similarity(means.view(4, 3, rows, columns)).mean(0)


def _similarity(means: Tensor) -> Tensor:
    """Compute SSIM from the windows' means of a, b, a^2 + b^2 and a b; a and b are relative to the range's middle."""
    mean_a, mean_b, squares, product = means.unbind(0)
    c1, c2 = (K1 * RANGE) ** 2, (K2 * RANGE) ** 2
    variances = squares - mean_a * mean_a - mean_b * mean_b
    covariance = product - mean_a * mean_b
    mean_a, mean_b = mean_a + RANGE / 2, mean_b + RANGE / 2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a * mean_a + mean_b * mean_b + c1)
    return luminance * (2 * covariance + c2) / (variances + c2)


class FeatureDistance(MeanMetric):
    """Distance of an image from the real one by the features of a network, in [0, 2] for features of no sign.

    Zhang et al. 2018 (LPIPS), equation 1, at one depth and without learned weights: the squared difference of the
    features at a place, each of length 1, as a mean over an image's places and then over the frames.
    """

    title = "distance"

    def __init__(self, extract: Callable[[Tensor], Tensor], down: int) -> None:
        """extract: (B, 3, H, W) uint8 -> (B, D, H / down, W / down) float features."""
        super().__init__()
        self.extract, self.down = extract, down

    def update(self, predicted: Array, target: Array, name: str, *, valid: Array | None = None) -> None:
        """Count the frame `name`: images (H, W, 3) uint8; places with a pixel not `valid` (H, W) do not count."""
        pair = image_pair(predicted, target)
        with torch.inference_mode():
            first, second = (normalize(self.extract(image[None])[0].float(), dim=0) for image in pair)
        distances = (first - second).square().sum(0).cpu()
        mask = mask_tensor(valid, pair[0].shape[1:], "valid")
        if mask is not None:
            holes = pad((~mask).float()[None], (0, -mask.shape[1] % self.down, 0, -mask.shape[0] % self.down))
            distances = distances[max_pool2d(holes, self.down)[0] == 0]
        self._keep_mean(name, distances)


# --- depth ------------------------------------------------------------------------------------------------------------

NEAR_ENOUGH = 1.25  # Eigen et al. 2014, section 4.3: delta1


class DepthError(FrameMetric):
    """AbsRel, RMSE (metres) and delta1 (share within 25 %) over all scored pixels of all frames.

    Eigen et al. 2014 (arXiv:1406.2283), section 4.3. A frame with more measured pixels weighs more.
    """

    def __init__(self) -> None:
        super().__init__("relative", "squares", "near enough", "pixels")

    def update(self, predicted_m: Array, target_m: Array, name: str) -> None:
        """Count the frame `name`: depths (H, W), metres; pixels are scored if the target is above zero.

        A predicted depth of zero (none) of a scored pixel counts as wrong. Raises ValueError when the shapes
        differ, for a NaN in the target, and for NaN or infinite depths of scored pixels.
        """
        predicted, target = as_tensor(predicted_m), as_tensor(target_m)
        if predicted.shape != target.shape:
            raise ValueError(f"predicted {tuple(predicted.shape)} and target {tuple(target.shape)} differ in shape")
        if target.isnan().any():
            raise ValueError("the target depth has values that are NaN or infinite")
        scored = target > 0
        depth, true = predicted[scored].double(), target[scored].double()
        error = depth - true
        near = (depth < NEAR_ENOUGH * true) & (true < NEAR_ENOUGH * depth)
        sums = ((error.abs() / true).sum(), error.square().sum(), near.sum(), near.numel())
        self._keep(name, *(float(value) for value in sums))

    def values_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """Return AbsRel, RMSE and delta1."""
        relative, squares, near, pixels = np.moveaxis(sums, -1, 0)
        return {"AbsRel": relative / pixels, "RMSE": np.sqrt(squares / pixels), "delta1": near / pixels}


# --- consistency ------------------------------------------------------------------------------------------------------

NEAR = 8  # steps between columns, on either side of the seam


class SeamRatio(FrameMetric):
    """Mean step of colour across the seam (last column to first) over the mean step between all other columns.

    A step is |difference| of neighbouring pixels of a row, mean over rows and colours. It is about 1 when there is no
    seam, but depends on the scene behind the vehicle, in camera images too. "seam ratio nearby" compares with the NEAR
    steps on either side of the seam. NaN for images of one colour.
    """

    def __init__(self) -> None:
        super().__init__("seam", "other", "near")

    def update(self, panorama: Array, name: str) -> None:
        """Count the frame `name`: (H, W, 3) uint8, W >= 2; ValueError for anything else."""
        colours = image_tensor(panorama, "a panorama").double()
        if colours.shape[2] < 2:
            raise ValueError("a panorama of one column has no seam")
        seam, *steps = (colours.roll(-1, 2) - colours).abs().mean((0, 1)).roll(1).tolist()
        near = [*steps[:NEAR], *steps[max(len(steps) - NEAR, NEAR) :]]
        self._keep(name, seam, float(np.mean(steps)), float(np.mean(near)))

    def values_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """Return the seam over all other steps, and over the steps near it."""
        return {"seam ratio": sums[..., 0] / sums[..., 1], "seam ratio nearby": sums[..., 0] / sums[..., 2]}


class RollError(MeanMetric):
    """Difference between f(rotated x) and rotated f(x): zero for a network with the same output in all directions.

    Of quantities (colours, depth, logits) the mean |difference| in their own unit; of class ids the share of different
    pixels.
    """

    title = "roll error"

    def __init__(self, *, ids: bool = False) -> None:
        """ids: the outputs are class ids."""
        self.ids = ids
        super().__init__()

    def update(self, output: Array, rotated_output: Array, columns: int, name: str) -> None:
        """Count the frame `name`.

        output, rotated_output  f(x) and f(x.roll(columns)), of one shape (..., W): columns are the last axis.
        Raises ValueError when the shapes differ, and for NaN or infinite values.
        """
        straight, rotated = as_tensor(output).double(), as_tensor(rotated_output).double()
        if straight.shape != rotated.shape:
            raise ValueError(f"output {tuple(straight.shape)} and rotated {tuple(rotated.shape)} differ in shape")
        off = rotated - straight.roll(columns, -1)
        self._keep(name, float((off != 0).sum() if self.ids else off.abs().sum()), off.numel())


class WarpingError(MeanMetric):
    """Mean squared difference (R, G, B in [0, 1]) between an image and the warped previous one.

    Lai et al. 2018 (arXiv:1808.00449), section 4.2: sum of M |V_t - warped V_(t-1)|^2 / sum of M, M: visible in both;
    here over all pixels of all frames. Camera images have an error of their own (reflections, exposure, resampling):
    compare with it.
    """

    title = "warping error"

    def __init__(self, *, circular: bool = False) -> None:
        """circular: the images' last column is next to their first."""
        self.circular = circular
        super().__init__()

    def update(self, previous: Array, current: Array, flow: Array, name: str, *, valid: Array | None = None) -> None:
        """Count the frame `name`.

        previous, current  (H, W, 3) uint8: the images at t - 1 and t.
        flow               (2, H, W) float, pixels: the content of (column, row) of `current` was at
                           (column + flow[0], row + flow[1]) of `previous`.
        valid              (H, W) bool: pixels of known flow.
        Pixels from outside of the previous image do not count. Raises ValueError for other shapes or types,
        and for NaN or infinite flow of valid pixels.
        """
        image, previous_image = image_pair(current, previous)
        shape = image.shape[1:]
        shift = as_tensor(flow)
        if shift.shape != (2, *shape) or not shift.is_floating_point():
            raise ValueError(f"flow must be {(2, *shape)} float, not {tuple(shift.shape)} {shift.dtype}")
        scored = mask_tensor(valid, shape, "valid")
        if scored is None:
            scored = torch.ones(shape, dtype=torch.bool)
        if not shift[:, scored].isfinite().all():
            raise ValueError("the flow has values that are NaN or infinite where it is valid")
        lookup = self._lookup(torch.where(scored, shift.double(), 0.0), scored)
        off = (lookup.linear(previous_image.double()) - image.double())[:, lookup.valid] / 255
        self._keep(name, float(off.square().sum()), float(lookup.valid.sum()))

    def _lookup(self, flow: Tensor, scored: Tensor) -> Lookup:
        rows, columns = scored.shape
        row = torch.arange(rows, dtype=torch.float64)[:, None] + 0.5 + flow[1]
        column = torch.arange(columns, dtype=torch.float64) + 0.5 + flow[0]
        inside = scored & (row >= 0) & (row < rows)
        if not self.circular:
            inside &= (column >= 0) & (column < columns)
        return Lookup(row=row, column=column, valid=inside, circular=self.circular)
