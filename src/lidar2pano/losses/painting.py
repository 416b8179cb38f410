"""Losses of painted pictures and videos: pooled colours, statistics of patches, features and flow.

Patches  The Frechet distance as a loss. Between normal distributions the cheapest transport moves x to m2 + T (x - m1),
         where T = C1^-1/2 (C1^1/2 C2 C1^1/2)^1/2 C1^-1/2 (Dowson and Landau 1982; Olkin and Pukelsheim 1982), and its
         mean cost is the Frechet distance. Each painted patch is drawn to the transport's goal.
         Mathiasen and Hvilshoj (2020) differentiate the distance itself; with statistics over many batches
         (here moving averages) small batches will do.
Videos   Wang et al. 2018, Video-to-Video Synthesis (arXiv:1808.06601), section 3, and the code published with it
         (https://github.com/NVIDIA/vid2vid, vid2vid_model_D.py), which decides points open in the paper. Each loss is
         a scalar, a mean over the batch, without any weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d

PATCH, STRIDE = 8, 4  # of a patch, in pixels of the features' raster
KEPT = 0.99  # of the statistics, from one batch to the next
RIDGE = 1e-2  # of the mean variance, added to every painted one
MOST_STRETCH = 3.0  # largest factor of a deviation
EVERY, FIRST = 10, 40  # steps between two transports; step of the first
POOL = 4  # pixels
# Published weights of the five layers of VGG-19 (Wang et al. 2018, arXiv:1711.11585: pix2pixHD's code).
LAYERS = (1 / 32, 1 / 16, 1 / 8, 1 / 4, 1.0)

Outputs = Sequence[Sequence[Tensor]]
"""A discriminator's output: per scale, the features of every layer, the scores last."""


def pooled(image: Tensor) -> Tensor:
    """Means over squares of POOL x POOL pixels of (B, C, H, W) or (C, H, W): colours without their fine texture."""
    return avg_pool2d(image, POOL)


class Patches(NamedTuple):
    """Features (B, C, h, w) per depth of pictures, the pixels that count, (B, 1, H, W) 1, and groups of the pixels.

    groups  (B, G, H', W'): shares of the groups in a pixel, on any raster of the same picture.
    """

    features: Sequence[Tensor]
    counted: Tensor
    groups: Tensor

    def of_depth(self, depth: int) -> tuple[Tensor, Tensor]:
        """Return patches (P, C) all of whose pixels count, and the number (P,) of the largest group in each."""
        features = self.features[depth]
        size = (features.shape[2], features.shape[3])
        counted, groups = (adaptive_avg_pool2d(part, size) for part in (self.counted, self.groups))
        features, counted, groups = (
            avg_pool2d(part, PATCH, STRIDE).movedim(1, 3) for part in (features, counted, groups)
        )
        whole = counted[..., 0] > 0.999
        return features[whole], groups[whole].argmax(1)


class PatchStatistics(nn.Module):
    """The loss; it remembers means and second moments of the features of patches, of each group at each depth.

    A group is compared with itself alone: walls with walls, crowns with crowns, so that pictures of other scenes teach.
    widths  channels of the features of each depth;  groups: their number.
    """

    def __init__(self, widths: Sequence[int], groups: int) -> None:
        super().__init__()
        self.depths = nn.ModuleList(
            [nn.ModuleList([DistributionLoss(width) for _ in range(groups)]) for width in widths]
        )

    def forward(self, real: Patches, painted: Patches) -> Tensor:
        """Return the mean squared distance of painted patches from their goals, over the variance of the group's.

        real, painted  neither as many nor of the same scenes. 0 without painted ones, and until a group is known.
        """
        total, count = painted.counted.new_zeros(()), 0
        for depth, losses in enumerate(self.depths):
            if min(painted.features[depth].shape[-2:]) < PATCH:
                continue
            (real_patches, real_groups), (patches, groups) = real.of_depth(depth), painted.of_depth(depth)
            for group in torch.cat([real_groups, groups]).unique().tolist():
                chosen = patches[groups == group]
                loss = cast(nn.ModuleList, losses)[group](real_patches[real_groups == group], chosen)
                total = total + loss * len(chosen)
                count += len(chosen)
        return total / max(count, 1)


class Distribution(nn.Module):
    """Mean (D,) and covariance (D, D) of recent patches."""

    def __init__(self, size: int) -> None:
        super().__init__()
        for name, shape in (("weight", ()), ("first", (size,)), ("second", (size, size))):
            self.register_buffer(name, torch.zeros(shape, dtype=torch.float64))

    def update(self, x: Tensor) -> None:
        """Count patches (P, D)."""
        x = x.detach().double()
        self.weight = KEPT * self.weight + len(x)
        share = len(x) / float(self.weight)
        self.first = torch.lerp(self.first.to(x), x.mean(0), share)
        self.second = torch.lerp(self.second.to(x), x.T @ x / len(x), share)

    @property
    def covariance(self) -> Tensor:
        """(D, D) float64."""
        return self.second - torch.outer(self.first, self.first)


