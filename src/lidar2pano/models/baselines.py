"""Networks of the paper's baselines: Pix2Pix, a U-Net with the 70 x 70 PatchGAN as a judge of pairs, and SC-UNET.

Pix2Pix
Paper     Isola, Zhu, Zhou, Efros: Image-to-Image Translation with Conditional Adversarial Networks, 2017
          (arXiv:1611.07004), sections 3.2 and 6.1.
Upstream  https://github.com/junyanz/pytorch-CycleGAN-and-pix2pix (BSD-2), `unet_256` and `basic`. Reimplemented here;
          parameter names are the published ones.
Deviates  from the published code in three points:
          any number of images is taken, joined channel by channel (published: one, joined by the caller);
          sizes without enough halvings are padded or resized (published: refused), see `Pix2Pix`;
          evaluation is deterministic: no dropout, and running statistics unless `batch_statistics` says otherwise (the
          published test command leaves both as in training).

SC-UNET: a colour picture from the LiDAR's reflectance projected into the camera.
Paper     Kim, Yoo, Jung: Color Image Generation from LiDAR Reflection Data by Using Selected Connection UNET, Sensors
          2020, 20(12), 3387.
Assumed   No code is public. The paper's words give five levels of two convolution blocks each, shortcuts at the two
          lowest levels only (the upper ones are too sparse: 5 % of the reflectance picture's pixels hold a point) and a
          squared error. Channel counts, transposed convolutions and the sigmoid at the end are assumptions, and so are
          all names: nothing published loads here.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, pad

from lidar2pano.errors import InputError
from lidar2pano.models.blocks import InstanceNorm
from lidar2pano.models.vid2vid_layers import Norm, batch_norms, start_as_published

NORMS = ("batch", "instance")
MOST_WIDTHS = 8  # no level has more than this many times `width` channels


class Pix2Pix(nn.Module):
    """An image of `outputs` channels in [-1, 1] (tanh) from images of `inputs` channels together.

    inputs, outputs   channels. For classes, `outputs` of them; the largest names the class.
    width             channels of the first level; the next ones have 2, 4, 8, 8, ... times as many.
    depth             levels, each half the size of the one above: sizes are halved `depth` times.
    dropout           share of zeroed values in the deep levels, in training (the paper's only noise).
    norm              "batch" or "instance" (whose convolutions have biases, as published).
    batch_statistics  normalise by the batch at hand in evaluation as well, as the published test command does; then
                      images of one batch know each other.
    size              (rows, columns) of the image to write: the input is stretched to the next multiple of 2^depth
                      (means over areas, to keep every point of a sparse image) and the output is resized to
                      `size` bilinearly. None: the output is as large as the input, padded at its lower and
                      right edge by repeating the last pixels, and cut back afterwards.
    """

    def __init__(
        self,
        inputs: int = 3,
        outputs: int = 3,
        width: int = 64,
        depth: int = 8,
        dropout: float = 0.5,
        norm: Literal["batch", "instance"] = "batch",
        batch_statistics: bool = False,
        size: Sequence[int] | None = None,
    ) -> None:
        super().__init__()
        if depth < 2:
            raise InputError(f"a U-Net of depth={depth} has no level inside another; depth must be at least 2")
        self.stride = 2**depth
        self.size = None if size is None else (int(size[0]), int(size[1]))
        norms, bias = _norm(norm, batch_statistics), norm == "instance"
        widths = [width * min(2**level, MOST_WIDTHS) for level in range(depth)]
        inner_level: nn.Module | None = None
        for outer, inner in reversed(list(zip(widths, widths[1:], strict=False))):
            share = dropout if inner_level is not None and outer == width * MOST_WIDTHS else 0.0
            inner_level = _Level(outer, inner, inner_level, norms, bias, share)
        assert inner_level is not None
        self.model = _Outermost(inputs, widths[0], inner_level, outputs, bias)
        start_as_published(self)

    def forward(self, *images: Tensor) -> Tensor:
        """(B, C, H, W) each, of `inputs` channels together -> (B, outputs, *size), or as large as the input."""
        x = torch.cat(images, 1)
        rows, columns = self.size or x.shape[-2:]
        down, across = -rows % self.stride, -columns % self.stride
        if self.size is None:
            x = pad(x, (0, across, 0, down), mode="replicate") if down or across else x
            return self.model(x)[..., :rows, :columns]
        if x.shape[-2:] != (rows + down, columns + across):
            x = interpolate(x, size=(rows + down, columns + across), mode="area")
        x = self.model(x)
        return interpolate(x, size=self.size, mode="bilinear", align_corners=False) if down or across else x


class PatchGan(nn.Module):
    """Scores of patches (70 x 70 pixels with three layers): are these images a true pair? Without sigmoid.

    channels  of all images together;  width: channels of the first layer;  layers: of stride two.
    """

    def __init__(
        self, channels: int = 6, width: int = 64, layers: int = 3, norm: Literal["batch", "instance"] = "batch"
    ) -> None:
        super().__init__()
        norms, bias = _norm(norm, False), norm == "instance"
        blocks: list[nn.Module] = [nn.Conv2d(channels, width, 4, stride=2, padding=1), nn.LeakyReLU(0.2)]
        inner = width
        for layer in range(1, layers + 1):
            outer = width * min(2**layer, MOST_WIDTHS)
            stride = 2 if layer < layers else 1
            conv = nn.Conv2d(inner, outer, 4, stride=stride, padding=1, bias=bias)
            blocks += [conv, norms(outer), nn.LeakyReLU(0.2)]
            inner = outer
        self.model = nn.Sequential(*blocks, nn.Conv2d(inner, 1, 4, padding=1))
        start_as_published(self)

    def forward(self, *images: Tensor) -> Tensor:
        """(B, C, H, W) each, of `channels` together -> (B, 1, h, w) scores; the condition comes first as published."""
        return self.model(torch.cat(images, 1))


class _Level(nn.Module):
    """A level of the U-Net: down, the level below (None: the innermost), up; beside it the shortcut.

    x  (B, outer, H, W) -> (B, 2 outer, H, W).
    """

    def __init__(
        self, outer: int, inner: int, inner_level: nn.Module | None, norm: Norm, bias: bool, dropout: float
    ) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.LeakyReLU(0.2), nn.Conv2d(outer, inner, 4, stride=2, padding=1, bias=bias)]
        if inner_level is not None:
            layers += [norm(inner), inner_level]
        wide = inner if inner_level is None else 2 * inner
        layers += [nn.ReLU(inplace=True), nn.ConvTranspose2d(wide, outer, 4, stride=2, padding=1, bias=bias)]
        layers += [norm(outer), *([nn.Dropout(dropout)] if dropout else [])]
        self.model = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([x, self.model(x)], 1)


class _Outermost(nn.Module):
    """The first level, without shortcut: (B, inputs, H, W) -> (B, outputs, H, W)."""

    def __init__(self, inputs: int, inner: int, inner_level: nn.Module, outputs: int, bias: bool) -> None:
        super().__init__()
        self.model = nn.Sequential(
            nn.Conv2d(inputs, inner, 4, stride=2, padding=1, bias=bias),
            inner_level,
            nn.ReLU(inplace=True),
            nn.ConvTranspose2d(2 * inner, outputs, 4, stride=2, padding=1),
            nn.Tanh(),
        )

    def forward(self, x: Tensor) -> Tensor:
        return self.model(x)


def _norm(name: str, batch_statistics: bool) -> Norm:
    if name not in NORMS:
        raise InputError(f"no norm {name!r}; there is {' and '.join(NORMS)}")
    return InstanceNorm if name == "instance" else batch_norms(batch_statistics)


class ScUnet(nn.Module):
    """RGB in [-1, 1] from a sparse picture at the camera's resolution.

    inputs     channels: reflectance (1), or reflectance and range (2); zero for pixels without a point.
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
        self.enc = nn.ModuleList([_blocks(inputs, width) for inputs, width in pairwise([inputs, *widths])])
        self.pool = nn.MaxPool2d(2)
        upwards = list(pairwise(reversed(widths)))
        self.up = nn.ModuleList([nn.ConvTranspose2d(inputs, width, 2, stride=2) for inputs, width in upwards])
        self.dec = nn.ModuleList(
            [_blocks(2 * width if level < connected else width, width) for level, (_, width) in enumerate(upwards)]
        )
        self.head = nn.Conv2d(widths[0], outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) -> (B, outputs, H, W) in [-1, 1].

        Sizes not divisible by `stride` are padded with emptiness at the lower and right edge, and cut back.
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
