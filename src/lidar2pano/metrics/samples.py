"""Two sets of pictures of which something is kept for every picture: the painted ones and the true ones."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Self

import numpy as np

SIDES = ("predicted", "target")


class TwoSets(ABC):
    """For every picture of each side its own array, all of one shape, by name; a distance follows from all of them.

    What follows is the same, to the last bit, in whatever order and on however many processes the pictures were
    taken in: they are put into the order of their names first. A picture taken in twice is seen.
    kept  side -> name -> array.
    """

    def __init__(self) -> None:
        self.kept: dict[str, dict[str, np.ndarray]] = {side: {} for side in SIDES}

    @abstractmethod
    def figures(self) -> dict[str, float]:
        """Every figure, the leading one first; NaN where there are too few pictures."""

    def compute(self) -> float:
        """The leading figure; NaN where there are too few pictures."""
        return next(iter(self.figures().values()))

    def merge(self, other: Self) -> None:
        """Take in another part; ValueError when it is of something else or has a picture of ours."""
        if type(self) is not type(other) or self._counted() != other._counted():
            raise ValueError(f"{self!r} and {other!r} do not count the same")
        for side in SIDES:
            if twice := self.kept[side].keys() & other.kept[side].keys():
                raise ValueError(f"{side} picture {min(twice)!r} was taken in twice")
        for side in SIDES:
            self.kept[side].update(other.kept[side])

    def __iadd__(self, other: Self) -> Self:
        """The same as merge."""
        self.merge(other)
        return self

    def state(self) -> dict[str, Any]:
        """Everything kept, as plain lists and an array per side: for a file or another process."""
        sides = {side: {"names": sorted(self.kept[side]), "arrays": self._stacked(side)} for side in SIDES}
        return {"counted": self._counted(), **sides}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Take the place of what was kept; ValueError when the state is of another metric."""
        if state["counted"] != self._counted():
            raise ValueError(f"a state of {state['counted']} is none of {self!r}")
        for side in SIDES:
            self.kept[side] = dict(zip(state[side]["names"], state[side]["arrays"], strict=True))

    def __len__(self) -> int:
        """Number of predicted pictures."""
        return len(self.kept["predicted"])

    def __repr__(self) -> str:
        """What it is and how many pictures it has seen."""
        return f"{type(self).__name__}({len(self)} predicted, {len(self.kept['target'])} target)"

    def _counted(self) -> tuple:
        """What must be equal for two parts to be one; a subclass with settings appends them."""
        return (type(self).__name__,)

    def _check_new(self, name: str, side: str) -> None:
        if side not in SIDES:
            raise ValueError(f"a picture is {' or '.join(SIDES)}, not {side!r}")
        if name in self.kept[side]:
            raise ValueError(f"{side} picture {name!r} was taken in twice")

    def _stacked(self, side: str) -> np.ndarray:
        """(pictures, ...) in the order of their names; (0,) when there is none."""
        kept = self.kept[side]
        return np.stack([kept[name] for name in sorted(kept)]) if kept else np.zeros(0, dtype=np.float32)
