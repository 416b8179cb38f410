"""Outlines of what a translator predicts softly: kerbs without dents, crowns and roofs sharp against the sky.

Where a translator does not know on which pixel a thing ends, its probabilities change slowly. Painted as they are, they
become dents along a kerb, and a grey halo between a tree and the sky.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from lidar2pano.geometry.solid_noise import solid_noise
from lidar2pano.views import View

KERB_DEG, KERB_ROWS = 1.6, 1.5  # deviations of the Gaussian over which borders on the ground are evened
EDGE_PX = 0.4  # scale of the logistic function across an outline
REACH = 3  # pixels to each side over which the slope of the sky's probability is taken
LEAST_SLOPE = 0.002  # of it, per pixel
CROWN_DEG, CROWN_ROWS = 0.5, 2.0  # deviations of the Gaussian over which the outlines of crowns are evened
LEAFLESS, THINNING = 0.3, 0.15  # distance of the sky's probability from 0.5 where leaves end, and over which they do
BOUGH_DEG, BOUGH_ROWS = 2.0, 8.0  # and how far away their leaves are: at a step in depth noise would be drawn out
LEAVES_M = {0.5: 0.12, 2.0: 0.3}  # wavelengths, and how far leaves and boughs move the outline of a crown
CROWN = 17  # pixels around in which the nearest thing is what stands before the sky
LEAST = 1e-6  # probability


def evened(logits: Tensor, classes: Sequence[int]) -> Tensor:
    """Logarithms of probabilities (B, C, H, W) float32; some classes give way to each other along smooth borders.

    logits   (B, C, H, W), of a whole turn.
    classes  ids of those that lie on the ground. What they have together is kept in every pixel; how it is shared
             among them is a mean over a Gaussian, in which a pixel counts by how probably it is ground.
    """
    logits = logits.contiguous().log_softmax(1, dtype=torch.float32)  # of planes, 3 times as fast as channels last
    ground = torch.stack([logits[:, each] for each in classes], 1).exp_()
    around = _blurred(ground, KERB_DEG / 360 * logits.shape[3], KERB_ROWS).clamp_(min=LEAST**2)
    together = ground.sum(1, keepdim=True).clamp_(min=LEAST**5)
    shares = around.mul_(together / around.sum(1, keepdim=True)).log_()
    for share, each in zip(shares.unbind(1), classes, strict=True):
        logits[:, each] = share
    return logits


def against_the_sky(  # noqa: PLR0913, PLR0917 which class is what is the caller's to know
    segments: Tensor,
    probabilities: Tensor,
    depth_m: Tensor,
    view: View,
    T_world_sensor: np.ndarray | None,
    sky: int,
    vegetation: int,
) -> Tensor:
    """Segments (B, C, H, W) in which a sharp outline parts the sky from the rest, one with leaves where trees grow.

    segments       (B, C, H, W): probabilities, whose ratios among all other classes stay as they are.
    probabilities  (B, C, H, W): those that say where the sky is;  depth_m: (B, H, W) metres.
    The leaves are solid noise in the world (T_world_sensor as for `solid_noise`), at the distance of the nearest thing.
    """
    share = probabilities[:, sky].float()
    nearest = _blurred(_nearest(depth_m.float())[:, None], BOUGH_DEG / 360 * view.columns, BOUGH_ROWS)[:, 0]
    nowhere = torch.zeros_like(nearest[0], dtype=torch.bool)
    noise = torch.stack([solid_noise(one, nowhere, view, tuple(LEAVES_M), T_world_sensor) for one in nearest])
    leaves_m = torch.einsum("bkhw,k->bhw", noise.clamp_(-2, 2), noise.new_tensor(list(LEAVES_M.values())))
    trees = probabilities[:, vegetation] / (1 - share).clamp(min=LEAST)
    even = _blurred(share[:, None], CROWN_DEG / 360 * view.columns, CROWN_ROWS)[:, 0]
    above = torch.lerp(share, even, trees) - 0.5
    leafy = ((LEAFLESS - above.abs()) / THINNING).clamp_(0, 1)  # nearby, a metre is wider than what is unknown
    leaves_px = leaves_m * view.focal_px / nearest * trees * leafy
    open_sky = torch.sigmoid((_pixels_inside(above) - leaves_px) / EDGE_PX)
    rest = (1 - open_sky) / (1 - segments[:, sky]).clamp(min=LEAST)
    outlined = segments * rest[:, None]
    outlined[:, sky] = open_sky
    return outlined


def _pixels_inside(x: Tensor) -> Tensor:
    """About how many pixels each is on the positive side of where (B, H, W) is zero; columns are circular."""
    rows = torch.cat([x[:, :1].expand(-1, REACH, -1), x, x[:, -1:].expand(-1, REACH, -1)], 1)
    down = rows[:, 2 * REACH :] - rows[:, : -2 * REACH]
    across = x.roll(-REACH, 2) - x.roll(REACH, 2)
    return x / (torch.hypot(down, across) / (2 * REACH)).clamp(min=LEAST_SLOPE)


def _nearest(depth_m: Tensor) -> Tensor:
    """The least of (B, H, W) within CROWN pixels around each; columns are circular. A tenth of max_pool2d's time."""
    rows, reach = depth_m.shape[1], CROWN // 2
    around = pad(depth_m, (0, 0, reach, reach), value=torch.inf)
    for step in _doubling(CROWN):
        around = torch.minimum(around[:, :-step], around[:, step:])
    around = around[:, :rows].roll(reach, 2)
    for step in _doubling(CROWN):
        around = torch.minimum(around, around.roll(-step, 2))
    return around


def _doubling(length: int) -> list[int]:
    """Shifts that one after the other join so many neighbours: each at most as far as what is joined already."""
    steps, joined = [], 1
    while joined < length:
        steps.append(min(joined, length - joined))
        joined += steps[-1]
    return steps


def _blurred(x: Tensor, columns: float, rows: float) -> Tensor:
    """(B, C, H, W) under a Gaussian with these deviations; columns are circular, the first and last row go on."""
    across, down = _gaussian(columns, x), _gaussian(rows, x)
    reach = len(across) // 2
    wave = torch.cat([across[reach:], across.new_zeros(x.shape[3] - len(across)), across[:reach]])
    x = torch.fft.irfft(torch.fft.rfft(x) * torch.fft.rfft(wave).real, n=x.shape[3])  # a tenth of a convolution's time
    reach, height = len(down) // 2, x.shape[2]
    around = pad(x, (0, 0, reach, reach), mode="replicate")
    blurred = torch.zeros_like(x)
    for row, weight in enumerate(down.tolist()):
        blurred.add_(around[:, :, row : row + height], alpha=weight)
    return blurred


def _gaussian(deviation: float, like: Tensor) -> Tensor:
    place = torch.arange(-math.ceil(3 * deviation), math.ceil(3 * deviation) + 1).to(like)
    weight = torch.exp(-place.square() / (2 * deviation**2))
    return weight / weight.sum()
