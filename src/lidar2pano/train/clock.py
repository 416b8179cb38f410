"""Time in a run: the clock that counts all sittings, what is due when, and interrupts."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


def clock(used: float) -> Callable[[], float]:
    """Seconds of wall clock from now on, plus those `used` in earlier sittings."""
    began = time.monotonic()
    return lambda: used + time.monotonic() - began


class Timer:
    """When something that is repeated is due: `minutes` after it last ended (or after `now`); 0 = never.

    Where it takes longer than `share` of the time, the pauses grow until it does not. All times are the run's clock in
    seconds, so that processes that agree on the clock agree on what is due.
    """

    def __init__(self, minutes: float, now: float, share: float = 1.0) -> None:
        self.least, self.pause, self.last, self.share = 60 * minutes, 60 * minutes, now, share

    def due(self, now: float) -> bool:
        """Whether it is to be done now."""
        return self.least > 0 and now - self.last >= self.pause

    def done(self, began: float, ended: float) -> None:
        """Note that it was done."""
        self.last, self.pause = ended, max(self.least, (ended - began) * (1 / self.share - 1))


@contextmanager
def interrupts() -> Iterator[Callable[[], bool]]:
    """Inside, the first Ctrl-C or SIGTERM makes the value return True; the second raises KeyboardInterrupt.

    Signals reach the main thread only; in another one nothing is noted.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return

    def note(number: int, _: object) -> None:
        if received:
            raise KeyboardInterrupt
        received.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
