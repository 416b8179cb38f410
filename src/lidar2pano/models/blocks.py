"""Layers that torch lacks: pictures that close in azimuth, inputs in parts, an instance norm with right gradients.

A panorama's last column meets its first. Images that follow one another in channels are convolved one by one and
added, as engines do while they convolve: to copy them into one takes longer.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d
from torch.nn.utils.fusion import fuse_conv_bn_eval

from lidar2pano.geometry.odds import likeliest


def closed(x: Tensor, reach: int, before: int = 0) -> Tensor:
    """(B, C, H, W) with `reach` columns of the other end at each side: (B, C, H, W + 2 reach).

    before  how many such columns the image has at each side already.
    """
    if not reach:
        return x
    if x.requires_grad and torch.is_grad_enabled() and not torch.compiler.is_compiling():
        return _Closed.apply(x, reach, before)  # pyright: ignore[reportReturnType]
    left, right = _ends(x, reach, before)
    return torch.cat([left, x, right], dim=3)


def _ends(x: Tensor, reach: int, before: int) -> tuple[Tensor, Tensor]:
    """The columns that `closed` puts to the left and to the right of an image."""
    first = x.shape[3] - reach - 2 * before
    return x[..., first : first + reach], x[..., 2 * before : 2 * before + reach]


class _Closed(torch.autograd.Function):
    """`closed` for training: the gradient of each slice would be a whole image, a fifth of a painter's step."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, reach: int, before: int) -> Tensor:  # noqa: ANN401
        ctx.columns = reach, before
        return closed(x, reach, before)  # no gradients are recorded in here

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:  # noqa: ANN401
        (grad,), (reach, before) = grads, ctx.columns
        inner = grad[..., reach:-reach].clone()
        left, right = _ends(inner, reach, before)
        left += grad[..., :reach]
        right += grad[..., -reach:]
        return inner, None, None


