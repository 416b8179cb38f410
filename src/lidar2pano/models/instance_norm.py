"""Instance norm whose gradient is right in every memory layout."""

from __future__ import annotations

import torch
from torch import Tensor, nn


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
