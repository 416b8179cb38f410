"""Named random streams: each part of the world has its own generator, so that no part's draws change another's."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

T = TypeVar("T")


def stream(seed: int, *names: str | int) -> np.random.Generator:
    """The generator of a seed and a path of names, e.g. stream(7, "block", 3, "trees")."""
    path = "/".join(str(name) for name in (seed, *names))
    return np.random.default_rng(np.frombuffer(hashlib.sha256(path.encode()).digest(), dtype=np.uint32))


def weighted_choice(rng: np.random.Generator, weights: dict[str, float]) -> str:
    """One of the names, with probability proportional to its weight."""
    names, shares = list(weights), np.array(list(weights.values()))
    return names[int(rng.choice(len(names), p=shares / shares.sum()))]


def pick(rng: np.random.Generator, choices: Sequence[T], p: Sequence[float] | None = None) -> T:
    """One of the choices, each with the same probability or with those of `p`, which add up to 1."""
    return choices[int(rng.integers(len(choices)) if p is None else rng.choice(len(choices), p=p))]
