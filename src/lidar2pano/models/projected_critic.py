"""Projected discriminator: small heads on frozen features, mixed at random (Sauer et al. 2021, arXiv:2111.01007)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, interpolate
from torch.nn.utils.parametrizations import spectral_norm

DOWN = (2, 1, 1, 0)  # strided layers of each head, so that all judge patches of a similar size


class ProjectedCritic(nn.Module):
    """Scores of patches at four depths of frozen features, conditioned on what the picture was painted from.

    features    channels of the frozen features, fine to coarse.
    conditions  channels that the heads see beside them.
    mixed       channels that the features are mixed to: across channels by random 1x1 convolutions, and across scales
                by random 3x3 ones from coarse to fine (section 3.2). These never train.
    width       channels of the heads.
    """

    def __init__(
        self, features: Sequence[int] = (24, 40, 112, 320), conditions: int = 17, mixed: int = 64, width: int = 64
    ) -> None:
        super().__init__()
        self.across = nn.ModuleList([nn.Conv2d(channels, mixed, 1, bias=False) for channels in features])
        self.scales = nn.ModuleList([nn.Conv2d(mixed, mixed, 3, 1, 1, bias=False) for _ in features])
        for layer in (*self.across, *self.scales):
            nn.init.kaiming_normal_(cast(Tensor, layer.weight), nonlinearity="linear")
            layer.requires_grad_(False)
        self.heads = nn.ModuleList([_head(mixed + conditions, width, down) for down in DOWN])

    def forward(self, condition: Tensor, *features: Tensor) -> list[Tensor]:
        """Scores (B, 1, h, w) per depth, from coarse to fine.

        condition  (B, conditions, H, W) on any raster;  features: as ImagenetFeatures gives them.
        """
        resized: list[Tensor] = []
        for feature in features:  # each from the one before it, not from the whole image
            condition = adaptive_avg_pool2d(condition, (feature.shape[2], feature.shape[3]))
            resized.append(condition)
        scores: list[Tensor] = []
        coarser: Tensor | None = None
        for number in reversed(range(len(features))):
            x = features[number]
            if not torch.is_autocast_enabled(x.device.type):
                x = x.to(cast(Tensor, self.across[number].weight).dtype)  # features may be half
            x = x / (x.detach().std((1, 2, 3), keepdim=True) + 1e-3)  # depths differ in scale; conditions are 0 to 1
            x = self.across[number](x)
            if coarser is not None:
                x = (x + interpolate(coarser, size=x.shape[-2:], mode="bilinear", align_corners=False)) * 0.5**0.5
            x = coarser = self.scales[number](x)
            scores.append(self.heads[number](torch.cat([x, resized[number].to(x.dtype)], 1)))
        return scores


def _head(inputs: int, width: int, down: int) -> nn.Sequential:
    layers: list[nn.Module] = [spectral_norm(nn.Conv2d(inputs, width, 1)), nn.LeakyReLU(0.2)]
    for _ in range(down):
        layers += [spectral_norm(nn.Conv2d(width, width, 4, 2, 1)), nn.LeakyReLU(0.2)]
    layers += [spectral_norm(nn.Conv2d(width, width, 3, 1, 1)), nn.LeakyReLU(0.2)]
    return nn.Sequential(*layers, spectral_norm(nn.Conv2d(width, 1, 3, 1, 1)))
