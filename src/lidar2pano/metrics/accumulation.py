"""What metrics keep of every frame until the end: one array per frame, in a temporary file, so memory stays bounded.

The result is the same, to the last bit, in whatever order the frames were counted, and a frame that is counted twice is
an error.
"""

from __future__ import annotations

import copy
import hashlib
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, MutableMapping
from typing import ClassVar, Self

import numpy as np

SIDES = ("predicted", "target")


class StoredArrays(MutableMapping[str, np.ndarray]):
    """Arrays of one shape and type by name, in a temporary file (in TMPDIR); memory holds the names only."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 closed with this object
        self._owner: StoredArrays | None = None  # of the file; None: this object
        self._slots: dict[str, int] = {}
        self._free: list[int] = []
        self._blank = np.zeros(0)

    def __del__(self) -> None:
        """Delete the file."""
        if self._owner is None:
            self._file.close()

    def only(self, names: Collection[str]) -> StoredArrays:
        """Those with these names, in the same file; nothing may be stored or deleted as long as it is in use."""
        part = copy.copy(self)
        part._owner, part._slots = self, {name: slot for name, slot in self._slots.items() if name in names}
        return part

    def __setitem__(self, name: str, array: np.ndarray) -> None:
        """Store an array; the first one decides shape and type."""
        if not self._slots:
            self._blank = np.empty_like(array)
        if name not in self._slots:
            self._slots[name] = self._free.pop() if self._free else len(self._slots)
        self._file.seek(self._slots[name] * self._blank.nbytes)
        self._file.write(array.astype(self._blank.dtype).tobytes())

    def __getitem__(self, name: str) -> np.ndarray:
        """A copy of the array."""
        return self.read(name, self._blank.size, 0).reshape(self._blank.shape)

    def __delitem__(self, name: str) -> None:
        """Forget an array; the next one takes its place in the file."""
        self._free.append(self._slots.pop(name))

    def __iter__(self) -> Iterator[str]:
        """Names, in the order in which they were stored."""
        return iter(self._slots)

    def __len__(self) -> int:
        """Number of arrays."""
        return len(self._slots)

    def read(self, name: str, count: int, start: int) -> np.ndarray:
        """`count` successive values of an array, from `start` on."""
        size = self._blank.itemsize
        self._file.seek(self._slots[name] * self._blank.nbytes + start * size)
        return np.frombuffer(self._file.read(count * size), dtype=self._blank.dtype)

    def stacked(self, part: int | None = None) -> np.ndarray:
        """All arrays (N, ...) in the order of their names, or of each the one at index `part`; (0,) for none."""
        if not self._slots:
            return np.zeros(0, dtype=self._blank.dtype)
        shape = self._blank.shape if part is None else self._blank.shape[1:]
        count = int(np.prod(shape))
        found = np.empty((len(self), *shape), dtype=self._blank.dtype)
        for row, name in zip(found, sorted(self._slots), strict=True):
            row[...] = self.read(name, count, count * (part or 0)).reshape(shape)
        return found


class FrameMetric(ABC):
    """A metric whose values follow from sums over frames; `update` of a subclass keeps each frame's sums by name.

    Since each frame's own sums are kept, the worst frames can be named and `bootstrap` can resample the frames.
    sum_names  names of the S sums;  rows: frame name -> (S,) float64.
    """

    def __init__(self, *sum_names: str) -> None:
        self.sum_names = sum_names
        self.rows: MutableMapping[str, np.ndarray] = StoredArrays()

    @abstractmethod
    def values_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """Values by name, each (...), from sums (..., S) float64; the leading one first; NaN where undefined."""

    def sums(self) -> np.ndarray:
        """Sums of the frames (F, S) float64, in the order of the frames' names."""
        assert isinstance(self.rows, StoredArrays)
        return self.rows.stacked().reshape(len(self), len(self.sum_names))

    def values(self) -> dict[str, float]:
        """Every value over all frames; NaN where nothing was counted."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return {name: float(value) for name, value in self.values_of(self.sums().sum(0)).items()}

    def compute(self) -> float:
        """The leading value over all frames; NaN where nothing was counted."""
        return next(iter(self.values().values()))

    def value_of_frame(self, frame: str, name: str) -> float:
        """A value of one frame alone; NaN where it is undefined or the frame was not counted."""
        if frame not in self.rows:
            return float("nan")
        with np.errstate(invalid="ignore", divide="ignore"):
            return float(self.values_of(self.rows[frame])[name])

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.rows)

    def _keep(self, name: str, *sums: float) -> None:
        """Keep a frame's sums; ValueError when the frame was counted before or a sum is not finite."""
        if name in self.rows:
            raise ValueError(f"frame {name!r} was counted twice")
        row = np.array(sums, dtype=np.float64)
        if not np.isfinite(row).all():
            raise ValueError(f"frame {name!r}: {dict(zip(self.sum_names, sums, strict=True))} is not finite")
        self.rows[name] = row


class SetMetric(ABC):
    """A distance between two sets of images, the predicted and the target ones; of each image one array is kept.

    Of more than MOST images of a side a pseudo-random sample of MOST is kept, which depends on nothing but their names.
    kept  side -> image name -> array.
    """

    MOST: ClassVar[int]

    def __init__(self) -> None:
        self.kept = {side: StoredArrays() for side in SIDES}

    @abstractmethod
    def values(self) -> dict[str, float]:
        """Every value, the leading one first; NaN where there are too few images."""

    def compute(self) -> float:
        """The leading value; NaN where there are too few images."""
        return next(iter(self.values().values()))

    def thinned(self) -> Self:
        """A copy whose values cost less and vary more, for intervals; it shares the arrays."""
        return copy.copy(self)

    def groups(self, most: int) -> list[frozenset[str]]:
        """The images' names in up to `most` groups of about equal size, at random but by their names alone."""
        names = sorted(set().union(*self.kept.values()), key=_rank)
        return [frozenset(names[first::most]) for first in range(min(most, len(names)))]

    def without(self, names: frozenset[str]) -> Self:
        """A thinned copy without some images, on both sides."""
        metric = self.thinned()
        metric.kept = {side: arrays.only(arrays.keys() - names) for side, arrays in self.kept.items()}
        return metric

    def __len__(self) -> int:
        """Number of predicted images that are kept."""
        return len(self.kept["predicted"])

    def _makes_room(self, name: str, side: str) -> bool:
        """Whether an image is to be kept, for which another one may have been dropped.

        Raises ValueError for an unknown side, and for an image that is kept already.
        """
        if side not in SIDES:
            raise ValueError(f"an image is {' or '.join(SIDES)}, not {side!r}")
        kept = self.kept[side]
        if name in kept:
            raise ValueError(f"{side} image {name!r} was counted twice")
        if len(kept) < self.MOST:
            return True
        last = max(kept, key=_rank)
        if _rank(name) > _rank(last):
            return False
        del kept[last]
        return True


def _rank(name: str) -> bytes:
    """Where a name comes in a pseudo-random order of all names."""
    return hashlib.sha256(name.encode()).digest()
