"""Results that links point to: a few, for a few minutes, in memory."""

from __future__ import annotations

import secrets
import time
from collections import OrderedDict
from collections.abc import Callable

from lidar2pano.serve.limits import Limits
from lidar2pano.serve.translation import Result


class KeptResults:
    """Results under names that cannot be guessed; the oldest goes when there are too many or it is too old."""

    def __init__(self, limits: Limits, clock: Callable[[], float] = time.monotonic) -> None:
        self._limits, self._clock = limits, clock
        self._kept: OrderedDict[str, tuple[float, Result]] = OrderedDict()

    def keep(self, result: Result) -> str:
        """Keep a result; its name."""
        name = secrets.token_urlsafe(16)
        self._kept[name] = (self._clock(), result)
        while len(self._kept) > self._limits.kept:
            self._kept.popitem(last=False)
        return name

    def get(self, name: str) -> Result | None:
        """The result of this name, None where there is none (any more)."""
        oldest = self._clock() - self._limits.kept_seconds
        while self._kept and next(iter(self._kept.values()))[0] < oldest:
            self._kept.popitem(last=False)
        kept = self._kept.get(name)
        return kept and kept[1]
