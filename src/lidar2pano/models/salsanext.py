"""SalsaNext: class scores for every pixel of a range image.

Paper     Cortinhal, Tzelepis, Aksoy: SalsaNext: Fast, Uncertainty-aware Semantic Segmentation of LiDAR Point Clouds,
          2020 (arXiv:2003.03653), Fig. 3.
Upstream  https://github.com/TiagoCortinhal/SalsaNext, commit 062cc71 (code MIT; the authors' weights were trained on
          SemanticKITTI, CC BY-NC-SA 4.0). Reimplemented here; parameter names are the published ones.
Deviates  from the published code in three points:
          logits come out instead of softmax (losses and arg-max want them; softmax restores the published output);
          activations work in place (half of a CPU forward goes into getting and returning large buffers);
          the blocks take their norm as an argument, since TITAN-Net is the same trunk with another norm.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from lidar2pano.errors import InputError
from lidar2pano.models.summed import SummedConv2d

STRIDE = 16  # four poolings by two
WIDTHS = (32, 64, 128, 256)  # of the published network
Norm = Callable[[int], nn.Module]


def _act() -> nn.Module:
    return nn.LeakyReLU(0.01, inplace=True)


class ContextBlock(nn.Module):
    """A 1x1 shortcut plus two 3x3 convolutions over it, the second dilated.

    x  (B, inputs, H, W) -> (B, outputs, H, W).
    """

    def __init__(self, inputs: int, outputs: int, norm: Norm = nn.BatchNorm2d) -> None:
        super().__init__()
        self.conv1, self.act1 = nn.Conv2d(inputs, outputs, 1), _act()
        self.conv2, self.act2 = nn.Conv2d(outputs, outputs, 3, padding=1), _act()
        self.bn1 = norm(outputs)
        self.conv3, self.act3 = nn.Conv2d(outputs, outputs, 3, padding=2, dilation=2), _act()
        self.bn2 = norm(outputs)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) -> (B, outputs, H, W)."""
        shortcut = self.act1(self.conv1(x))
        near = self.bn1(self.act2(self.conv2(shortcut)))
        return shortcut + self.bn2(self.act3(self.conv3(near)))


class ResBlock(nn.Module):
    """Three stacked convolutions of growing reach, joined by a 1x1 convolution, plus a 1x1 shortcut; then dropout.

    dropout  share of the channels that training zeroes.
    """

    def __init__(self, inputs: int, outputs: int, dropout: float = 0.0, norm: Norm = nn.BatchNorm2d) -> None:
        super().__init__()
        self.conv1, self.act1 = nn.Conv2d(inputs, outputs, 1), _act()
        self.conv2, self.act2 = nn.Conv2d(inputs, outputs, 3, padding=1), _act()
        self.bn1 = norm(outputs)
        self.conv3, self.act3 = nn.Conv2d(outputs, outputs, 3, padding=2, dilation=2), _act()
        self.bn2 = norm(outputs)
        self.conv4, self.act4 = nn.Conv2d(outputs, outputs, 2, padding=1, dilation=2), _act()
        self.bn3 = norm(outputs)
        self.conv5, self.act5 = SummedConv2d(3 * outputs, outputs, 1), _act()
        self.bn4 = norm(outputs)
        self.dropout = nn.Dropout2d(dropout)

    def residual(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) -> (B, outputs, H, W), before dropout: what the decoder's skip takes."""
        shortcut = self.act1(self.conv1(x))
        first = self.bn1(self.act2(self.conv2(x)))
        second = self.bn2(self.act3(self.conv3(first)))
        third = self.bn3(self.act4(self.conv4(second)))
        return shortcut + self.bn4(self.act5(self.conv5(first, second, third)))

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) -> (B, outputs, H, W)."""
        return self.dropout(self.residual(x))


class DownBlock(ResBlock):
    """A ResBlock that also halves the image: (B, inputs, H, W) -> (B, outputs, H/2, W/2) and its skip."""

    def __init__(self, inputs: int, outputs: int, dropout: float = 0.0, norm: Norm = nn.BatchNorm2d) -> None:
        super().__init__(inputs, outputs, dropout, norm)
        self.pool = nn.AvgPool2d(3, stride=2, padding=1)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(B, inputs, H, W) -> pooled (B, outputs, H/2, W/2), skip (B, outputs, H, W)."""
        skip = self.residual(x)
        return self.pool(self.dropout(skip)), skip


