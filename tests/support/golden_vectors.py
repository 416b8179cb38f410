"""Recorded tensors of the published networks and operators, whole or sampled at positions of a fixed rule."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from torch import Tensor

from golden_fill import unit


def positions(file: str, tensor: str, rule: Mapping[str, Any]) -> Tensor:
    """Sorted flat indices, int64, of the sampled elements; `rule` has the shape and how many draws are made.

    Draw i is floor(numel * u("<file>/<tensor>", i)) with the fill rule's u; what is drawn twice is kept once.
    """
    drawn = torch.Size(rule["shape"]).numel() * torch.from_numpy(unit(f"{file}/{tensor}", rule["samples"]))
    return drawn.long().unique()


@dataclass(frozen=True)
class Recorded:
    """A recorded tensor.

    shape   of the whole tensor.
    values  the recorded elements: (K,) at the flat indices `index`, or the whole tensor where `index` is None.
    """

    shape: tuple[int, ...]
    values: Tensor
    index: Tensor | None = None

    def of(self, tensor: Tensor) -> Tensor:
        """The elements of `tensor`, which must have the recorded shape, that `values` is to be compared with."""
        assert tuple(tensor.shape) == self.shape
        return tensor if self.index is None else tensor.flatten()[self.index]

    def assert_close(self, tensor: Tensor, atol: float, what: str = "") -> None:
        """`tensor` has the recorded shape and type, and differs from the recorded values by `atol` at most."""
        torch.testing.assert_close(self.of(tensor), self.values, atol=atol, rtol=0, msg=lambda text: f"{what} {text}")

    def deviation(self, tensor: Tensor) -> float:
        """The largest absolute difference between `tensor` and the recorded values."""
        return (self.of(tensor) - self.values).abs().max().item()


def facts(folder: Path, file: str) -> dict[str, Any]:
    """What `<folder>/<file>.safetensors` records beside its tensors."""
    with safe_open(folder / f"{file}.safetensors", "pt") as stored:
        metadata = stored.metadata() or {}
    return (
        json.loads(metadata["facts"]) if "facts" in metadata else {key: json.loads(metadata[key]) for key in metadata}
    )


def recorded(folder: Path, file: str) -> dict[str, Recorded]:
    """All tensors of `<folder>/<file>.safetensors`; the folder may be tests/golden or the one it was made from."""
    sampled, found = facts(folder, file).get("sampled", {}), {}
    with safe_open(folder / f"{file}.safetensors", "pt") as stored:
        for name in stored.keys():  # noqa: SIM118 - no dictionary
            values = stored.get_tensor(name)
            shape = tuple(sampled[name]["shape"]) if name in sampled else tuple(values.shape)
            index = positions(file, name, sampled[name]) if name in sampled else None
            found[name] = Recorded(shape, values, index)
    return found
