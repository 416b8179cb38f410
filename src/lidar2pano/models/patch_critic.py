"""Patch critics at several scales, with the features that feature matching compares.

Isola et al. 2017 (PatchGAN) and Wang et al. 2018 (pix2pixHD, section 3.2: critics on an image pyramid).
"""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn.functional import avg_pool2d
from torch.nn.utils.parametrizations import spectral_norm


class PatchCritic(nn.Module):
    """Scores of patches: is this image real, given its condition?

    channels  of image and condition together.
    width     channels of the first layer; each layer doubles them, up to eight times.
    scales    images of the pyramid, each half the size of the one before.
    """

    def __init__(self, channels: int = 22, width: int = 48, layers: int = 3, scales: int = 2) -> None:
        super().__init__()
        critics = [_patches(channels, width, layers) for _ in range(scales)]
        self.scales: list[nn.ModuleList] = nn.ModuleList(critics)  # pyright: ignore[reportAttributeAccessIssue] no generic

    def forward(self, image: Tensor) -> list[list[Tensor]]:
        """(B, channels, H, W) -> per scale, the features of every layer, the last being the scores (B, 1, h, w)."""
        answers = []
        for critic in self.scales:
            features, x = [], image
            for layer in critic:
                x = layer(x)
                features.append(x)
            answers.append(features)
            image = avg_pool2d(image, 2)
        return answers


def _patches(channels: int, width: int, layers: int) -> nn.ModuleList:
    blocks, inputs = [], channels
    for depth in range(layers):
        outputs = width * min(2**depth, 8)
        conv = spectral_norm(nn.Conv2d(inputs, outputs, 4, stride=2, padding=1))
        blocks.append(nn.Sequential(conv, nn.LeakyReLU(0.2)))
        inputs = outputs
    blocks.append(nn.Sequential(spectral_norm(nn.Conv2d(inputs, 2 * inputs, 3, padding=1)), nn.LeakyReLU(0.2)))
    blocks.append(nn.Sequential(spectral_norm(nn.Conv2d(2 * inputs, 1, 3, padding=1))))
    return nn.ModuleList(blocks)
