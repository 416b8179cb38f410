"""Losses of video painters; each a scalar, a mean over the batch, without any weight.

Wang et al. 2018, Video-to-Video Synthesis (arXiv:1808.06601), section 3, and the code published with it
(https://github.com/NVIDIA/vid2vid, vid2vid_model_D.py), which decides points open in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from lidar2pano.geometry.rasters import warp
from lidar2pano.losses.adversarial import feature_matching

# Published weights of the five layers of VGG-19 (Wang et al. 2018, arXiv:1711.11585: pix2pixHD's code).
LAYERS = (1 / 32, 1 / 16, 1 / 8, 1 / 4, 1.0)

Outputs = Sequence[Sequence[Tensor]]
"""A discriminator's output: per scale, the features of every layer, the scores last."""


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
    pairs = zip(real, fake, strict=True)
    return torch.stack([4 * feature_matching(r[:-1], f[:-1]) / len(f[:-1]) for r, f in pairs]).mean()


def masked_l1(a: Tensor, b: Tensor, mask: Tensor) -> Tensor:
    """Mean of mask * |a - b| over all pixels, those outside the mask included, as published.

    a, b  (B, C, H, W);  mask (B, H, W) in [0, 1].
    """
    return ((a - b).abs() * mask[:, None]).mean()


def flow_loss(flow: Tensor, reference: Tensor, mask: Tensor) -> Tensor:
    """Distance of a flow (B, 2, H, W) from the reference, pixels: equation 8 of the paper, first part."""
    return masked_l1(flow, reference, mask)


def warping_loss(flow: Tensor, previous: Tensor, present: Tensor, mask: Tensor, *, circular: bool = False) -> Tensor:
    """Distance of the real image (B, 3, H, W) from the previous one, warped by a flow: equation 8, second part."""
    return masked_l1(warp(previous, flow, circular=circular), present, mask)


def coherence_loss(
    present: Tensor, previous: Tensor, reference: Tensor, mask: Tensor, *, circular: bool = False
) -> Tensor:
    """Distance of a painted image (B, 3, H, W) from the previous painted one, warped by the reference flow.

    In the published code only (G_Warp); no gradient goes into the image before.
    """
    return masked_l1(present, warp(previous, reference, circular=circular).detach(), mask)


def mask_loss(weight: Tensor, mask: Tensor) -> Tensor:
    """Mean of the share (B, 1, H, W) of new pixels inside the mask of known flow, whose warped image should be kept.

    In the published code only (loss W, with --no_first_img).
    """
    return masked_l1(weight, torch.zeros_like(weight), mask)


def perceptual(fake: Sequence[Tensor], real: Sequence[Tensor]) -> Tensor:
    """Distance of VGG-19's five layers, weighted as published; no gradient goes through the real side.

    Johnson et al. 2016 (arXiv:1603.08155), equation 2, with absolute distances.
    """
    parts = [w * F.l1_loss(f, r.detach()) for w, f, r in zip(LAYERS, fake, real, strict=True)]
    return torch.stack(parts).sum()
