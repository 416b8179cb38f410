"""Named random streams: every part of the world draws from its own, so that no part's draws move another's."""

from __future__ import annotations

import hashlib

import numpy as np


def stream(seed: int, *names: str | int) -> np.random.Generator:
    """The generator that belongs to a seed and a path of names, e.g. stream(7, "block", 3, "trees")."""
    path = "/".join(str(name) for name in (seed, *names))
    return np.random.default_rng(np.frombuffer(hashlib.sha256(path.encode()).digest(), dtype=np.uint32))


def chosen(rng: np.random.Generator, weights: dict[str, float]) -> str:
    """One of the names, by weight."""
    names, shares = list(weights), np.array(list(weights.values()))
    return names[int(rng.choice(len(names), p=shares / shares.sum()))]
