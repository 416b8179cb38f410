"""What a user can mend: one exception for it, and the nearest name for a name that does not exist."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """Something from outside (a file, an option, a name) cannot be used.

    The message is one line that names the thing, says what is wrong and what to do; the command line prints it and
    leaves with exit code 2.
    """


def closest(name: str, known: Iterable[str]) -> str:
    """Text to append to "no such ..." messages: "; did you mean 'titan'?", or the list of what there is."""
    known = list(known)
    if near := difflib.get_close_matches(name, known, n=1):
        return f"; did you mean {near[0]!r}?"
    return f"; there is {', '.join(sorted(known))}" if known else ""
