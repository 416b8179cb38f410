"""vid2vid's discriminators: D_I scores an image with its labels, D_V several that follow each other with the flow.

Source: models.vid2vid.
"""

from __future__ import annotations

from torch import Tensor, nn

from lidar2pano.models.vid2vid_layers import halved, start_as_published

WIDEST, FIRST = 512, 64  # channels that no layer exceeds, nor the first one of any scale


class ImageCritic(nn.Module):
    """Scores of patches, and the features that feature matching compares.

    channels  of its input: label maps (published: 35 ids and the edges of instances) and an image.
    width     of the first layer on the whole image; twice that on the halved one and so on, up to 64, as published.
    layers    layers of stride 2.
    scales    images of the pyramid, each half the size of the one before.
    """

    def __init__(self, channels: int = 39, width: int = 64, layers: int = 3, scales: int = 2) -> None:
        super().__init__()
        self.levels = [
            [f"scale{scale}_layer{place}" for place in range(layers + 2)] for scale in reversed(range(scales))
        ]
        for level, names in enumerate(self.levels):
            patches = _patches(channels, min(FIRST, width << level), layers)
            for name, layer in zip(names, patches, strict=True):
                self.add_module(name, layer)
        start_as_published(self)

    def forward(self, image: Tensor) -> list[list[Tensor]]:
        """(B, channels, H, W) -> per scale, the features of every layer, the last being the scores (B, 1, h, w)."""
        answers = []
        for level, names in enumerate(self.levels):
            image = halved(image) if level else image
            features, x = [], image
            for name in names:
                x = self.get_submodule(name)(x)
                features.append(x)
            answers.append(features)
        return answers


class TemporalCritic(ImageCritic):
    """The same for clips; channels: of the images, three each, and of the flows between them, two each."""

    def __init__(self, channels: int = 13, width: int = 64, layers: int = 3, scales: int = 2) -> None:
        super().__init__(channels, width, layers, scales)


def _patches(channels: int, width: int, layers: int) -> list[nn.Sequential]:
    widths = [min(WIDEST, width << depth) for depth in range(layers + 1)]
    blocks = [nn.Sequential(_conv(channels, width, 2), nn.LeakyReLU(0.2, inplace=True))]
    for depth, (inputs, outputs) in enumerate(zip(widths, widths[1:], strict=False), 1):
        conv = _conv(inputs, outputs, 2 if depth < layers else 1)
        blocks.append(nn.Sequential(conv, nn.BatchNorm2d(outputs), nn.LeakyReLU(0.2, inplace=True)))
    return [*blocks, nn.Sequential(_conv(widths[-1], 1, 1))]


def _conv(inputs: int, outputs: int, stride: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 4, stride=stride, padding=2)
