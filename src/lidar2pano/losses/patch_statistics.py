"""How far painted patches are from the distribution of real ones: the Frechet distance as a loss.

Between normal distributions the cheapest transport moves x to m2 + T (x - m1), where T = C1^-1/2 (C1^1/2 C2 C1^1/2)^1/2
C1^-1/2 (Dowson and Landau 1982; Olkin and Pukelsheim 1982), and what it costs on average is the Frechet distance. Each
painted patch is drawn to where the transport would put it. Mathiasen and Hvilshoj (2020) differentiate the distance
itself; with statistics that are remembered over many batches (here by moving averages) small batches will do.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d

PATCH, STRIDE = 8, 4  # of a patch, in pixels of the features' raster
KEPT = 0.99  # of the statistics, from one batch to the next
RIDGE = 1e-2  # of the mean variance, added to every painted one
MOST = 3.0  # times that a deviation is made larger
EVERY, FIRST = 10, 40  # steps between two transports; step of the first


class PatchStatistics:
    """The loss; it remembers means and second moments of the features of patches, of each look.

    looks     their number;  channels: of the features at each depth.
    """

    def __init__(self, looks: int, channels: Sequence[int]) -> None:
        self.looks = [[DistributionLoss(size) for size in channels] for _ in range(looks)]

    def __call__(self, pairs: Sequence[tuple[Tensor, Tensor]], valid: Tensor, looks: Tensor) -> Tensor:
        """Mean squared distance of the painted patches from where they should be, over the real ones' variance.

        pairs  real and painted features (B, C, h, w) per depth;  valid: (B, 1, H, W) 1 where the real picture is known.
        looks  (B,) int64. Patches count that are known as a whole. 0 without any, and until the statistics are known.
        """
        total, count = valid.new_zeros(()), 0
        for depth, (real, painted) in enumerate(pairs):
            if min(real.shape[-2:]) < PATCH:
                continue
            known = adaptive_avg_pool2d(valid, (real.shape[2], real.shape[3]))
            whole = avg_pool2d(known, PATCH, STRIDE)[:, 0] > 0.999
            real_patches, painted_patches = (avg_pool2d(part, PATCH, STRIDE).movedim(1, 3) for part in (real, painted))
            for look in looks.unique().tolist():
                chosen = whole & (looks == look)[:, None, None]
                if chosen.sum() >= 2:
                    total = total + self.looks[look][depth](real_patches[chosen], painted_patches[chosen])
                    count += 1
        return total / max(count, 1)


class Distribution:
    """Mean (D,) and covariance (D, D) of what came lately."""

    def __init__(self, size: int) -> None:
        self.weight, self.first, self.second = 0.0, torch.zeros(size), torch.zeros(size, size)

    def update(self, x: Tensor) -> None:
        """Count patches (P, D)."""
        x = x.detach().double()
        self.weight = KEPT * self.weight + len(x)
        share = len(x) / self.weight
        self.first = torch.lerp(self.first.to(x), x.mean(0), share)
        self.second = torch.lerp(self.second.to(x), x.T @ x / len(x), share)

    @property
    def covariance(self) -> Tensor:
        """(D, D) float64."""
        return self.second - torch.outer(self.first, self.first)


class DistributionLoss:
    """The loss of one group of patches at one depth; real and painted ones need neither be as many nor correspond.

    size  D of the features.
    """

    def __init__(self, size: int) -> None:
        self.real, self.painted, self.step = Distribution(size), Distribution(size), 0
        self.transport = torch.eye(size)

    def __call__(self, real: Tensor, painted: Tensor, variance: Tensor | None = None) -> Tensor:
        """Mean squared distance of painted patches (P, D) from where they should be, over the variance of real ones.

        real      (R, D), R may be 0 where some came before.
        variance  in place of the real ones' own, which may hardly vary.
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
        goal = self.real.first.to(painted) + (painted.detach() - mean) @ self.transport
        variance = self.real.covariance.trace() if variance is None else variance
        return (painted - goal).square().sum(1).mean() / variance.to(painted).clamp(min=1e-6)


def transport(one: Tensor, other: Tensor) -> Tensor:
    """The matrix T (D, D) that carries a normal distribution of covariance `one` to one of covariance `other`.

    Variances of `one` have at least RIDGE of their mean, and no deviation is made more than MOST times as large.
    """
    values, vectors = torch.linalg.eigh(one)
    values = values.clamp(min=0) + RIDGE * values.mean().clamp(min=1e-12)
    root, inverse = ((vectors * scale) @ vectors.T for scale in (values.sqrt(), values.rsqrt()))
    between, axes = torch.linalg.eigh(root @ other @ root)
    linear = inverse @ ((axes * between.clamp(min=0).sqrt()) @ axes.T) @ inverse
    scales, directions = torch.linalg.eigh((linear + linear.T) / 2)
    return (directions * scales.clamp(0, MOST)) @ directions.T
