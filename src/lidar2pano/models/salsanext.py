"""SalsaNext, and the networks on its trunk: TITAN-Net with its Wasserstein critic, and TITAN-Next.

SalsaNext: class scores for every pixel of a range image.
Paper     Cortinhal, Tzelepis, Aksoy: SalsaNext: Fast, Uncertainty-aware Semantic Segmentation of LiDAR Point Clouds,
          2020 (arXiv:2003.03653), Fig. 3.
Upstream  https://github.com/TiagoCortinhal/SalsaNext, commit 062cc71 (code MIT; the authors' weights were trained on
          SemanticKITTI, CC BY-NC-SA 4.0). Reimplemented here; parameter names are the published ones.
Deviates  from the published code in three points:
          logits come out instead of softmax (losses and arg-max want them; softmax restores the published output);
          activations work in place (half of a CPU forward goes into getting and returning large buffers);
          the blocks take their norm as an argument, since TITAN-Net is the same trunk with another norm.

TITAN-Net: the camera's classes from a segmented LiDAR scan.
Paper     Cortinhal, Kurnaz, Aksoy: Semantics-aware Multi-modal Domain Translation: From LiDAR Point Clouds to
          Panoramic Color Images, 2021 (arXiv:2106.13974), section 3.
Upstream  https://github.com/TiagoCortinhal/TITAN-NET, commit 5e00db9 (no licence file; its README says MIT; the
          authors' weights were trained on SemanticKITTI, CC BY-NC-SA 4.0). Reimplemented here; parameter names are
          the published ones.
Deviates  from the published code in five points:
          logits come out instead of softmax, as in SalsaNext;
          the image size is a setting (the published one is the constant 376 x 1241);
          the norms of the one-channel merges are made for one channel (the published ones say 30, which works only
          because they have no parameters, and warns);
          the critic's channel counts are real settings (the published constructor ignores them and says 45);
          its condition is stretched to its image (the published one to the constant 376 x 1241).
Ablations of the paper (section 4.5) are settings: channels=0 does without the range view ("w/o Rangeview");
conditions=0 without segments, and with picture=True colours are made instead of classes ("w/o SegMap").

TITAN-Next: TITAN-Net with a feature pyramid and a depth head, front view in, camera's classes and depth out.
Paper     Cortinhal, Aksoy: Depth- and Semantics-aware Multi-modal Domain Translation: Generating 3D Panoramic Color
          Images from LiDAR Point Clouds, 2023 (arXiv:2302.07661).
Assumed   Its authors' public code (https://github.com/TiagoCortinhal/TITAN-Next, MIT) does not run and has
          no description of the weights, so this is no port: the merged input goes into every level of the encoder,
          every level of the decoder goes through a block into the pyramid, and heads for classes and depth read that.
          Names are ours, and nothing published loads here.
Deviates  from `titan_pano` in working in the camera's image, as the paper's tables do; depth is coded as there
          (logarithmic, bounded) instead of an unbounded number.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.functional import interpolate

from lidar2pano.errors import InputError
from lidar2pano.models.blocks import InstanceNorm, SummedConv2d, check_size
from lidar2pano.scene.depth import FAR_M

STRIDE = 16  # four poolings by two
WIDTHS = (32, 64, 128, 256)  # of the published network
Norm = Callable[[int], nn.Module]


def _act() -> nn.Module:
    return nn.LeakyReLU(0.01, inplace=True)


class ContextBlock(nn.Module):
    """A 1x1 shortcut plus two 3x3 convolutions over it, the second dilated."""

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

    dropout  share of zeroed channels in training.
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
        """(B, inputs, H, W) -> (B, outputs, H, W), before dropout, for the decoder's skip."""
        shortcut = self.act1(self.conv1(x))
        first = self.bn1(self.act2(self.conv2(x)))
        second = self.bn2(self.act3(self.conv3(first)))
        third = self.bn3(self.act4(self.conv4(second)))
        return shortcut + self.bn4(self.act5(self.conv5(first, second, third)))

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) -> (B, outputs, H, W)."""
        return self.dropout(self.residual(x))


class DownBlock(ResBlock):
    """A ResBlock with halving of the image: (B, inputs, H, W) -> (B, outputs, H/2, W/2) and its skip."""

    def __init__(self, inputs: int, outputs: int, dropout: float = 0.0, norm: Norm = nn.BatchNorm2d) -> None:
        super().__init__(inputs, outputs, dropout, norm)
        self.pool = nn.AvgPool2d(3, stride=2, padding=1)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(B, inputs, H, W) -> pooled (B, outputs, H/2, W/2), skip (B, outputs, H, W)."""
        skip = self.residual(x)
        return self.pool(self.dropout(skip)), skip


