"""Losses: Lovasz-Softmax and the adversarial ones.

Every function takes tensors and returns a scalar tensor in float32 (or the dtype of the scores given), a mean over
the batch, without any weight.
Cross entropy is torch's own: `torch.nn.functional.cross_entropy`.
"""

from __future__ import annotations

from lidar2pano.losses.adversarial import (
    critic_wasserstein,
    feature_matching,
    fringes,
    generator_wasserstein,
    gradient_penalty,
    hinge_critic,
    hinge_generator,
    hue_gap,
    pooled,
)
from lidar2pano.losses.lovasz import lovasz_softmax
from lidar2pano.losses.patch_statistics import PatchStatistics
from lidar2pano.losses.streaks import inside, streaks
from lidar2pano.losses.texture import texture_distance

__all__ = [
    "PatchStatistics",
    "critic_wasserstein",
    "feature_matching",
    "fringes",
    "generator_wasserstein",
    "gradient_penalty",
    "hinge_critic",
    "hinge_generator",
    "hue_gap",
    "inside",
    "lovasz_softmax",
    "pooled",
    "streaks",
    "texture_distance",
]
