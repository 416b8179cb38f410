"""Checks of what metrics are given: images, masks, quantities."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

Array = Tensor | np.ndarray


def as_tensor(values: Array) -> Tensor:
    """The same values as a tensor on the CPU.

    An array that torch cannot share (read-only, as Pillow gives it, or with negative strides) is copied.
    """
    if isinstance(values, np.ndarray) and (not values.flags.writeable or min(values.strides, default=0) < 0):
        values = values.copy()
    return torch.as_tensor(values).cpu()


def image_tensor(values: Array, what: str = "an image") -> Tensor:
    """An image (H, W, 3) uint8 RGB as a tensor (3, H, W) uint8; ValueError, which begins with `what`, otherwise."""
    tensor = as_tensor(values)
    if tensor.dtype != torch.uint8 or tensor.ndim != 3 or tensor.shape[2] != 3 or not tensor.numel():
        raise ValueError(f"{what} must be (H, W, 3) uint8, not {tuple(tensor.shape)} {tensor.dtype}")
    return tensor.movedim(2, 0)


def image_pair(predicted: Array, target: Array) -> tuple[Tensor, Tensor]:
    """Two images of one size, each (3, H, W) uint8; ValueError otherwise."""
    first, second = image_tensor(predicted, "the predicted image"), image_tensor(target, "the target image")
    if first.shape != second.shape:
        raise ValueError(f"predicted {tuple(first.shape[1:])} and target {tuple(second.shape[1:])} differ in shape")
    return first, second


def mask_tensor(values: Array | None, shape: tuple[int, ...] | torch.Size, what: str) -> Tensor | None:
    """A mask of the given shape as a bool tensor; None stays None; ValueError otherwise."""
    if values is None:
        return None
    tensor = as_tensor(values)
    if tensor.dtype != torch.bool or tensor.shape != tuple(shape):
        raise ValueError(f"{what} must be {tuple(shape)} bool, not {tuple(tensor.shape)} {tensor.dtype}")
    return tensor


def finite(values: Tensor, what: str) -> Tensor:
    """The values as float64; ValueError when one is NaN or infinite."""
    values = values.double()
    if not values.isfinite().all():
        raise ValueError(f"{what} has values that are NaN or infinite")
    return values
