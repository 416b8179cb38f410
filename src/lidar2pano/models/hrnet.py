"""HRNet: features of a picture at a quarter of its size, from four rasters that are kept side by side.

Paper     Wang et al.: Deep High-Resolution Representation Learning for Visual Recognition, 2019 (arXiv:1908.07919),
          section 3 (HRNetV2).
Upstream  https://github.com/NVIDIA/semantic-segmentation, commit 7726b14 (BSD-3), which has it from
          https://github.com/HRNet/HRNet-Semantic-Segmentation (MIT). Reimplemented here; parameter names are the
          published ones.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, relu_

BRANCHES = 4  # rasters at 1/4, 1/8, 1/16 and 1/32 of the picture
EXPANSION = 4  # how many times as wide as its middle a bottleneck ends


def resized(x: Tensor, size: tuple[int, int] | torch.Size) -> Tensor:
    """(B, C, h, w) -> (B, C, *size), bilinear, corners not aligned; x itself where nothing changes."""
    return x if x.shape[-2:] == tuple(size) else interpolate(x, size, mode="bilinear", align_corners=False)


def conv_norm(inputs: int, outputs: int, size: int = 3, stride: int = 1, act: bool = True) -> nn.Sequential:
    """Convolution without bias, batch norm and, unless `act` is false, ReLU."""
    parts = [nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False), nn.BatchNorm2d(outputs)]
    return nn.Sequential(*parts, *([nn.ReLU(inplace=True)] if act else []))


class BasicBlock(nn.Module):
    """Two 3x3 convolutions beside a shortcut: (B, channels, H, W) -> the same."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels)
        self.conv2, self.bn2 = nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels)

    def forward(self, x: Tensor) -> Tensor:
        """(B, channels, H, W) -> (B, channels, H, W)."""
        inner = relu_(self.bn1(self.conv1(x)))
        return relu_(self.bn2(self.conv2(inner)).add_(x))


class Bottleneck(nn.Module):
    """1x1, 3x3, 1x1 beside a shortcut: (B, inputs, H, W) -> (B, 4 middle, H, W)."""

    def __init__(self, inputs: int, middle: int) -> None:
        super().__init__()
        outputs = EXPANSION * middle
        self.conv1, self.bn1 = nn.Conv2d(inputs, middle, 1, bias=False), nn.BatchNorm2d(middle)
        self.conv2, self.bn2 = nn.Conv2d(middle, middle, 3, padding=1, bias=False), nn.BatchNorm2d(middle)
        self.conv3, self.bn3 = nn.Conv2d(middle, outputs, 1, bias=False), nn.BatchNorm2d(outputs)
        self.downsample = nn.Identity() if inputs == outputs else conv_norm(inputs, outputs, 1, act=False)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) -> (B, 4 middle, H, W)."""
        inner = relu_(self.bn1(self.conv1(x)))
        inner = relu_(self.bn2(self.conv2(inner)))
        return relu_(self.bn3(self.conv3(inner)).add_(self.downsample(x)))


class Exchange(nn.Module):
    """Blocks on every raster, then each raster becomes the sum of all: pooled by convolutions, or stretched.

    Takes and gives a list of (B, widths[i], H / 2^i, W / 2^i).
    """

    def __init__(self, widths: tuple[int, ...], blocks: int) -> None:
        super().__init__()
        self.branches = nn.ModuleList([nn.Sequential(*(BasicBlock(width) for _ in range(blocks))) for width in widths])
        self.fuse_layers = nn.ModuleList(
            [
                nn.ModuleList([_carry(source, target, widths) for source in range(len(widths))])
                for target in range(len(widths))
            ]
        )

    def forward(self, rasters: list[Tensor]) -> list[Tensor]:
        """Of each raster the sum of what all rasters say about it."""
        rasters = [branch(raster) for branch, raster in zip(self.branches, rasters, strict=True)]
        return [relu_(self._sum(rasters, target)) for target in range(len(rasters))]

    def _sum(self, rasters: list[Tensor], target: int) -> Tensor:
        size, carry = rasters[target].shape[-2:], self.fuse_layers[target]
        total = rasters[0].clone() if target == 0 else carry[0](rasters[0])  # pyright: ignore[reportIndexIssue]
        for source in range(1, len(rasters)):
            total.add_(resized(carry[source](rasters[source]), size))  # pyright: ignore[reportIndexIssue]
        return total


def _carry(source: int, target: int, widths: tuple[int, ...]) -> nn.Module:
    """From one raster to the width, and downwards also to the size, of another."""
    if source == target:
        return nn.Identity()
    if source > target:
        return conv_norm(widths[source], widths[target], 1, act=False)
    halvings = [conv_norm(widths[source], widths[source], stride=2) for _ in range(target - source - 1)]
    return nn.Sequential(*halvings, conv_norm(widths[source], widths[target], stride=2, act=False))


class HRNet(nn.Module):
    """HRNetV2: (B, 3, H, W) -> (B, 15 width, H / 4, W / 4), sizes rounded up.

    width    channels of the finest raster; each coarser one has twice as many.
    stem     channels before the rasters part, at 1/2 and 1/4.
    blocks   blocks per raster of an exchange, and bottlenecks before the rasters part.
    modules  exchanges of two, three and four rasters.
    """

    def __init__(
        self, width: int = 48, stem: int = 64, blocks: int = 4, modules: tuple[int, int, int] = (1, 4, 3)
    ) -> None:
        super().__init__()
        widths = tuple(width << branch for branch in range(BRANCHES))
        self.channels = sum(widths)
        self.conv1, self.bn1 = nn.Conv2d(3, stem, 3, 2, 1, bias=False), nn.BatchNorm2d(stem)
        self.conv2, self.bn2 = nn.Conv2d(stem, stem, 3, 2, 1, bias=False), nn.BatchNorm2d(stem)
        wide = EXPANSION * stem
        self.layer1 = nn.Sequential(*(Bottleneck(wide if number else stem, stem) for number in range(blocks)))
        self.transition1 = nn.ModuleList(
            [conv_norm(wide, widths[0]), nn.Sequential(conv_norm(wide, widths[1], stride=2))]
        )
        self.transition2, self.transition3 = (
            nn.ModuleList(
                [
                    *(nn.Identity() for _ in range(branches)),
                    nn.Sequential(conv_norm(widths[branches - 1], widths[branches], stride=2)),
                ]
            )
            for branches in (2, 3)
        )
        self.stage2, self.stage3, self.stage4 = (
            nn.Sequential(*(Exchange(widths[:branches], blocks) for _ in range(number)))
            for branches, number in zip((2, 3, 4), modules, strict=True)
        )

    def forward(self, images: Tensor) -> Tensor:
        """(B, 3, H, W) -> (B, 15 width, H / 4, W / 4): all rasters, stretched to the finest."""
        x = relu_(self.bn1(self.conv1(images)))
        x = self.layer1(relu_(self.bn2(self.conv2(x))))
        rasters = self.stage2([transition(x) for transition in self.transition1])
        del x  # the widest of all
        rasters = self.stage3(_one_more(rasters, self.transition2))
        rasters = self.stage4(_one_more(rasters, self.transition3))
        finest = rasters[0]
        return torch.cat([resized(raster, finest.shape[-2:]).to(finest.dtype) for raster in rasters], 1)


def _one_more(rasters: list[Tensor], transition: nn.ModuleList) -> list[Tensor]:
    """The rasters, and one of half the size from the coarsest of them."""
    return [into(raster) for into, raster in zip(transition, [*rasters, rasters[-1]], strict=True)]
