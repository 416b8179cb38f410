"""Colours of an invention brought to those of cameras: a gain of each class, shrunk towards one for all.

The gain of a class takes the mean light of its painted pixels, where cameras see, to that of the cameras there, red,
green and blue by themselves (the adaptation of von Kries 1902). Maps with more freedom (means and deviations, Reinhard
et al. 2001; covariances, Pitie and Kokaram 2007) come no nearer to hidden cameras, and blow up what is painted wherever
a class is seen in the wrong place.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lidar2pano.metrics.colour_difference import linear_light

EVERY_PX = 4  # one of so many rows and columns is a sample
CELL_PX = 16  # on a side of the cells whose means are taken to be independent
LEVELS = 1 << 12  # of linear light, in the table back to codes
DARKEST = 1 / (255 * 12.92)  # light of the code 1
LIGHT = torch.from_numpy(linear_light(np.arange(256))).float()
_LEVEL = torch.arange(LEVELS + 1) / LEVELS
CODES = 255 * torch.where(_LEVEL <= 0.0031308, _LEVEL * 12.92, 1.055 * _LEVEL ** (1 / 2.4) - 0.055)


def light_gains(colour: Tensor, classes: Tensor, real: Tensor, source: Tensor) -> dict[int, np.ndarray]:
    """Return the gains (3,) of the classes in sight of cameras, and of all as -1; none where they see nothing.

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
    return class_gains(painted, target, classes[sample, sample][visible].numpy(), cells)


def brightened(gains: dict[int, np.ndarray], colour: Tensor, classes: Tensor) -> Tensor:
    """Return colours (n, 3) float32 codes in 0 .. 255 of pixels (n, 3) uint8 by the gains of their classes (n,)."""
    codes = colour.float()
    for index in classes.unique().tolist() if gains else ():
        chosen = (classes == index).nonzero()[:, 0]
        light = LIGHT[colour[chosen].int()] * torch.from_numpy(gains.get(index, gains[-1])).float()
        codes[chosen] = CODES[(light.clamp_(0, 1) * LEVELS).int()]
    return codes


def class_gains(
    painted: np.ndarray, target: np.ndarray, classes: np.ndarray, cells: np.ndarray
) -> dict[int, np.ndarray]:
    """Return the gain (3,) of each class among pixels, and of all as -1.

    painted, target  (n, 3) light of the pixels;  classes, cells: (n,) their class, and number of the cell.
    The mean of a class is shrunk towards that by the gain of all by the share of its error in its deviation (empirical
    Bayes): the error is the variance of its cells' means over their number, the deviation that of classes.
    """
    whole = target.mean(0) / painted.mean(0).clip(DARKEST)
    off = target - whole * painted
    masks = {int(index): classes == index for index in np.unique(classes)}
    means = {index: off[mask].mean(0) for index, mask in masks.items()}
    cell_variance = {index: _cell_variance(off[mask], cells[mask]) for index, mask in masks.items()}
    pooled = float(np.nanmean([0.0, *(variance for variance, _ in cell_variance.values())]))
    errors = {index: np.nan_to_num(variance, nan=pooled) / count for index, (variance, count) in cell_variance.items()}
    class_variance = max(float(np.mean([means[index] @ means[index] - errors[index] for index in masks])), 0.0)
    gains = {-1: whole}
    for index, mask in masks.items():
        share = class_variance / (class_variance + errors[index]) if errors[index] > 0 else 1.0
        first = painted[mask].mean(0).clip(DARKEST)
        gains[index] = ((whole * first + share * means[index]) / first).clip(0)
    return gains


def _cell_variance(off: np.ndarray, cells: np.ndarray) -> tuple[float, int]:
    """Return the variance of the means of cells, all channels together, NaN of one; and the number of cells."""
    _, number, count = np.unique(cells, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(number, channel) for channel in off.T], axis=1) / count[:, None]
    return (float(means.var(0, ddof=1).sum()) if len(count) > 1 else np.nan), len(count)
