"""TITAN-Net: what the camera would see, as class scores, from a segmented LiDAR scan; and its Wasserstein critic.

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
          the critic's channel counts are settings that count (the published constructor ignores them and says 45);
          its condition is stretched to the image that it is given with (the published one to the constant 376 x 1241).
Ablations of the paper (section 4.5) are settings: channels=0 does without the range view ("w/o Rangeview");
conditions=0 without segments, and with picture=True colours are made instead of classes ("w/o SegMap").
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from lidar2pano.errors import InputError
from lidar2pano.models.instance_norm import InstanceNorm
from lidar2pano.models.salsanext import ResBlock, Trunk

IMAGE_SIZE = (376, 1241)  # rows, columns: KITTI's images, as published
CONDITION_CHANNELS = 30  # of the critic's condition, after its convolutions


def pixelwise(inputs: int, outputs: int, norm: type[nn.Module] = InstanceNorm) -> nn.Sequential:
    """Mix channels pixel by pixel."""
    return nn.Sequential(nn.Conv2d(inputs, outputs, 1), nn.LeakyReLU(0.2, inplace=True), norm(outputs))


class Titan(Trunk):
    """Logits of `classes` at the camera's `size` from a range image and its one-hot segmentation.

    z          (B, channels, H, W) float: range, x, y, z, remission; normalised, zero where empty; H, W multiples of 16
               and more than one pixel after sixteenfold reduction (the instance norm needs two).
    condition  (B, conditions, H, W) float: one-hot SemanticKITTI classes (empty pixels are class 0).
    out        (B, classes, *size) logits; with `picture` instead colours in [-1, 1] (tanh), of which classes is 3.
    With channels=0 or conditions=0 that input is not looked at and may be None.
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
        # In bfloat16 on CPUs torch (2.13) makes noise or NaN of the gradient of a dilated convolution's weights where
        # channels do not divide by 16, as 30 do not, in channels-last layout.
        with torch.autocast("cpu", enabled=False):
            condition = self.conv1(condition.to(next(self.conv1.parameters()).dtype))
        condition = functional.interpolate(condition, image.shape[-2:], mode="bilinear", align_corners=True)
        return self.model(torch.cat([image, condition], 1))
