"""The program, and the one place where what went wrong becomes a line on stderr and an exit code."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence
from typing import Annotated

import typer
from typer.main import get_command

from lidar2pano import __version__
from lidar2pano.errors import InputError

MISTAKE, BROKEN, INTERRUPTED = 2, 1, 130  # exit codes: the user can mend it; the run is lost; Ctrl-C
FATES = {InputError: MISTAKE, FloatingPointError: BROKEN, KeyboardInterrupt: INTERRUPTED}
# module -> extra of the package that installs it
EXTRAS = {"lightning": "train", "torchmetrics": "train", "tensorboard": "train", "matplotlib": "train"}

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
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        # not command.main(): that one has answers of its own to Ctrl-C and to a closed pipe
        with command.make_context("lidar2pano", words) as context:
            command.invoke(context)
        sys.stdout.flush()
    except typer.Exit as leave:
        return leave.exit_code
    except (Exception, KeyboardInterrupt) as error:
        code, line = judged(error)
        if not code:
            raise
        if line:
            complain(line)
        return code
    return 0


def judged(error: BaseException) -> tuple[int, str]:
    """The exit code and the line that an error deserves; (0, "") for a bug, which keeps its traceback."""
    for kind, code in FATES.items():
        if isinstance(error, kind):
            return code, str(error) or "interrupted"
    if isinstance(error, ModuleNotFoundError) and (extra := EXTRAS.get(_missing(error))):
        return MISTAKE, f"this command needs {_missing(error)}: pip install 'lidar2pano[{extra}]'"
    if isinstance(error, BrokenPipeError):  # whoever read our output has seen enough, e.g. `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left to be flushed at exit goes there
        return BROKEN, ""
    if spoken := getattr(error, "format_message", None):  # typer's own complaint about arguments
        return MISTAKE, f"{spoken().rstrip('.')}; see lidar2pano --help"
    return 0, ""


def _missing(error: ModuleNotFoundError) -> str:
    """The top module that was not found; our own messages say "training needs MODULE: ..."."""
    return (error.name or str(error).partition(" needs ")[2].partition(":")[0]).partition(".")[0]


def note_licences(weights: Iterable[str]) -> None:
    """One line on stderr for each licence that restricts the use of these weights (names as `translate` takes them)."""
    from lidar2pano.models.families import licence_note, weight_files

    for note in dict.fromkeys(licence_note(weight_files(name)) for name in weights):
        if note:
            complain(note)


def complain(problem: object) -> None:
    """One line on stderr."""
    print(f"lidar2pano: {' '.join(str(problem).split())}", file=sys.stderr)
