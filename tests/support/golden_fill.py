"""The rule that fills every weight and input of the golden vectors; see tests/golden/README.md."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

BLOCK = 1 << 16  # elements made at once: they stay in the processor's cache
_STEPS = np.arange(BLOCK, dtype=np.uint32) * np.uint32(0x9E3779B1)


def unit(key: str, count: int) -> np.ndarray:
    """(count,) float64 in [0, 1): u(key, 0..count-1), exact integer arithmetic modulo 2^32."""
    return np.concatenate([np.empty(0), *_blocks(key, count)])


def _blocks(key: str, count: int) -> Iterator[np.ndarray]:
    crc = zlib.crc32(key.encode())
    for first in range(0, count, BLOCK):
        h = _STEPS[: count - first] + np.uint32((first * 0x9E3779B1 + crc) % 2**32)
        h = (h ^ (h >> np.uint32(16))) * np.uint32(0x85EBCA6B)
        h = (h ^ (h >> np.uint32(13))) * np.uint32(0xC2B2AE35)
        yield (h ^ (h >> np.uint32(16))) / 2.0**32


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
    rule, values = _rule(key, shape, gain), np.empty(int(np.prod(shape)), np.float32)
    for number, u in enumerate(_blocks(key, values.size)):
        values[number * BLOCK : number * BLOCK + u.size] = rule(u)
    return torch.from_numpy(values.reshape(shape))


def _rule(key: str, shape: tuple[int, ...], gain: float) -> Callable[[np.ndarray], np.ndarray]:
    """From u to the values of a state-dict entry, both float64."""
    if key.endswith("running_mean"):
        return lambda u: 0.1 * (2 * u - 1)
    if key.endswith("running_var"):
        return lambda u: 1 + 0.5 * u
    if len(shape) > 1:
        bound = gain * np.sqrt(3 * shape[0] / np.prod(shape))
        return lambda u: bound * (2 * u - 1)
    if key.endswith("weight"):
        return lambda u: 1 + 0.1 * (2 * u - 1)
    return lambda u: 0.05 * (2 * u - 1)


def key_rows(golden: Path, name: str) -> list[list[str]]:
    """Rows of a table of keys: key, shape, dtype, sum, first element."""
    return [line.split("\t") for line in (golden / f"{name}.keys.txt").read_text().splitlines()[2:]]


def assert_weights_as_recorded(state: Mapping[str, Tensor], rows: list[list[str]]) -> None:
    """Every row's tensor has its shape, type, sum and first element."""
    for key, shape, dtype, total, first in rows:
        tensor = state[key]
        assert (list(tensor.shape), str(tensor.dtype)) == (json.loads(shape), f"torch.{dtype}"), key
        assert tensor.double().sum().item() == pytest.approx(float(total), abs=1e-6, rel=1e-8), key
        assert tensor.flatten()[0].item() == pytest.approx(float(first), rel=1e-6), key
