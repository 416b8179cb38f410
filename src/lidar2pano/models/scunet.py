"""SC-UNET: a colour picture from the LiDAR's reflectance projected into the camera.

Paper     Kim, Yoo, Jung: Color Image Generation from LiDAR Reflection Data by Using Selected Connection UNET, Sensors
          2020, 20(12), 3387.
Assumed   No code is public. The paper's words give five levels of two convolution blocks each, shortcuts at the two
          lowest levels only (the upper ones are too sparse: 5 % of the reflectance picture's pixels hold a point) and a
          squared error. Channel counts, transposed convolutions and the sigmoid at the end are assumptions, and so are
          all names: nothing published loads here.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from lidar2pano.errors import InputError


class ScUnet(nn.Module):
    """RGB in [-1, 1] from a sparse picture at the camera's resolution.

    inputs     channels: reflectance (1), or reflectance and range (2); zero where no point fell.
    widths     channels per level, from the finest down.
    connected  how many of the lower levels have a shortcut from encoder to decoder.
    """

    def __init__(
        self,
        inputs: int = 1,
        outputs: int = 3,
        widths: tuple[int, ...] = (32, 64, 128, 256, 512),
        connected: int = 2,
    ) -> None:
        super().__init__()
        if len(widths) < 2 or not 0 <= connected < len(widths):
            raise InputError(f"connected={connected} of {len(widths)} levels: at least two levels, fewer connections")
        self.stride, self.connected = 2 ** (len(widths) - 1), connected
        self.enc = nn.ModuleList([_blocks(before, width) for before, width in pairwise([inputs, *widths])])
        self.pool = nn.MaxPool2d(2)
        upwards = list(pairwise(reversed(widths)))
        self.up = nn.ModuleList([nn.ConvTranspose2d(below, width, 2, stride=2) for below, width in upwards])
        self.dec = nn.ModuleList(
            [_blocks(2 * width if level < connected else width, width) for level, (_, width) in enumerate(upwards)]
        )
        self.head = nn.Conv2d(widths[0], outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) -> (B, outputs, H, W) in [-1, 1].

        Sizes that do not divide by `stride` are padded with emptiness at the lower and right edge, and cut back.
        """
        rows, columns = x.shape[-2:]
        x = pad(x, (0, -columns % self.stride, 0, -rows % self.stride))
        skips: list[Tensor] = []
        for level, blocks in enumerate(self.enc):
            x = blocks(self.pool(x) if level else x)
            skips.append(x)
        for level, (up, blocks) in enumerate(zip(self.up, self.dec, strict=True)):
            x = up(x)
            x = blocks(torch.cat([x, skips[-2 - level]], 1) if level < self.connected else x)
        return 2 * self.head(x).sigmoid()[..., :rows, :columns] - 1


def _blocks(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(_block(inputs, outputs), _block(outputs, outputs))


def _block(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, padding=1), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))
