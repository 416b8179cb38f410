"""The terminal: standard input as a scan; errors, licences and a progress bar on stderr; signals."""

from __future__ import annotations

import logging
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from lidar2pano.errors import InputError
from lidar2pano.progress import Advance, shown_by

if TYPE_CHECKING:
    from rich.progress import Progress

    from lidar2pano.models.card import Card

LOG = logging.getLogger("lidar2pano")
LINES_S, LINE_EVERY_S = (2.0, 10.0), 30.0  # of long work, without a terminal
MOST_CHARACTERS = 2000  # of a message
MOST_WORD = 400  # characters of one word of it, such as a path

STANDARD_INPUT = {"-", "/dev/stdin", "/dev/fd/0", "/proc/self/fd/0"}
STEM = "stdin"  # of the outputs' names
MOST_PIPED_BYTES = 1 << 34  # of a piped recording
CHUNK_BYTES = 1 << 20


def print_error(problem: object) -> None:
    """Print one line of printable characters on stderr: others are escaped, long words and long lines shortened."""
    line = " ".join(_shorten(word) for word in str(problem).split())
    line = "".join(char if char.isprintable() else char.encode("unicode_escape").decode() for char in line)
    with suppress(OSError):  # stderr is full or closed
        print(f"lidar2pano: {_shorten(line, MOST_CHARACTERS)}", file=sys.stderr, flush=True)


class _Notes:
    """The state of notes, logs and bars, set by `speaking` for the time of a command."""

    enabled = True
    handler: logging.Handler | None = None  # of the library's log
    progress: Progress | None = None  # on the terminal


@contextmanager
def speaking(*, verbose: bool, quiet: bool) -> Iterator[None]:
    """Print what the library logs (verbose), or neither notes nor bars (quiet), as long as the context lasts."""
    level, enabled, handler = LOG.level, _Notes.enabled, _Notes.handler
    _Notes.enabled, _Notes.handler = not quiet, None
    try:
        with shown_by(announced):
            if verbose:
                show_log()
            yield
    finally:
        if _Notes.handler:
            LOG.removeHandler(_Notes.handler)
        _Notes.enabled, _Notes.handler = enabled, handler
        LOG.setLevel(level)


def show_log() -> None:
    """Print what the library logs until the command ends, unless --quiet is given."""
    if _Notes.enabled and _Notes.handler is None:
        _Notes.handler = logging.StreamHandler(sys.stderr)
        _Notes.handler.setFormatter(logging.Formatter("lidar2pano: %(message)s"))
        LOG.addHandler(_Notes.handler)
        LOG.setLevel(logging.INFO)


def print_note(note: object) -> None:
    """Print one line on stderr unless --quiet is given."""
    if _Notes.enabled:
        print_error(note)


def _shorten(text: str, most: int = MOST_WORD) -> str:
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[-most // 2 :]}"


def print_weights(chosen: str, cards: Iterable[Card]) -> None:
    """Print on stderr which family was chosen, "" if it was named, and a licence that restricts the use of weights."""
    from lidar2pano.models.families import licence_note

    for note in filter(None, (chosen, licence_note(cards))):
        print_note(note)


@contextmanager
def bar(total: int, title: str) -> Iterator[Advance]:
    """Give a function to call after each of `total` steps, 0 for an unknown number, to show how many are done.

    A terminal gets a bar with an estimate of the time left, anything else lines, if the work takes long.
    """
    if not _Notes.enabled:
        yield lambda: None
    elif sys.stderr.isatty():
        with _drawn(total, title) as advance:
            yield advance
    else:
        yield _Lines(total, title).advance


@contextmanager
def announced(total: int, title: str) -> Iterator[Advance]:
    """Show work that always takes long: like `bar`, and without a terminal by a line at once."""
    if not sys.stderr.isatty():
        print_note(title)
    with bar(total, title) as advance:
        yield advance


@contextmanager
def _drawn(total: int, title: str) -> Iterator[Advance]:
    """Draw a bar, below those that are drawn already."""
    import rich.progress
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    with ExitStack() as stack:
        progress = _Notes.progress
        if progress is None:
            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
            times = (TimeElapsedColumn(), TimeRemainingColumn())
            settings = {"transient": True, "redirect_stdout": sys.stdout.isatty()}
            drawing = rich.progress.Progress(*columns, *times, console=Console(stderr=True), **settings)
            progress = _Notes.progress = stack.enter_context(drawing)
            stack.callback(setattr, _Notes, "progress", None)
        task = progress.add_task(title, total=total or None)
        if len(progress.tasks) > 1:  # the outermost stays until all is drawn
            stack.callback(progress.remove_task, task)
        yield lambda: progress.advance(task)


class _Lines:
    """Lines about work on stderr, after LINES_S and then every LINE_EVERY_S."""

    def __init__(self, total: int, title: str) -> None:
        self.total, self.title, self.count = total, title, 0
        self.start_s = time.monotonic()
        self.due_s = [self.start_s + wait_s for wait_s in LINES_S]

    def advance(self) -> None:
        """Count a step, and print a line if one is due and steps are left."""
        self.count, now_s = self.count + 1, time.monotonic()
        if now_s < self.due_s[0] or self.count >= self.total:
            return
        self.due_s = [due_s for due_s in self.due_s if due_s > now_s] or [now_s + LINE_EVERY_S]
        left_s = (now_s - self.start_s) / self.count * (self.total - self.count)
        print_note(f"{self.title}: {self.count} of {self.total}, about {duration(left_s)} left")


def duration(seconds: float) -> str:
    """Return a time as people say it: 40 s, 12 min, 3.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 90 * 60 else f"{seconds / 3600:.1f} h"


@contextmanager
def until_signal(*numbers: signal.Signals) -> Iterator[threading.Event]:
    """Give an event set by the first of these signals, to finish the scan at work; a second one kills."""
    stopped = threading.Event()

    def stop(*_: int | FrameType | None) -> None:
        stopped.set()
        restore()

    handlers = {number: signal.signal(number, stop) for number in numbers}

    def restore() -> None:
        for number, handler in handlers.items():
            signal.signal(number, handler)

    try:
        yield stopped
    finally:
        restore()


@contextmanager
def spooled(paths: Iterable[Path]) -> Iterator[list[Path]]:
    """Give the paths with standard input as a temporary file, since formats are read from any place of a file.

    An InputError names it `-`. Raises InputError if it is a terminal, is named twice, or does not end.
    """
    paths = list(paths)
    places = [place for place, path in enumerate(paths) if str(path) in STANDARD_INPUT]
    if not places:
        yield paths
        return
    if len(places) > 1 or sys.stdin is None or sys.stdin.isatty():
        raise InputError("-: standard input is a terminal or named twice; pipe one scan into it")
    with tempfile.TemporaryDirectory(prefix="lidar2pano-") as folder:
        file = Path(folder, STEM)
        with file.open("wb") as target:
            while (chunk := sys.stdin.buffer.read(CHUNK_BYTES)) and target.tell() <= MOST_PIPED_BYTES:
                target.write(chunk)
        if file.stat().st_size > MOST_PIPED_BYTES:
            raise InputError(f"-: more than {MOST_PIPED_BYTES} bytes came; write them to a file")
        paths[places[0]] = file
        try:
            yield paths
        except InputError as error:
            raise InputError(str(error).replace(str(file), "-")) from None