class DistributionLoss(nn.Module):
    """The loss of one group of patches at one depth; real and painted ones need neither be as many nor correspond.

    size  D of the features.
    """

    def __init__(self, size: int) -> None:
        super().__init__()
        self.real, self.painted = Distribution(size), Distribution(size)
        self.register_buffer("step", torch.tensor(0))
        self.register_buffer("transport", torch.eye(size))

    def forward(self, real: Tensor, painted: Tensor) -> Tensor:
        """Mean squared distance of painted patches (P, D) from their goals, over the variance of real ones.

        real      (R, D), R may be 0 after earlier ones.
        Returns 0 without painted ones, and until the statistics are known.
        """
        if len(real):
            self.real.update(real)
        if not len(painted):
            return painted.new_zeros(())
        self.painted.update(painted)
        self.step += bool(self.real.weight)
        if self.step < FIRST:
            return painted.new_zeros(())
        if self.step % EVERY == FIRST % EVERY:
            self.transport = transport(self.painted.covariance, self.real.covariance).to(painted)
        mean = self.painted.first.to(painted)
        goal = self.real.first.to(painted) + (painted.detach() - mean) @ self.transport.to(painted)
        variance = self.real.covariance.trace().to(painted)
        return (painted - goal).square().sum(1).mean() / variance.clamp(min=1e-6)


def transport(source: Tensor, target: Tensor) -> Tensor:
    """Return the matrix T (D, D) from a normal distribution of covariance `source` to one of covariance `target`.

    Variances of `source` have at least RIDGE of their mean, and deviations grow MOST_STRETCH times at most.
    """
    values, vectors = torch.linalg.eigh(source)
    values = values.clamp(min=0) + RIDGE * values.mean().clamp(min=1e-12)
    root, inverse = ((vectors * scale) @ vectors.T for scale in (values.sqrt(), values.rsqrt()))
    middle, axes = torch.linalg.eigh(root @ target @ root)
    linear = inverse @ ((axes * middle.clamp(min=0).sqrt()) @ axes.T) @ inverse
    scales, directions = torch.linalg.eigh((linear + linear.T) / 2)
    return (directions * scales.clamp(0, MOST_STRETCH)) @ directions.T


def least_squares_critic(real: Outputs, fake: Outputs) -> Tensor:
    """Sum over scales of (E[(D(real) - 1)^2] + E[D(fake)^2]) / 2: Mao et al. 2017 (arXiv:1611.04076), equation 9."""
    pairs = zip(real, fake, strict=True)
    return torch.stack([(r[-1] - 1).square().mean() + f[-1].square().mean() for r, f in pairs]).sum() / 2


def least_squares_generator(fake: Outputs) -> Tensor:
    """Sum over scales of E[(D(fake) - 1)^2]: Mao et al. 2017, equation 9, twice, as published."""
    return torch.stack([(f[-1] - 1).square().mean() for f in fake]).sum()


def matched_features(real: Outputs, fake: Outputs) -> Tensor:
    """Feature matching of all scales: their mean, of 4 times the mean over layers, as published.

    Wang et al. 2018 (arXiv:1711.11585), equation 4; no gradient goes through the real side.
    """
    losses = []
    for r, f in zip(real, fake, strict=True):
        gaps = [F.l1_loss(layer, goal.detach()) for goal, layer in zip(r[:-1], f[:-1], strict=True)]
        losses.append(4 * torch.stack(gaps).sum() / len(gaps))
    return torch.stack(losses).mean()


def masked_l1(a: Tensor, b: Tensor, mask: Tensor) -> Tensor:
    """Mean of mask * |a - b| over all pixels, those outside the mask included, as published.

    a, b  (B, C, H, W);  mask (B, H, W) in [0, 1].
    """
    return ((a - b).abs() * mask[:, None]).mean()


def perceptual(fake: Sequence[Tensor], real: Sequence[Tensor]) -> Tensor:
    """Distance of VGG-19's five layers, weighted as published; no gradient goes through the real side.

    Johnson et al. 2016 (arXiv:1603.08155), equation 2, with absolute distances.
    """
    parts = [w * F.l1_loss(f, r.detach()) for w, f, r in zip(LAYERS, fake, real, strict=True)]
    return torch.stack(parts).sum()
