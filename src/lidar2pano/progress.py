"""Long work, announced to whoever shows it: the library names it, the command line draws bars and prints lines."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

Advance = Callable[[], None]
Show = Callable[[int, str], AbstractContextManager[Advance]]

_shows: list[Show] = []  # the last one is told


@contextmanager
def working(title: str, total: int = 0) -> Iterator[Advance]:
    """Announce work of `total` steps, 0 for an unknown number; give a function to call after each."""
    shown = _shows[-1](total, title) if _shows else nullcontext(lambda: None)
    with shown as advance:
        yield advance


@contextmanager
def shown_by(show: Show) -> Iterator[None]:
    """Let `show` (total, title) show the work of the library, of whatever thread, as long as the context lasts."""
    _shows.append(show)
    try:
        yield
    finally:
        _shows.remove(show)
