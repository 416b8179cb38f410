"""Layers beyond torch's: pictures closed in azimuth, inputs in parts, an instance norm with right gradients.

A panorama's last column meets its first. Images one after another in channels are convolved one by one and
added, as engines do while they convolve: to copy them into one takes longer.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d
from torch.nn.utils.fusion import fuse_conv_bn_eval

from lidar2pano.errors import InputError
from lidar2pano.geometry.rasters import pad_azimuth

LARGE = 1 << 22  # numbers in an image from which on a copy of it takes longer than a second convolution at the seam


def check_size(image: Tensor, divisor: int, noun: str, least: int = 1) -> None:
    """Raise InputError, with a noun for the image (..., H, W), unless its rows and columns divide by a number.

    least  how often, at the least.
    """
    rows, columns = image.shape[-2:]
    fitting = [max(least, -(-pixels // divisor)) * divisor for pixels in (rows, columns)]
    if [rows, columns] != fitting:
        raise InputError(
            f"{noun} of {rows} x {columns} pixels: rows, columns must divide by {divisor}; pad it to {fitting[0]} x"
            f" {fitting[1]}"
        )


class CircularConv(nn.Conv2d):
    """A convolution of odd kernel, padded circularly in azimuth: (B, inputs, H, W) -> (B, outputs, H/s, W/s)."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, *, stride: int = 1, dilation: int = 1) -> None:
        super().__init__(inputs, outputs, kernel, stride=stride, dilation=dilation)
        self.reach = dilation * (kernel // 2)

    def forward(self, *parts: Tensor, has_ends: bool = False) -> Tensor:
        """Convolve with rows padded by zeros and columns by those of the other end.

        parts     (B, inputs, H, W), or such images of fewer channels each, together the inputs.
        has_ends  whether they are padded by `pad_azimuth` already, to spare a copy: the output of a
                  convolution of stride 1 has its reach fewer columns at either side.
        """
        reach, stride = self.reach, self.stride[0]
        if has_ends:
            return summed(self, parts, (reach, 0))
        large = sum(part.shape[1:].numel() for part in parts) > LARGE and parts[0].shape[3] >= 2 * reach
        if reach and stride == 1 and large and not torch.is_grad_enabled():
            return self._mended(parts)
        return summed(self, [pad_azimuth(part, reach) for part in parts], (reach, 0))

    def _mended(self, parts: Sequence[Tensor]) -> Tensor:
        """Convolve without a copy of the whole picture: only the columns next to the seam are done again, padded."""
        reach = self.reach
        answer = summed(self, parts, (reach, reach))
        ends = [torch.cat([part[..., -2 * reach :], part[..., : 2 * reach]], dim=3) for part in parts]
        seam = torch.arange(-reach, reach, device=answer.device) % answer.shape[3]
        return answer.index_copy_(3, seam, summed(self, ends, (reach, 0)))


def conv_norm_act(
    inputs: int, outputs: int, kernel: int = 3, *, stride: int = 1, dilation: int = 1
) -> SummedSequential:
    """Circular convolution, batch norm, leaky ReLU."""
    return SummedSequential(
        CircularConv(inputs, outputs, kernel, stride=stride, dilation=dilation),
        nn.BatchNorm2d(outputs),
        nn.LeakyReLU(0.1, inplace=True),
    )


class CircularResidual(nn.Module):
    """Two 3x3 convolutions around a shortcut: (B, channels, H, W) -> the same shape."""

    def __init__(self, channels: int, dilation: int = 1, dropout: float = 0.0) -> None:
        super().__init__()
        self.first = conv_norm_act(channels, channels, dilation=dilation)
        self.dropout = nn.Dropout2d(dropout)
        self.second = nn.Sequential(CircularConv(channels, channels), nn.BatchNorm2d(channels))
        self.act = nn.LeakyReLU(0.1)

    def forward(self, x: Tensor) -> Tensor:
        """Add the two convolutions to x, and activate."""
        return self.act(x + self.second(self.dropout(self.first(x))))


def fold_norms(network: nn.Module) -> nn.Module:
    """Fold batch norms into the convolutions right before them, and drop dropout, in place; for evaluation mode."""
    for block in list(network.modules()):
        last, conv = "", None
        for name, part in list(block.named_children()):
            if isinstance(part, nn.Dropout2d):
                setattr(block, name, nn.Identity())
            if isinstance(conv, nn.Conv2d) and isinstance(part, nn.BatchNorm2d):
                setattr(block, last, fuse_conv_bn_eval(conv, part))
                setattr(block, name, nn.Identity())
            last, conv = name, part
    return network


Pixels = tuple[int, int]


def summed(conv: nn.Conv2d, parts: Sequence[Tensor], padding: Pixels) -> Tensor:
    """Convolve parts (B, c, H, W) that together are the inputs of `conv`, padded by zeros: rows, columns."""
    stride, dilation = cast(Pixels, conv.stride), cast(Pixels, conv.dilation)
    if len(parts) == 1:
        return conv2d(parts[0], conv.weight, conv.bias, stride, padding, dilation)
    weights = conv.weight.split([part.shape[1] for part in parts], 1)
    answer = conv2d(parts[0], weights[0], conv.bias, stride, padding, dilation)
    for part, weight in zip(parts[1:], weights[1:], strict=True):
        term = conv2d(part, weight, None, stride, padding, dilation)
        answer = answer + term if torch.is_grad_enabled() else answer.add_(term)
    return answer


class SummedConv2d(nn.Conv2d):
    """A convolution whose input may come in parts."""

    def forward(self, *parts: Tensor) -> Tensor:
        """(B, inputs, H, W), or images of fewer channels each, together the inputs -> (B, outputs, H, W)."""
        return summed(self, parts, cast(Pixels, self.padding))


class SummedSequential(nn.Sequential):
    """Layers with such a convolution in the first place, or at the beginning of the first layer."""

    def forward(self, *parts: Tensor, **how: bool) -> Tensor:
        """What the last layer makes of it; arguments as the first one takes them."""
        first, *rest = self
        x = first(*parts, **how)
        for layer in rest:
            x = layer(x)
        return x


class InstanceNorm(nn.InstanceNorm2d):
    """torch's instance norm, (B, C, H, W) -> the same shape.

    On CPUs torch (2.13 and before) reads a channels-last gradient of a batch of one as if it were contiguous: every
    gradient before the norm is noise. Here gradients reach torch's norm contiguous. The norm compiled by torch.compile
    is right by itself.
    """

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002 torch's name
        """(B, C, H, W) -> the same shape."""
        out = super().forward(input)
        if out.requires_grad and not torch.compiler.is_compiling():
            out.register_hook(Tensor.contiguous)
        return out
