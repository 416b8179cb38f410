"""Figures that follow from sums over frames: every frame's own sums are kept until the end.

So the answer is the same, to the last bit, in whatever order and on however many processes the frames were counted;
a frame counted twice is seen; the worst frames can be named; and `bootstrap` can draw frames anew.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Self

import numpy as np


class FrameMetric(ABC):
    """What all metrics of this kind share; a subclass has an `update`, which keeps a row of sums under a frame's name.

    columns  the names of the sums.
    rows     frame name -> (S,) float64.
    """

    columns: tuple[str, ...]

    def __init__(self, *columns: str) -> None:
        self.columns = columns
        self.rows: dict[str, np.ndarray] = {}

    @abstractmethod
    def figures_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """Figures, each (...), that follow from sums (..., S) float64; the leading one first; NaN where undefined."""

    def merge(self, other: Self) -> None:
        """Take in another part of the split; ValueError when it counts something else or has a frame of ours."""
        if type(self) is not type(other) or self._counted() != other._counted():
            raise ValueError(f"{self!r} and {other!r} do not count the same")
        if twice := self.rows.keys() & other.rows.keys():
            raise ValueError(f"frame {min(twice)!r} was counted twice")
        self.rows.update(other.rows)

    def __iadd__(self, other: Self) -> Self:
        """The same as merge."""
        self.merge(other)
        return self

    def table(self) -> tuple[list[str], np.ndarray]:
        """Names of the frames in order, and their sums (F, S) float64."""
        names = sorted(self.rows)
        return names, np.array([self.rows[name] for name in names]).reshape(len(names), len(self.columns))

    def figures(self) -> dict[str, float]:
        """Every figure over all frames; NaN where nothing was counted."""
        return {name: float(value) for name, value in self._figures(self.table()[1].sum(0)).items()}

    def compute(self) -> float:
        """The leading figure over all frames; NaN where nothing was counted."""
        return next(iter(self.figures().values()))

    def per_frame(self, figure: str | None = None) -> dict[str, float]:
        """A figure (the leading one when None) of each frame alone, by name."""
        names, sums = self.table()
        values = self._figures(sums)
        chosen = values[figure] if figure is not None else next(iter(values.values()))
        return dict(zip(names, chosen.tolist(), strict=True))

    def state(self) -> dict[str, Any]:
        """Everything counted, as plain lists and one array: for a file or another process."""
        names, sums = self.table()
        return {"counted": self._counted(), "names": names, "sums": sums}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Take the place of what was counted; ValueError when the state is of another metric."""
        if state["counted"] != self._counted():
            raise ValueError(f"a state of {state['counted']} is none of {self!r}")
        self.rows = dict(zip(state["names"], np.asarray(state["sums"], dtype=np.float64), strict=True))

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.rows)

    def __repr__(self) -> str:
        """What it is and how many frames it has seen."""
        return f"{type(self).__name__}({len(self)} frames)"

    def _counted(self) -> tuple:
        """What must be equal for counts to be added; a subclass with settings appends them."""
        return type(self).__name__, self.columns

    def _figures(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.figures_of(sums)

    def _keep(self, name: str, *sums: float) -> None:
        """Keep a frame's row; ValueError when the frame is there already or a sum is not finite."""
        if name in self.rows:
            raise ValueError(f"frame {name!r} was counted twice")
        row = np.array(sums, dtype=np.float64)
        if not np.isfinite(row).all():
            raise ValueError(f"frame {name!r}: {dict(zip(self.columns, sums, strict=True))} is not finite")
        self.rows[name] = row