class UpBlock(nn.Module):
    """Pixel shuffle by two, the skip beside it, then three stacked convolutions joined by a 1x1 convolution."""

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
    """Encoder and decoder of SalsaNext and TITAN-Net: (B, channels, H, W) -> (B, widths[0], H, W).

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
        check_size(x, STRIDE, "a range image")
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
    """Logits for `classes` from range images of `channels` (range, x, y, z, remission; normalised, zero if empty).

    x       (B, channels, H, W) float -> (B, classes, H, W) logits; H and W multiples of 16, otherwise InputError.
    widths  of the trunk; the published network's unless said otherwise.
    """

    def __init__(self, classes: int = 20, channels: int = 5, widths: Sequence[int] = WIDTHS) -> None:
        super().__init__(channels, widths=widths)
        self.logits = nn.Conv2d(widths[0], classes, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, channels, H, W) -> (B, classes, H, W) logits."""
        return self.logits(self.features(x))


IMAGE_SIZE = (376, 1241)  # rows, columns: KITTI's images, as published
CONDITION_CHANNELS = 30  # of the critic's condition, after its convolutions


def pixelwise(inputs: int, outputs: int, norm: type[nn.Module] = InstanceNorm) -> nn.Sequential:
    """Mix channels pixel by pixel."""
    return nn.Sequential(nn.Conv2d(inputs, outputs, 1), nn.LeakyReLU(0.2, inplace=True), norm(outputs))


class Titan(Trunk):
    """Logits of `classes` at the camera's `size` from a range image and its one-hot segmentation.

    z          (B, channels, H, W) float: range, x, y, z, remission; normalised, zero if empty; H, W multiples of 16
               and more than one pixel after sixteenfold reduction (the instance norm needs two).
    condition  (B, conditions, H, W) float: one-hot SemanticKITTI classes (empty pixels are class 0).
    out        (B, classes, *size) logits; with `picture` instead colours in [-1, 1] (tanh), classes being 3.
    With channels=0 or conditions=0 the input is unused and may be None.
    """

    def __init__(
        self,
        classes: int = 15,
        conditions: int = 20,
        size: Sequence[int] = IMAGE_SIZE,
        channels: int = 5,
        picture: bool = False,
    ) -> None:
        super().__init__(32, InstanceNorm, upper_dropout=0.0)
        if not channels and not conditions:
            raise InputError("titan needs an input: channels (the range view), conditions (its segments) or both")
        height, width = size
        self.size, self.picture = (int(height), int(width)), picture
        self.project_z = pixelwise(channels, 1) if channels else None
        self.project_cond = pixelwise(conditions, 1) if conditions else None
        self.project_zcond = pixelwise(bool(channels) + bool(conditions), 32)
        self.upsampling1 = nn.Sequential(nn.Conv2d(32, 128, 3, padding=1), nn.PixelShuffle(2))
        self.upResBlock1 = ResBlock(32, 32, norm=InstanceNorm)
        self.logits = nn.Conv2d(32, classes, 1)

    def raster(self, z: Tensor | None, condition: Tensor | None = None) -> Tensor:
        """(B, channels, H, W) and (B, conditions, H, W) -> (B, classes, 2H, 2W) logits, before the resize."""
        inputs = ((self.project_z, z), (self.project_cond, condition))
        merged = self.project_zcond(torch.cat([project(part) for project, part in inputs if project is not None], 1))
        return self.logits(self.upResBlock1(self.upsampling1(self.features(merged))))

    def forward(self, z: Tensor | None, condition: Tensor | None = None) -> Tensor:
        """(B, channels, H, W) and (B, conditions, H, W) -> (B, classes, *size) logits, or colours."""
        image = functional.interpolate(self.raster(z, condition), self.size, mode="bilinear", align_corners=True)
        return image.tanh() if self.picture else image


def _halve(inputs: int, outputs: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 4, stride=2, padding=1, bias=False)


