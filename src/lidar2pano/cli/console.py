"""The terminal: standard input as a scan; errors, licences and a progress bar on stderr; signals."""

from __future__ import annotations

import logging
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lidar2pano.models.card import Card

import tempfile
from pathlib import Path

from lidar2pano.errors import InputError

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
    """Switch of notes and bars, set by `speaking` for the time of a command."""

    enabled = True


@contextmanager
def speaking(*, verbose: bool, quiet: bool) -> Iterator[None]:
    """Print what the library logs (verbose), or neither notes nor bars (quiet), as long as the context lasts."""
    log, handler = logging.getLogger("lidar2pano"), logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("lidar2pano: %(message)s"))
    level, enabled = log.level, _Notes.enabled
    _Notes.enabled = not quiet
    if verbose:
        log.addHandler(handler)
        log.setLevel(logging.INFO)
    try:
        yield
    finally:
        _Notes.enabled = enabled
        log.removeHandler(handler)
        log.setLevel(level)


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
def bar(total: int, title: str) -> Iterator[Callable[[], None]]:
    """Give a function to call after each of `total` things; silent for one, and unless stderr is a terminal."""
    if total < 2 or not _Notes.enabled or not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, redirect_stdout=sys.stdout.isatty()) as progress:
        task = progress.add_task(title, total=total)
        yield lambda: progress.advance(task)


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
