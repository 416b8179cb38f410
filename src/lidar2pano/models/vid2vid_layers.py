"""Layers of vid2vid's networks, with a choice of looking past an image's left and right edge at the other end.

Source and deviations: models.vid2vid.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, batch_norm, conv2d, conv_transpose2d, instance_norm, pad
from torch.nn.modules.batchnorm import _BatchNorm

from lidar2pano.geometry.rasters import pad_azimuth
from lidar2pano.models.blocks import InstanceNorm

Norm = Callable[[int], nn.Module]


class Closable:
    """A layer or network with a look past its image's edges.

    closed  past the left and right one, it sees the other end.
    """

    closed: bool = False


class Padding(Closable, nn.Module):
    """Reflects `reach` pixels at every edge: (B, C, H, W) -> (B, C, H + 2 reach, W + 2 reach)."""

    def __init__(self, reach: int) -> None:
        super().__init__()
        self.reach = reach

    def forward(self, x: Tensor) -> Tensor:
        """Pad; when closed, columns come from the other end."""
        reach = self.reach
        if self.closed:
            return pad(pad_azimuth(x, reach), (0, 0, reach, reach), mode="reflect")
        return pad(x, (reach, reach, reach, reach), mode="reflect")


class Halving(Closable, nn.Conv2d):
    """A 3x3 convolution of stride 2 over zeros at the edges: (B, inputs, H, W) -> (B, outputs, H/2, W/2)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, 3, stride=2, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Convolve; when closed, columns come from the other end."""
        if self.closed:
            return conv2d(pad_azimuth(x, 1), self.weight, self.bias, stride=2, padding=(1, 0))
        return super().forward(x)


class Doubling(Closable, nn.ConvTranspose2d):
    """Its counterpart: (B, inputs, H, W) -> (B, outputs, 2H, 2W)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, 3, stride=2, padding=1, output_padding=1)

    def forward(self, x: Tensor, output_size: list[int] | None = None) -> Tensor:  # noqa: ARG002 torch's signature
        """Convolve; when closed, the last column's right neighbour is the first."""
        if not self.closed:
            return super().forward(x)
        wrapped = torch.cat([x, x[..., :1]], 3)  # only odd columns of the answer look past the edge, and only right
        grown = conv_transpose2d(wrapped, self.weight, self.bias, stride=2, padding=1, output_padding=1)
        return grown[..., : 2 * x.shape[3]]


class Residual(nn.Module):
    """Two 3x3 convolutions around a shortcut: (B, width, H, W) -> the same shape."""

    def __init__(self, width: int, norm: Norm) -> None:
        super().__init__()
        first = [Padding(1), nn.Conv2d(width, width, 3), norm(width), nn.ReLU(inplace=True)]
        self.conv_block = nn.Sequential(*first, Padding(1), nn.Conv2d(width, width, 3), norm(width))

    def forward(self, x: Tensor) -> Tensor:
        """Add the two convolutions to x."""
        return x + self.conv_block(x)


class BatchStatistics(_BatchNorm):
    """A batch norm by the batch's statistics in evaluation mode, too; it keeps running ones, as published."""

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002 torch's name
        """(B, width, H, W) -> the same shape; evaluation changes no statistics."""
        if self.training:
            return super().forward(input)
        return batch_norm(input, None, None, self.weight, self.bias, training=True, eps=self.eps)

    def _check_input_dim(self, input: Tensor) -> None:  # noqa: A002 torch's name
        if input.ndim != 4:
            raise ValueError(f"expected (B, C, H, W), got {tuple(input.shape)}")


class InstanceStatistics(InstanceNorm):
    """An instance norm by the instance's statistics in evaluation mode, too."""

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002 torch's name
        """(B, width, H, W) -> the same shape; evaluation changes no statistics."""
        if self.training:
            return super().forward(input)
        return instance_norm(input, use_input_stats=True, eps=self.eps)


def batch_norms(batch_statistics: bool) -> Norm:
    """The generators' and critics' norm; with the batch's own statistics in evaluation mode, if so wanted."""
    return BatchStatistics if batch_statistics else nn.BatchNorm2d


def instance_norms(own_statistics: bool) -> Norm:
    """The first-frame network's norm, without scale or shift: running statistics in evaluation mode, or its own."""
    norm = InstanceStatistics if own_statistics else InstanceNorm
    return lambda width: norm(width, affine=False, track_running_stats=True)


def entry(inputs: int, width: int, norm: Norm) -> list[nn.Module]:
    """First layers of every branch: (B, inputs, H, W) -> (B, width, H, W)."""
    return [Padding(3), nn.Conv2d(inputs, width, 7), norm(width), nn.ReLU(inplace=True)]


def resizings(layer: type[Halving | Doubling], widths: Sequence[int], norm: Norm) -> list[nn.Module]:
    """Layers to halve or to double the image from each of `widths` to the next."""
    pairs = zip(widths, widths[1:], strict=False)
    return [part for pair in pairs for part in (layer(*pair), norm(pair[1]), nn.ReLU(inplace=True))]


def residuals(number: int, width: int, norm: Norm) -> list[nn.Module]:
    """Residual blocks, one after another."""
    return [Residual(width, norm) for _ in range(number)]


def head(width: int, outputs: int, *activation: nn.Module) -> nn.Sequential:
    """Last layers of a branch: (B, width, H, W) -> (B, outputs, H, W)."""
    return nn.Sequential(Padding(3), nn.Conv2d(width, outputs, 7), *activation)


def halved(image: Tensor, all_around: bool = False) -> Tensor:
    """The next coarser level of a pyramid, means over 3x3 pixels: (B, C, H, W) -> (B, C, H/2, W/2), rounded up.

    all_around  the image closes in azimuth; its W must be even.
    """
    if not all_around:
        return avg_pool2d(image, 3, stride=2, padding=1, count_include_pad=False)
    wrapped = torch.cat([image[..., -1:], image], 3)  # stride 2 never reads past the right edge
    return avg_pool2d(wrapped, 3, stride=2, padding=(1, 0), count_include_pad=False)


def close(network: nn.Module, whether: bool) -> None:
    """Let the images of a network of these parts close in azimuth, or not; its weights do not change."""
    for part in network.modules():
        if isinstance(part, Closable):
            part.closed = whether


@torch.no_grad()
def start_as_published(network: nn.Module) -> None:
    """Draw weights as the published code does: convolutions N(0, 0.02), norms' scales N(1, 0.02), no norm shift."""
    for part in network.modules():
        if isinstance(part, nn.Conv2d | nn.ConvTranspose2d):
            nn.init.normal_(part.weight, 0.0, 0.02)
        elif isinstance(part, _BatchNorm):
            nn.init.normal_(part.weight, 1.0, 0.02)
            nn.init.zeros_(part.bias)