class TitanCritic(nn.Module):
    """Wasserstein critic without norm layers, for penalties of each sample's own gradient.

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
        # In bfloat16 on CPUs torch (2.13) makes noise or NaN of the gradient of a dilated convolution's weights where
        # channels do not divide by 16, as 30 do not, in channels-last layout.
        with torch.autocast("cpu", enabled=False):
            condition = self.conv1(condition.to(next(self.conv1.parameters()).dtype))
        condition = functional.interpolate(condition, image.shape[-2:], mode="bilinear", align_corners=True)
        return self.model(torch.cat([image, condition], 1))


MERGED = 32  # channels of the merged input
DROPOUT = 0.2  # in all blocks but the first of the encoder and of the decoder


class TitanNext(nn.Module):
    """Logits and depth at the camera's `size` from a range image and its one-hot segmentation.

    classes, conditions, channels  of the output, of the segments, of the range image.
    width                          channels of the pyramid's levels; the encoder has 2, 4, 8, 8 times as many.
    """

    def __init__(
        self,
        classes: int = 15,
        conditions: int = 20,
        size: Sequence[int] = IMAGE_SIZE,
        channels: int = 5,
        width: int = 64,
    ) -> None:
        super().__init__()
        height, across = size
        self.size = (int(height), int(across))
        self.project_z, self.project_cond = (pixelwise(n, 1, nn.BatchNorm2d) for n in (channels, conditions))
        self.project_zcond = pixelwise(2, MERGED, nn.BatchNorm2d)
        self.context = nn.Sequential(*(ContextBlock(MERGED, MERGED) for _ in range(3)))
        widths = [2 * width, 4 * width, 8 * width, 8 * width]
        inputs_by_level = [MERGED, *widths]
        self.down = nn.ModuleList(
            [
                DownBlock(MERGED + inputs, outputs, DROPOUT if level else 0.0)
                for level, (inputs, outputs) in enumerate(zip(inputs_by_level, widths, strict=False))
            ]
        )
        self.bottom = ResBlock(MERGED + widths[-1], widths[-1], DROPOUT)
        decoded = [4 * width, 4 * width, 2 * width, width]
        decoder_inputs = [MERGED + widths[-1], *decoded]
        self.up = nn.ModuleList(
            [
                UpBlock(inputs, skip, outputs, DROPOUT if level else 0.0)
                for level, (inputs, skip, outputs) in enumerate(
                    zip(decoder_inputs, reversed(widths), decoded, strict=False)
                )
            ]
        )
        self.pyramid = nn.ModuleList([ResBlock(outputs, width, DROPOUT) for outputs in decoded])
        self.merge = nn.ModuleList([nn.Conv2d(width, MERGED, 1, bias=level == 0) for level in range(len(decoded))])
        self.logits = nn.Conv2d(MERGED, classes, 1)
        self.depth = nn.Sequential(
            *(nn.Sequential(nn.Conv2d(MERGED, MERGED, 3, padding=1), nn.LeakyReLU(0.01)) for _ in range(2)),
            nn.Conv2d(MERGED, 1, 1),
        )

    def forward(self, z: Tensor, condition: Tensor) -> tuple[Tensor, Tensor]:
        """Translate.

        z          (B, channels, H, W) float: range, x, y, z, remission; normalised, zero in empty pixels.
        condition  (B, conditions, H, W) float: one-hot SemanticKITTI classes (empty pixels are class 0).
        Returns logits (B, classes, *size) and depth (B, *size), metres along the ray, float32.
        Raises InputError unless H and W are multiples of 16.
        """
        check_size(z, STRIDE, "a range image")
        merged = self.project_zcond(torch.cat([self.project_z(z), self.project_cond(condition)], 1))
        x, skips = self.context(merged), []
        for block in self.down:
            x, skip = block(_beside(merged, x))
            skips.append(skip)
        x = _beside(merged, self.bottom(_beside(merged, x)))
        image: Tensor | None = None
        for up, block, merge in zip(self.up, self.pyramid, self.merge, strict=True):
            x = up(x, skips.pop())
            # a 1x1 convolution and a bilinear resize may change places: the wide layers stay small
            level = interpolate(merge(block(x)), self.size, mode="bilinear", align_corners=True)
            image = level if image is None else image + level
        assert image is not None
        depth_m = torch.expm1(self.depth(image)[:, 0].float().sigmoid() * math.log1p(FAR_M))
        return self.logits(image), depth_m


def _beside(merged: Tensor, x: Tensor) -> Tensor:
    """x with the merged input at its size beside it."""
    return torch.cat([interpolate(merged, x.shape[-2:], mode="bilinear", align_corners=True), x], 1)