class UpBlock(nn.Module):
    """Pixel shuffle by two, the skip beside it, then three stacked convolutions joined by a 1x1 convolution.

    x  (B, inputs, H/2, W/2), skip (B, skip, H, W) -> (B, outputs, H, W).
    """

    def __init__(self, inputs: int, skip: int, outputs: int, dropout: float = 0.0, norm: Norm = nn.BatchNorm2d) -> None:
        super().__init__()
        self.shuffle = nn.PixelShuffle(2)
        self.dropout1, self.dropout2 = nn.Dropout2d(dropout), nn.Dropout2d(dropout)
        self.conv1, self.act1 = nn.Conv2d(inputs // 4 + skip, outputs, 3, padding=1), _act()
        self.bn1 = norm(outputs)
        self.conv2, self.act2 = nn.Conv2d(outputs, outputs, 3, padding=2, dilation=2), _act()
        self.bn2 = norm(outputs)
        self.conv3, self.act3 = nn.Conv2d(outputs, outputs, 2, padding=1, dilation=2), _act()
        self.bn3 = norm(outputs)
        self.conv4, self.act4 = SummedConv2d(3 * outputs, outputs, 1), _act()
        self.bn4 = norm(outputs)
        self.dropout3 = nn.Dropout2d(dropout)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        """(B, inputs, H/2, W/2) and (B, skip, H, W) -> (B, outputs, H, W)."""
        joined = self.dropout2(torch.cat([self.dropout1(self.shuffle(x)), skip], 1))
        first = self.bn1(self.act1(self.conv1(joined)))
        second = self.bn2(self.act2(self.conv2(first)))
        third = self.bn3(self.act3(self.conv3(second)))
        return self.dropout3(self.bn4(self.act4(self.conv4(first, second, third))))


class Trunk(nn.Module):
    """Encoder and decoder that SalsaNext and TITAN-Net share: (B, channels, H, W) -> (B, widths[0], H, W).

    upper_dropout  dropout of the decoder's first block (0.2 in SalsaNext, 0 in TITAN-Net); the first encoder block
                   and the last decoder block have none, all others 0.2.
    widths         channels at 1/1, 1/2, 1/4 and from 1/8 of the input raster on; each a multiple of 4.
    """

    def __init__(
        self,
        channels: int,
        norm: Norm = nn.BatchNorm2d,
        upper_dropout: float = 0.2,
        widths: Sequence[int] = WIDTHS,
    ) -> None:
        super().__init__()
        fine, half, quarter, coarse = widths
        if any(width % 4 for width in widths):
            raise InputError(f"widths {tuple(widths)}: each must be a multiple of 4, which pixel shuffles need")
        self.downCntx = ContextBlock(channels, fine, norm)
        self.downCntx2 = ContextBlock(fine, fine, norm)
        self.downCntx3 = ContextBlock(fine, fine, norm)
        self.resBlock1 = DownBlock(fine, half, 0.0, norm)
        self.resBlock2 = DownBlock(half, quarter, 0.2, norm)
        self.resBlock3 = DownBlock(quarter, coarse, 0.2, norm)
        self.resBlock4 = DownBlock(coarse, coarse, 0.2, norm)
        self.resBlock5 = ResBlock(coarse, coarse, 0.2, norm)
        self.upBlock1 = UpBlock(coarse, coarse, quarter, upper_dropout, norm)
        self.upBlock2 = UpBlock(quarter, coarse, quarter, 0.2, norm)
        self.upBlock3 = UpBlock(quarter, quarter, half, 0.2, norm)
        self.upBlock4 = UpBlock(half, half, fine, 0.0, norm)

    def features(self, x: Tensor) -> Tensor:
        """(B, channels, H, W) -> (B, widths[0], H, W); H and W must be multiples of 16, otherwise InputError."""
        if x.shape[-2] % STRIDE or x.shape[-1] % STRIDE:
            raise InputError(
                f"a range image of {x.shape[-2]} x {x.shape[-1]} pixels does not fit the network: "
                f"choose a view whose rows and columns are multiples of {STRIDE}"
            )
        x = self.downCntx3(self.downCntx2(self.downCntx(x)))
        x, skip1 = self.resBlock1(x)
        x, skip2 = self.resBlock2(x)
        x, skip3 = self.resBlock3(x)
        x, skip4 = self.resBlock4(x)
        x = self.upBlock1(self.resBlock5(x), skip4)
        x = self.upBlock2(x, skip3)
        x = self.upBlock3(x, skip2)
        return self.upBlock4(x, skip1)


class SalsaNext(Trunk):
    """Logits for `classes` from range images of `channels` (range, x, y, z, remission; normalised, zero where empty).

    x       (B, channels, H, W) float -> (B, classes, H, W) logits; H and W multiples of 16, otherwise InputError.
    widths  of the trunk; the published network's unless said otherwise.
    """

    def __init__(self, classes: int = 20, channels: int = 5, widths: Sequence[int] = WIDTHS) -> None:
        super().__init__(channels, widths=widths)
        self.logits = nn.Conv2d(widths[0], classes, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, channels, H, W) -> (B, classes, H, W) logits."""
        return self.logits(self.features(x))
