"""Convolutions of images that follow one another in channels, as the sum of each one's own.

Engines add while they convolve; to copy the images into one takes longer.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d

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
