"""Time in a run: the clock that counts all sittings, what is due when, and the wish to stop."""

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


def every(minutes: float, now: float) -> Callable[[float], bool]:
    """Whether `minutes` have passed since the last time that the answer was yes (or since `now`); 0 = never.

    It is asked with the run's clock in seconds, so that all processes that agree on the clock get one answer.
    """
    last = now

    def due(seconds: float) -> bool:
        nonlocal last
        if minutes <= 0 or seconds - last < 60 * minutes:
            return False
        last = seconds
        return True

    return due


@contextmanager
def interrupts() -> Iterator[Callable[[], bool]]:
    """Inside, the first Ctrl-C or SIGTERM is only noted (asked by the value); the second raises KeyboardInterrupt.

    Signals reach the main thread only; in another one nothing is noted.
    """
    seen: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return

    def note(number: int, _: object) -> None:
        if seen:
            raise KeyboardInterrupt
        seen.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(seen)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
