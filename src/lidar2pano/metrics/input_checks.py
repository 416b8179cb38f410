"""Checks of the inputs of metrics: images, masks, quantities."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

Array = Tensor | np.ndarray


def as_tensor(values: Array) -> Tensor:
    """Return the same values as a tensor on the CPU.

    An array beyond torch's sharing (read-only, as from Pillow, or with negative strides) is copied.
    """
    if isinstance(values, np.ndarray) and (not values.flags.writeable or min(values.strides, default=0) < 0):
        values = values.copy()
    return torch.as_tensor(values).cpu()


def image_tensor(values: Array, name: str = "an image") -> Tensor:
    """Return an image (H, W, 3) uint8 RGB as a tensor (3, H, W) uint8; ValueError with the name otherwise."""
    tensor = as_tensor(values)
    if tensor.dtype != torch.uint8 or tensor.ndim != 3 or tensor.shape[2] != 3 or not tensor.numel():
        raise ValueError(f"{name} must be (H, W, 3) uint8, not {tuple(tensor.shape)} {tensor.dtype}")
    return tensor.movedim(2, 0)


def image_pair(predicted: Array, target: Array) -> tuple[Tensor, Tensor]:
    """Return two images of one size, each (3, H, W) uint8; ValueError otherwise."""
    first, second = image_tensor(predicted, "the predicted image"), image_tensor(target, "the target image")
    if first.shape != second.shape:
        raise ValueError(f"predicted {tuple(first.shape[1:])} and target {tuple(second.shape[1:])} differ in shape")
    return first, second


def mask_tensor(values: Array | None, shape: tuple[int, ...] | torch.Size, name: str) -> Tensor | None:
    """Return a mask of this shape as a bool tensor; None stays None; ValueError otherwise."""
    if values is None:
        return None
    tensor = as_tensor(values)
    if tensor.dtype != torch.bool or tensor.shape != tuple(shape):
        raise ValueError(f"{name} must be {tuple(shape)} bool, not {tuple(tensor.shape)} {tensor.dtype}")
    return tensor


def finite(values: Tensor, name: str) -> Tensor:
    """Return the values as float64; ValueError when one is NaN or infinite."""
    values = values.double()
    if not values.isfinite().all():
        raise ValueError(f"{name} has values that are NaN or infinite")
    return values
