"""Colours of an invention brought to those of cameras: closed-form maps of each class, shrunk towards one for all.

The map of a class takes the mean and covariance of its painted pixels, where cameras see, to those of the cameras
there: the Monge-Kantorovich map between normal distributions (Pitie and Kokaram 2007, "The Linear Monge-Kantorovitch
Linear Colour Mapping for Example-Based Colour Transfer", equation 9). Distributions are of linear light.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidar2pano.metrics.colour_difference import linear_light

EVERY_PX = 4  # one of so many rows and columns is a sample
CELL_PX = 16  # on a side of the cells whose means are taken to be independent
LEVELS = 1 << 12  # of linear light, in the table back to codes
QUANTUM = 1 / (12 * 255**2)  # variance of rounding to codes
LIGHT = torch.from_numpy(linear_light(np.arange(256))).float()
_LEVEL = torch.arange(LEVELS + 1) / LEVELS
CODES = 255 * torch.where(_LEVEL <= 0.0031308, _LEVEL * 12.92, 1.055 * _LEVEL ** (1 / 2.4) - 0.055)


class Moments(NamedTuple):
    """Mean (3,) and covariance (3, 3) of light."""

    mean: np.ndarray
    spread: np.ndarray

    @classmethod
    def of(cls, light: np.ndarray) -> Moments:
        """Return the moments of light (n, 3)."""
        mean = light.mean(0)
        return cls(mean, (light - mean).T @ (light - mean) / len(light))

    def towards(self, target: Moments, share: float) -> Moments:
        """Return these moments, with a share of others."""
        return Moments(*(own + share * (far - own) for own, far in zip(self, target, strict=True)))


class LightMap(NamedTuple):
    """light -> A light + b."""

    A: np.ndarray
    b: np.ndarray

    def __call__(self, light: np.ndarray) -> np.ndarray:
        """Map light (n, 3)."""
        return light @ self.A.T + self.b

    def moved(self, moments: Moments) -> Moments:
        """Return the moments of mapped light."""
        return Moments(self.A @ moments.mean + self.b, self.A @ moments.spread @ self.A.T)


def light_maps(colour: Tensor, classes: Tensor, real: Tensor, source: Tensor) -> dict[int, LightMap]:
    """Return the map of each class of an invention that cameras see, and of all as -1; none where they see nothing.

    colour  (H, W, 3) uint8, the invention;  classes: (H, W) uint8.
    real    (3, H, W) float32 codes of cameras;  source: (H, W) uint8, 0 where none sees.
    """
    sample = slice(EVERY_PX // 2, None, EVERY_PX)
    visible = source[sample, sample] > 0
    if not visible.any():
        return {}
    painted = LIGHT[colour[sample, sample][visible].int()].double().numpy()
    target = LIGHT[real[:, sample, sample][:, visible].round().clamp(0, 255).int()].T.double().numpy()
    row, column = (place // (CELL_PX // EVERY_PX) for place in visible.nonzero(as_tuple=True))
    cells = (row * colour.shape[1] + column).numpy()
    return class_maps(painted, target, classes[sample, sample][visible].numpy(), cells)


def mapped(maps: dict[int, LightMap], colour: Tensor, classes: Tensor) -> Tensor:
    """Return colours (n, 3) float32 codes in 0 .. 255 of pixels (n, 3) uint8 by the maps of their classes (n,)."""
    codes = colour.float()
    for index in classes.unique().tolist() if maps else ():
        chosen = (classes == index).nonzero()[:, 0]
        A, b = (torch.from_numpy(part).float() for part in maps.get(index, maps[-1]))
        light = torch.addmm(b, LIGHT[colour[chosen].int()], A.T)
        codes[chosen] = CODES[(light.clamp_(0, 1) * LEVELS).int()]
    return codes


def class_maps(painted: np.ndarray, target: np.ndarray, classes: np.ndarray, cells: np.ndarray) -> dict[int, LightMap]:
    """Return the map of each class among pixels, and of all as -1.

    painted, target  (n, 3) light of the pixels;  classes, cells: (n,) their class, and number of the cell.
    The moments of a class are shrunk towards those under the map of all by the share of its error in its deviation
    (empirical Bayes): the error is the variance of its cells' means over their number, the deviation that of classes.
    """
    whole = monge_kantorovich(Moments.of(painted), Moments.of(target))
    off = target - whole(painted)
    masks = {int(index): classes == index for index in np.unique(classes)}
    means = {index: off[mask].mean(0) for index, mask in masks.items()}
    cell_variance = {index: _cell_variance(off[mask], cells[mask]) for index, mask in masks.items()}
    pooled = float(np.nanmean([0.0, *(variance for variance, _ in cell_variance.values())]))
    errors = {index: np.nan_to_num(variance, nan=pooled) / count for index, (variance, count) in cell_variance.items()}
    class_variance = max(float(np.mean([means[index] @ means[index] - errors[index] for index in masks])), 0.0)
    maps = {-1: whole}
    for index, mask in masks.items():
        first, second = Moments.of(painted[mask]), Moments.of(target[mask])
        share = errors[index] / (class_variance + errors[index]) if errors[index] > 0 else 0.0
        maps[index] = monge_kantorovich(first, second.towards(whole.moved(first), share))
    return maps


def _cell_variance(off: np.ndarray, cells: np.ndarray) -> tuple[float, int]:
    """Return the variance of the means of cells, all channels together, NaN of one; and the number of cells."""
    _, number, count = np.unique(cells, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(number, channel) for channel in off.T], axis=1) / count[:, None]
    return (float(means.var(0, ddof=1).sum()) if len(count) > 1 else np.nan), len(count)


def monge_kantorovich(first: Moments, second: Moments) -> LightMap:
    """Return the map between two normal distributions; none is narrower than the rounding of codes."""
    quantum = QUANTUM * np.eye(3)
    root, inverse = _roots(first.spread + quantum)
    A = inverse @ _roots(root @ (second.spread + quantum) @ root)[0] @ inverse
    return LightMap(A, second.mean - A @ first.mean)


def _roots(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the square root of a symmetric positive matrix, and its inverse."""
    values, vectors = np.linalg.eigh(matrix)
    root = np.sqrt(values.clip(1e-15))
    return (vectors * root) @ vectors.T, (vectors / root) @ vectors.T
