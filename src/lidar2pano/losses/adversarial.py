"""Losses of generated images: adversarial ones, feature matching, and pooled colours."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

FRINGE_PX, FRINGE = 9, 0.3
POOL = 4  # pixels
HUE_PX = 16


def gradient_penalty(
    critic: Callable[[Tensor], Tensor], real: Tensor, fake: Tensor, *, epsilon: Tensor | float | None = None
) -> Tensor:
    """E[(|grad D(x)| - 1)^2] with x = epsilon real + (1 - epsilon) fake; the usual weight of 10 is the caller's.

    Gulrajani et al. 2017 (arXiv:1704.00028), equation 3; epsilon is drawn per sample, Algorithm 1 line 4.
    Autocast is off inside: a gradient of a gradient in half precision is mostly rounding.

    critic      image -> scores of any shape (summed: every patch counts); the caller binds its condition.
    real, fake  (B, ...) float; no gradient reaches what made them.
    epsilon     (B,) or a number to use in place of the draw.
    """
    real, fake = real.detach(), fake.detach()
    if epsilon is None:
        epsilon = torch.rand(len(real), device=real.device, dtype=real.dtype)
    if isinstance(epsilon, Tensor):
        epsilon = epsilon.view(-1, *[1] * (real.ndim - 1))
    between = (epsilon * real + (1 - epsilon) * fake).requires_grad_()
    with torch.autocast(real.device.type, enabled=False):
        (slope,) = torch.autograd.grad(critic(between).sum(), between, create_graph=True)
    while slope.ndim > 1:  # norm of norms: float32 sums of a million squares at once were off by 0.06 % on a CPU
        slope = torch.linalg.vector_norm(slope.float(), dim=-1)
    return (slope - 1).square().mean()


def critic_wasserstein(real_scores: Tensor, fake_scores: Tensor) -> Tensor:
    """E[D(fake)] - E[D(real)]: Gulrajani et al. 2017, equation 3 without its penalty."""
    return fake_scores.mean() - real_scores.mean()


def generator_wasserstein(fake_scores: Tensor) -> Tensor:
    """-E[D(fake)]: Gulrajani et al. 2017, Algorithm 1 line 12."""
    return -fake_scores.mean()


def hinge_critic(real_scores: Tensor, fake_scores: Tensor) -> Tensor:
    """E[max(0, 1 - D(real))] + E[max(0, 1 + D(fake))]: Lim and Ye 2017 (arXiv:1705.02894), section 3."""
    return F.relu(1 - real_scores).mean() + F.relu(1 + fake_scores).mean()


def hinge_generator(fake_scores: Tensor) -> Tensor:
    """-E[D(fake)]: Lim and Ye 2017; the same as `generator_wasserstein`."""
    return -fake_scores.mean()


def feature_matching(real_features: Sequence[Tensor], fake_features: Sequence[Tensor]) -> Tensor:
    """E[sum over layers i of |D_i(real) - D_i(fake)|_1 / N_i], N_i the elements of layer i, of one critic.

    Wang et al. 2018 (arXiv:1711.11585), equation 4. The real side is a target: no gradient goes through it.
    Raises ValueError when the two sides differ in layers.
    """
    pairs = zip(real_features, fake_features, strict=True)
    return torch.stack([F.l1_loss(fake, real.detach()) for real, fake in pairs]).sum()


def pooled(image: Tensor) -> Tensor:
    """Means over squares of POOL x POOL pixels of (B, C, H, W) or (C, H, W): colours without their fine texture."""
    return F.avg_pool2d(image, POOL)


def fringes(image: Tensor) -> Tensor:
    """How much more the hue of single pixels (B, 3, H, W) in [-1, 1] differs from that around them than images' does.

    The mean, over pixels, of how far their chroma (blue and red less luma, ITU-R BT.601) is from its mean over a square
    of FRINGE_PX x FRINGE_PX pixels, beyond FRINGE: 99 % of the pixels of KITTI's images are nearer.
    """
    red, green, blue = image.unbind(1)
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    chroma = torch.stack([blue - luma, red - luma], 1)
    around = F.avg_pool2d(chroma, FRINGE_PX, 1, FRINGE_PX // 2, count_include_pad=False)
    return ((chroma - around).square().sum(1).add(1e-9).sqrt() - FRINGE).clamp(min=0).mean()


def hue_gap(image: Tensor, expected: Tensor, share: Tensor, size: int = HUE_PX) -> tuple[Tensor, Tensor]:
    """How far hues are from those expected, over squares of `size` x `size` pixels; the hue is a colour less its mean.

    image, expected  (B, 3, H, W) in [-1, 1];  share: (B, 1, H, W), how much each pixel counts.
    Returns (B, 3, H / size, W / size) and the mean shares (B, 1, H / size, W / size).
    """
    total = F.avg_pool2d(share, size)
    gap = F.avg_pool2d((image - expected) * share, size) / total.clamp(min=1e-3)
    return gap - gap.mean(1, keepdim=True), total
