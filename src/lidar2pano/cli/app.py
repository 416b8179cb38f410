"""The program, and the one place where an exception becomes a line on stderr and an exit code."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Annotated

import typer
from typer.main import get_command

from lidar2pano import __version__
from lidar2pano.errors import InputError

if TYPE_CHECKING:
    from lidar2pano.models.card import Card

MISTAKE, BROKEN, INTERRUPTED = 2, 1, 130  # exit codes: a user's mistake; the run is lost; Ctrl-C
EXIT_CODES = {InputError: MISTAKE, FloatingPointError: BROKEN, KeyboardInterrupt: INTERRUPTED}
MOST_CHARACTERS = 2000  # of a message
# module -> extra of the package that installs it
EXTRAS = {
    "lightning": "train",
    "torchmetrics": "train",
    "tensorboard": "train",
    "matplotlib": "train",
    "fsspec": "fsspec",
}

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.callback(invoke_without_command=True)
def program(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and leave.")] = False,
) -> None:
    """One bare LiDAR scan in, a 360-degree colour picture of the place out."""
    if version:
        print(f"lidar2pano {__version__}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        print(context.get_help())
        raise typer.Exit(MISTAKE)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program with `arguments` (the process's own when None) and return its exit code."""
    command = get_command(app)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a file's name may be no text; stderr does so by itself
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        # not command.main(), which handles Ctrl-C and a closed pipe in its own way
        with command.make_context("lidar2pano", words) as context:
            command.invoke(context)
        sys.stdout.flush()
    except typer.Exit as leave:
        return leave.exit_code
    except (Exception, KeyboardInterrupt) as error:
        code, line = exit_status(error)
        if not code:
            raise
        if line:
            complain(line)
        return code
    return 0


def exit_status(error: BaseException) -> tuple[int, str]:
    """Exit code and line on stderr for an exception; (0, "") for a bug, which keeps its traceback."""
    for category, code in EXIT_CODES.items():
        if isinstance(error, category):
            return code, str(error) or "interrupted"
    if isinstance(error, ModuleNotFoundError) and (extra := EXTRAS.get(_missing(error))):
        return MISTAKE, f"this command needs {_missing(error)}: pip install 'lidar2pano[{extra}]'"
    if isinstance(error, BrokenPipeError):  # the reader of our output has closed it, e.g. `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the flush at exit goes there
        return BROKEN, ""
    if message := getattr(error, "format_message", None):  # typer's own complaint about arguments
        return MISTAKE, f"{message().rstrip('.')}; see lidar2pano --help"
    return 0, ""


def _missing(error: ModuleNotFoundError) -> str:
    """The top module that was not found; our own messages read "training needs MODULE: ..."."""
    return (error.name or str(error).partition(" needs ")[2].partition(":")[0]).partition(".")[0]


def note_licence(cards: Iterable[Card]) -> None:
    """One line on stderr where a licence restricts the use of the weights that have these cards."""
    from lidar2pano.models.families import licence_note

    if note := licence_note(cards):
        complain(note)


def complain(problem: object) -> None:
    """One line of printable characters on stderr, MOST_CHARACTERS at most."""
    line = " ".join(str(problem).split())
    line = "".join(one if one.isprintable() else "?" for one in line)
    print(f"lidar2pano: {line if len(line) <= MOST_CHARACTERS else line[:MOST_CHARACTERS] + ' ...'}", file=sys.stderr)