class CircularConv(nn.Conv2d):
    """A convolution of odd kernel that pads circularly in azimuth: (B, inputs, H, W) -> (B, outputs, H/s, W/s)."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, *, stride: int = 1, dilation: int = 1) -> None:
        super().__init__(inputs, outputs, kernel, stride=stride, dilation=dilation)
        self.reach = dilation * (kernel // 2)

    def forward(self, *parts: Tensor, has_ends: bool = False) -> Tensor:
        """Convolve with rows padded by zeros and columns by those of the other end.

        parts     (B, inputs, H, W), or such images of fewer channels each, which together are the inputs.
        has_ends  whether they are `closed` already, so that none has to be copied: what comes out of a convolution of
                  stride 1 has as many columns less its reach at either side.
        """
        reach, stride = self.reach, self.stride[0]
        if has_ends:
            return summed(self, parts, (reach, 0))
        if reach and stride == 1 and not torch.is_grad_enabled() and parts[0].shape[3] >= 2 * reach:
            return self._mended(parts)
        return summed(self, [closed(part, reach) for part in parts], (reach, 0))

    def _mended(self, parts: Sequence[Tensor]) -> Tensor:
        """The same without a copy of the whole picture: only what lies next to the seam is done again, closed."""
        reach = self.reach
        answer = summed(self, parts, (reach, reach))
        ends = [torch.cat([part[..., -2 * reach :], part[..., : 2 * reach]], dim=3) for part in parts]
        seam = summed(self, ends, (reach, 0))
        answer[..., -reach:], answer[..., :reach] = seam[..., :reach], seam[..., reach:]
        return answer


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
        """x + what the two convolutions add, activated."""
        return self.act(x + self.second(self.dropout(self.first(x))))


def grow_circular(x: Tensor, factor: int) -> Tensor:
    """Enlarge (B, C, H, W) bilinearly by a whole factor; columns interpolate across the seam."""
    grown = nn.functional.interpolate(closed(x, 1), scale_factor=factor, mode="bilinear", align_corners=False)
    return grown[..., factor:-factor]


def grown_classes(logits: Tensor, factor: int, chunk: int = 1 << 14, least: float = 0) -> Tensor:
    """The classes (H * factor, W * factor) uint8 that logits (1, C, H, W) name once `grow_circular` has enlarged them.

    Only where a neighbour is of another class are logits enlarged: means of logits that name one class name it, too.
    chunk  pixels for which that is done at a time: a small piece stays in the processor's cache.
    least  not 0: instead of logits there are probabilities, of whose logarithms none is below that of `least`.
    """
    height, width = logits.shape[2:]
    ids = likeliest(logits)[0]
    ids = torch.cat([ids[:1], ids, ids[-1:]])
    beside = ids.roll(-1, 1)
    border = (ids[:-1] != ids[1:]) | (ids[:-1] != beside[:-1]) | (ids[:-1] != beside[1:])  # between four pixels
    grown = ids[:, None, :, None].repeat(1, factor, 1, factor)
    pixels, places = logits[0].flatten(1), _between_two(factor)
    for row, column in zip(*(part.split(chunk) for part in border.nonzero(as_tuple=True)), strict=True):
        rows = [(row + step).clamp(0, height - 1) * width for step in (-1, 0)]
        columns = column, (column + 1) % width
        around = pixels.index_select(1, torch.cat([one + other for one, other in product(rows, columns)])).float()
        around = around.clamp_(min=least).log_() if least else around
        upper, lower = around.unflatten(1, (2, 2, -1)).unbind(1)
        for down, i, share in places:
            left, right = torch.lerp(upper, lower, share).unbind(1)
            for across, j, part in places:
                grown[row + down, i, columns[across], j] = likeliest(torch.lerp(left, right, part)[None, :, None])[0, 0]
    return grown[1:-1].reshape(height * factor, width * factor)


def _between_two(factor: int) -> list[tuple[int, int, float]]:
    """What lies from one pixel's middle to the next one's, enlarged: of which (0, 1), its number there, how far on."""
    shares = [(place + 0.5) / factor - 0.5 for place in range(factor)]  # of the pixel before (below 0) or after
    return [(int(share < 0), place, share % 1) for place, share in enumerate(shares)]


def fold_norms(network: nn.Module) -> nn.Module:
    """Fold batch norms that follow a convolution into it, in place; for networks in evaluation mode."""
    for block in network.modules():
        if not isinstance(block, nn.Sequential):
            continue
        for place in range(len(block) - 1):
            conv, norm = block[place], block[place + 1]
            if isinstance(conv, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                block[place], block[place + 1] = fuse_conv_bn_eval(conv, norm), nn.Identity()
    return network


Pixels = tuple[int, int]


def summed(conv: nn.Conv2d, parts: Sequence[Tensor], padding: Pixels) -> Tensor:
    """What `conv` makes of parts (B, c, H, W) that together are its inputs, with zeros around: rows, columns."""
    weights = conv.weight.split([part.shape[1] for part in parts], 1)
    stride, dilation = cast(Pixels, conv.stride), cast(Pixels, conv.dilation)
    answer = conv2d(parts[0], weights[0], conv.bias, stride, padding, dilation)
    for part, weight in zip(parts[1:], weights[1:], strict=True):
        one = conv2d(part, weight, None, stride, padding, dilation)
        answer = answer + one if torch.is_grad_enabled() else answer.add_(one)
    return answer


class SummedConv2d(nn.Conv2d):
    """A convolution whose input may come in parts."""

    def forward(self, *parts: Tensor) -> Tensor:
        """(B, inputs, H, W), or images of fewer channels each, together the inputs -> (B, outputs, H, W)."""
        return summed(self, parts, cast(Pixels, self.padding))


class SummedSequential(nn.Sequential):
    """Layers of which the first is such a convolution, or begins with one."""

    def forward(self, *parts: Tensor, **how: bool) -> Tensor:
        """What the last layer makes of it; arguments as the first one takes them."""
        first, *others = self
        x = first(*parts, **how)
        for layer in others:
            x = layer(x)
        return x


class InstanceNorm(nn.InstanceNorm2d):
    """torch's instance norm, (B, C, H, W) -> the same shape.

    On CPUs torch (2.13 and before) reads a channels-last gradient of a batch of one as if it were contiguous, so that
    every gradient before the norm is noise. Here gradients reach torch's norm contiguous. What torch.compile makes of
    the norm is right by itself.
    """

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002 torch's name
        """(B, C, H, W) -> the same shape."""
        out = super().forward(input)
        if out.requires_grad and not torch.compiler.is_compiling():
            out.register_hook(Tensor.contiguous)
        return out
