"""The rule that fills every weight and input of the golden vectors; the golden folder's MANIFEST.md, section 1."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor


def unit(key: str, count: int) -> np.ndarray:
    """(count,) float64 in [0, 1): u(key, 0..count-1), exact integer arithmetic modulo 2^32."""
    h = np.arange(count, dtype=np.uint32) * np.uint32(0x9E3779B1) + np.uint32(zlib.crc32(key.encode()))
    h = (h ^ (h >> np.uint32(16))) * np.uint32(0x85EBCA6B)
    h = (h ^ (h >> np.uint32(13))) * np.uint32(0xC2B2AE35)
    return (h ^ (h >> np.uint32(16))) / 2.0**32


def sym(key: str, shape: tuple[int, ...], reach: float = 1.0) -> Tensor:
    """Float32 in [-reach, reach) of `shape`."""
    return torch.from_numpy((reach * (2 * unit(key, int(np.prod(shape))) - 1)).astype(np.float32).reshape(shape))


def randint(key: str, shape: tuple[int, ...], count: int) -> Tensor:
    """Int64 in [0, count) of `shape`."""
    return torch.from_numpy(np.floor(count * unit(key, int(np.prod(shape)))).astype(np.int64).reshape(shape))


def one_hot(labels: Tensor, classes: int) -> Tensor:
    """(B, H, W) int64 -> (B, classes, H, W) float32."""
    return torch.nn.functional.one_hot(labels, classes).permute(0, 3, 1, 2).float().contiguous()


def fill(state: Mapping[str, Tensor], gain: float) -> dict[str, Tensor]:
    """A state dict of the same keys and shapes, filled by the rule."""
    return {key: _entry(key, tuple(old.shape), gain) for key, old in state.items()}


def _entry(key: str, shape: tuple[int, ...], gain: float) -> Tensor:
    if key.endswith("num_batches_tracked"):
        return torch.zeros(shape, dtype=torch.int64)
    u = unit(key, int(np.prod(shape)))
    if key.endswith("running_mean"):
        values = 0.1 * (2 * u - 1)
    elif key.endswith("running_var"):
        values = 1 + 0.5 * u
    elif len(shape) > 1:
        values = gain * np.sqrt(3 * shape[0] / u.size) * (2 * u - 1)
    elif key.endswith("weight"):
        values = 1 + 0.1 * (2 * u - 1)
    else:
        values = 0.05 * (2 * u - 1)
    return torch.from_numpy(values.astype(np.float32).reshape(shape))


def key_rows(golden: Path, name: str) -> list[list[str]]:
    """Rows of a table of keys: key, shape, dtype, sum, first element."""
    return [line.split("\t") for line in (golden / f"{name}.keys.txt").read_text().splitlines()[2:]]


def assert_filled_as_recorded(state: Mapping[str, Tensor], rows: list[list[str]]) -> None:
    """Every row's tensor has its shape, type, sum and first element."""
    for key, shape, dtype, total, first in rows:
        tensor = state[key]
        assert (list(tensor.shape), str(tensor.dtype)) == (json.loads(shape), f"torch.{dtype}"), key
        assert tensor.double().sum().item() == pytest.approx(float(total), abs=1e-6, rel=1e-8), key
        assert tensor.flatten()[0].item() == pytest.approx(float(first), rel=1e-6), key
