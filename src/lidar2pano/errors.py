"""The exception for users' mistakes, the nearest name for an unknown name, and modules that are not there."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Generator, Iterable
from contextlib import contextmanager


class InputError(ValueError):
    """Something from outside (a file, an option, a name) cannot be used.

    The message is one line with the thing, the fault and the remedy; the command line prints it and
    leaves with exit code 2.
    """


@contextmanager
def require_extra(extra: str, purpose: object) -> Generator[None]:
    """Raise InputError in place of ImportError: `purpose` needs libraries of an extra of this package."""
    try:
        yield
    except ImportError as error:
        raise InputError(f"{purpose} needs the extra {extra!r}: pip install 'lidar2pano[{extra}]'") from error


@contextmanager
def hidden(module: str) -> Generator[None]:
    """Let an import of the module fail inside, unless it is imported already."""
    if module in sys.modules:
        yield
        return
    sys.modules[module] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        del sys.modules[module]


def closest(name: str, names: Iterable[str]) -> str:
    """Return text to append to "no such ..." messages: "; did you mean 'titan'?", or the list of names."""
    names = list(names)
    if near := difflib.get_close_matches(name, names, n=1):
        return f"; did you mean {near[0]!r}?"
    return f"; there is {', '.join(sorted(names))}" if names else ""
