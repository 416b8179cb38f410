"""TITAN-Net's critic: scores how well an image of class probabilities fits a segmented LiDAR scan, patch by patch.

Paper     Cortinhal, Kurnaz, Aksoy: Semantics-aware Multi-modal Domain Translation: From LiDAR Point Clouds to
          Panoramic Color Images, 2021 (arXiv:2106.13974), section 3.
Upstream  https://github.com/TiagoCortinhal/TITAN-NET, commit 5e00db9 (no licence file; its README says MIT; the
          authors' weights were trained on SemanticKITTI, CC BY-NC-SA 4.0). Written anew here; parameter names are
          the published ones.
Deviates  from the published code in two points:
          the channel counts are settings that count (the published constructor ignores them and says 45);
          the condition is stretched to the image it is given with (the published one to the constant 376 x 1241).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

CONDITION_CHANNELS = 30


def _halve(inputs: int, outputs: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 4, stride=2, padding=1, bias=False)


class TitanCritic(nn.Module):
    """Wasserstein critic without norm layers, so that each sample's gradient can be penalised by itself.

    image      (B, image_channels, h, w) float class probabilities (real ones are one-hot); h, w at least 64.
    condition  (B, conditions, H, W) float one-hot segmentation of the scan.
    out        (B, 1, h', w') scores without bound, h' about h/128: (3, 10) for 376 x 1241.
    width      channels of the first block; each further one of the six has twice as many.
    """

    def __init__(self, image_channels: int = 15, conditions: int = 20, width: int = 64) -> None:
        super().__init__()
        widths = [image_channels + CONDITION_CHANNELS, *(width << block for block in range(6))]
        layers: list[nn.Module] = []
        for inputs, outputs in zip(widths, widths[1:], strict=False):
            layers += [_halve(inputs, outputs), nn.LeakyReLU(0.2, inplace=True)]
        self.model = nn.Sequential(*layers, nn.ZeroPad2d((1, 0, 1, 0)), _halve(widths[-1], 1))
        self.conv1 = nn.Sequential(
            nn.Conv2d(conditions, CONDITION_CHANNELS, 3, padding=1),
            nn.Conv2d(CONDITION_CHANNELS, CONDITION_CHANNELS, 2, padding=1, dilation=2),
            nn.Conv2d(CONDITION_CHANNELS, CONDITION_CHANNELS, 1),
        )

    def forward(self, image: Tensor, condition: Tensor) -> Tensor:
        """(B, image_channels, h, w) and (B, conditions, H, W) -> (B, 1, h', w') scores."""
        condition = functional.interpolate(self.conv1(condition), image.shape[-2:], mode="bilinear", align_corners=True)
        return self.model(torch.cat([image, condition], 1))
