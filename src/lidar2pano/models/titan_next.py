"""TITAN-Next: TITAN-Net with a feature pyramid and a depth head, front view in, camera's classes and depth out.

Paper     Cortinhal, Aksoy: Depth- and Semantics-aware Multi-modal Domain Translation: Generating 3D Panoramic Color
          Images from LiDAR Point Clouds, 2023 (arXiv:2302.07661).
Assumed   What its authors made public (https://github.com/TiagoCortinhal/TITAN-Next, MIT) does not run and has no
          description of the weights, so this is no port: the merged input goes into every level of the encoder, every
          level of the decoder goes through a block into the pyramid, and heads for classes and depth read that. Names
          are ours, and nothing published loads here.
Deviates  from `titan_pano` in working in the camera's image, as the paper's tables do; depth is coded as there
          (logarithmic, bounded) instead of an unbounded number.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from lidar2pano.errors import InputError
from lidar2pano.models.salsanext import STRIDE, ContextBlock, DownBlock, ResBlock, UpBlock
from lidar2pano.models.titan import IMAGE_SIZE, pixelwise
from lidar2pano.models.titan_pano import FAR_M

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
        before = [MERGED, *widths]
        self.down = nn.ModuleList(
            [
                DownBlock(MERGED + inputs, outputs, DROPOUT if level else 0.0)
                for level, (inputs, outputs) in enumerate(zip(before, widths, strict=False))
            ]
        )
        self.bottom = ResBlock(MERGED + widths[-1], widths[-1], DROPOUT)
        decoded = [4 * width, 4 * width, 2 * width, width]
        below = [MERGED + widths[-1], *decoded]
        self.up = nn.ModuleList(
            [
                UpBlock(inputs, skip, outputs, DROPOUT if level else 0.0)
                for level, (inputs, skip, outputs) in enumerate(zip(below, reversed(widths), decoded, strict=False))
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

        z          (B, channels, H, W) float: range, x, y, z, remission; normalised, zero where empty.
        condition  (B, conditions, H, W) float: one-hot SemanticKITTI classes (empty pixels are class 0).
        Returns logits (B, classes, *size) and depth (B, *size), metres along the ray, float32.
        Raises InputError unless H and W are multiples of 16.
        """
        if z.shape[-2] % STRIDE or z.shape[-1] % STRIDE:
            raise InputError(
                f"a range image of {z.shape[-2]} x {z.shape[-1]} pixels does not fit the network: "
                f"choose a view whose rows and columns are multiples of {STRIDE}"
            )
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
