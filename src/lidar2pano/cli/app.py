"""The program; here alone exceptions become a line on stderr and an exit code."""

from __future__ import annotations

import atexit
import errno
import functools
import io
import logging
import math
import os
import select
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.main import get_command

from lidar2pano import __version__
from lidar2pano.child_process import end_children
from lidar2pano.cli.config_files import add_config
from lidar2pano.cli.console import print_error, speaking
from lidar2pano.cli.help_layout import arrange
from lidar2pano.errors import InputError

# Exit codes: a user's mistake; the run is lost (a full disk, no memory, a loss that is no number); a fault of the
# program's own; Ctrl-C; SIGTERM.
MISTAKE, BROKEN, FAULT, INTERRUPTED, TERMINATED = 2, 1, 70, 130, 143
GRACE_S = 3.0  # from SIGTERM on threads may work; a busy machine takes up to 1.5 s more to take back the memory
# Errors of the system about an unusable name; all its other errors are not the user's mistake.
NAMES_ERRORS = {
    *(errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EACCES, errno.EPERM, errno.EROFS, errno.EEXIST),
    *(errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL, errno.ENOTEMPTY, errno.EFBIG),
}
EVERYWHERE = ("--debug", "--verbose", "--quiet")  # options that may stand behind any command, too
# In messages of libraries; the last is oneDNN's, of an operation that it has found possible before.
NO_MEMORY = ("allocate memory", "out of memory", "Cannot allocate", "bad_alloc", "could not create a primitive")


class Terminated(KeyboardInterrupt):
    """SIGTERM has come: unfinished work is undone, as by Ctrl-C."""


# module -> extra of the package that installs it
EXTRAS = {
    "lightning_fabric": "train",
    "tensorboard": "train",
    "matplotlib": "train",
    "fsspec": "bulk",
    "ray": "bulk",
    "starlette": "serve",
    "uvicorn": "serve",
    "prometheus_client": "serve",
}

COMPLETION = "_LIDAR2PANO_COMPLETE"  # set by the shell for a word to be completed
# Threads that wait sleep: where they spin, they take the cores from those that they wait for, on a busy machine a
# panorama takes four times as long.
WAITING = ("OMP_WAIT_POLICY", "PASSIVE")

app = typer.Typer(pretty_exceptions_enable=False)


@app.callback(invoke_without_command=True)
def program(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and leave.")] = False,
    debug: Annotated[  # noqa: ARG001 `main` takes it, wherever it stands
        bool, typer.Option("--debug", help="Show the traceback of an error, and warnings of libraries.")
    ] = False,
    verbose: Annotated[  # noqa: ARG001 likewise
        bool, typer.Option("--verbose", help="Say on stderr what is chosen: weights, device, engine.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No notes and bars on stderr, errors alone.")] = False,  # noqa: ARG001
) -> None:
    """One LiDAR scan in, a 360-degree colour panorama out."""
    if version:
        print(f"lidar2pano {__version__}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        print(context.get_help())
        raise typer.Exit(MISTAKE)


def make_program() -> Any:  # noqa: ANN401 typer's classes are click's or its own
    """Return the program with all its commands and options, its help arranged."""
    return arrange(add_config(get_command(app)))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program with `arguments` (the process's own when None) and return its exit code.

    Any exception becomes one line on stderr and an exit code, with --debug after its traceback.
    """
    if arguments is not None:
        return _run(list(arguments), lambda _: nullcontext())
    os.environ.setdefault(*WAITING)  # before torch is loaded
    if COMPLETION in os.environ:
        make_program().main(prog_name="lidar2pano")  # prints completions and leaves
    with _ended_in_time() as leave:
        try:
            code = _run(sys.argv[1:], _quiet)
        except Terminated:  # by a signal that came when the command was done
            code = TERMINATED
        return leave(code)


def _run(words: list[str], surroundings: Callable[[bool], AbstractContextManager[None]]) -> int:
    """Run a command in its surroundings, which are told of --debug, and return its exit code."""
    command = make_program()
    debug, verbose, quiet = (flag in words for flag in EVERYWHERE)
    words = [word for word in words if word not in EVERYWHERE]
    _open_streams()
    with speaking(verbose=verbose, quiet=quiet), surroundings(debug):
        try:
            # not command.main(): it handles Ctrl-C and a closed pipe in its own way
            with command.make_context("lidar2pano", words) as context:
                command.invoke(context)
            sys.stdout.flush()
        except typer.Exit as leave:
            return leave.exit_code if _flushed() else BROKEN
        except (Exception, KeyboardInterrupt) as error:
            code, line = exit_status(error)
            _flushed()
            if debug:
                traceback.print_exception(error)
            if line:
                print_error(line)
            return code
    return 0


def _open_streams() -> None:
    """Replace closed streams, and let names of files be printed whatever their characters."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None or stream.closed:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115 it stays open
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _flushed() -> bool:
    """Flush stdout and return whether that worked; if not, discard further output, for a silent end."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return False
    return True


@contextmanager
def _quiet(debug: bool) -> Iterator[None]:
    """Hide libraries' warnings unless `debug`, in a process of our own."""
    with warnings.catch_warnings():
        if not debug and not sys.warnoptions:
            warnings.simplefilter("ignore")
            logging.lastResort = logging.NullHandler()  # None would report a missing handler
            # An exception in a library's thread ends the command waiting for it; one in __del__ ends nothing.
            threading.excepthook = sys.unraisablehook = lambda _: None
        yield


@contextmanager
def _ended_in_time() -> Iterator[Callable[[int], int]]:
    """Inside, SIGTERM raises Terminated, and ends the process GRACE_S later, though threads wait.

    The value returns a command's exit code; after a SIGTERM it ends the process with it, since to take down the
    interpreter and its libraries takes many seconds in a busy machine. Later signals find the earlier handler again.
    """

    def terminate(*_: object) -> None:
        raise Terminated("terminated")

    handler = signal.signal(signal.SIGTERM, terminate)
    if os.name != "posix":
        yield lambda code: code
        return
    receiver, sender = os.pipe()
    os.set_blocking(sender, False)
    wakeup = signal.set_wakeup_fd(sender, warn_on_full_buffer=False)  # written to at once, even while Python waits
    _forget_wakeup_in_children()
    codes = list[int]()  # of the command, when it is done
    deadline = _Deadline(receiver, codes)
    deadline.start()

    def leave(code: int) -> int:
        signal.signal(signal.SIGTERM, lambda *_: None)  # the deadline's thread gets it all the same
        codes.append(code)
        os.write(sender, bytes(1))
        deadline.asked.wait()
        if deadline.signalled or code == TERMINATED:  # a library may have listened in our place
            atexit._run_exitfuncs()  # children end, temporary folders go
            os._exit(TERMINATED if code == INTERRUPTED else code)  # `train` pauses alike for both signals
        return code

    try:
        yield leave
    finally:
        signal.set_wakeup_fd(wakeup)
        signal.signal(signal.SIGTERM, handler)
        os.close(sender)  # the thread reads the rest of the pipe, then its end


class _Deadline(threading.Thread):
    """Ends the process GRACE_S after the number of SIGTERM has been read from a pipe."""

    def __init__(self, receiver: int, codes: Sequence[int]) -> None:
        super().__init__(name="end in time", daemon=True)
        self.receiver, self.codes = receiver, codes
        self.signalled, self.asked = False, threading.Event()  # whether SIGTERM had come when 0 was read

    def run(self) -> None:
        """Read numbers of signals until the pipe ends, or the time."""
        end = math.inf
        with open(self.receiver, "rb", buffering=0) as numbers:  # noqa: PTH123 a descriptor, no path
            while select.select([numbers], [], [], None if end == math.inf else max(0, end - time.monotonic()))[0]:
                (number,) = numbers.read(1) or (-1,)
                if number == signal.SIGTERM and not self.signalled:
                    self.signalled, end = True, time.monotonic() + GRACE_S
                elif number == 0:
                    self.asked.set()
                elif number == -1:
                    return
        if not self.codes:
            print_error("terminated, before all work was put away; repeat the command to go on")
        end_children()
        os._exit(self.codes[0] if self.codes else TERMINATED)


@functools.cache
def _forget_wakeup_in_children() -> None:
    """Let forked processes write no signals into the pipe of this one: a worker's end is not ours."""
    os.register_at_fork(after_in_child=lambda: signal.set_wakeup_fd(-1))


def exit_status(error: BaseException) -> tuple[int, str]:
    """Return exit code and line on stderr for an exception."""
    error = _interruption(error) or error
    rules: list[tuple[type[BaseException], int, str]] = [
        (InputError, MISTAKE, str(error)),
        (FloatingPointError, BROKEN, str(error)),
        (Terminated, TERMINATED, str(error)),
        (KeyboardInterrupt, INTERRUPTED, str(error) or "interrupted"),
        (BrokenPipeError, BROKEN, ""),  # the reader of our output has closed it, e.g. `| head`
        (MemoryError, BROKEN, "there is not enough memory; give the program more of it, or less to do at a time"),
    ]
    for category, code, line in rules:
        if isinstance(error, category):
            return code, line
    if isinstance(error, ModuleNotFoundError) and (extra := EXTRAS.get(_missing(error))):
        return MISTAKE, f"this command needs {_missing(error)}: pip install 'lidar2pano[{extra}]'"
    if message := getattr(error, "format_message", None):  # typer's own complaint about arguments
        return MISTAKE, f"{message().rstrip('.')}; see lidar2pano --help"
    if isinstance(error, Exception) and any(text in str(error) for text in NO_MEMORY):
        return exit_status(MemoryError())
    if isinstance(error, OSError):
        code = MISTAKE if error.errno in NAMES_ERRORS else BROKEN
        place = f"{error.filename}: " if error.filename is not None else ""
        return code, f"{place}{error.strerror or error}; fix this and run the command again"
    summary = f"{type(error).__name__}: {error}".partition("\n")[0]
    return FAULT, f"a fault of the program ({summary}); repeat the command with --debug and report its output"


def _interruption(error: BaseException) -> KeyboardInterrupt | None:
    """Return the signal that an exception comes of: one amid a library's import is raised on as ImportError."""
    cause = error.__cause__ or error.__context__
    return cause if cause is None or isinstance(cause, KeyboardInterrupt) else _interruption(cause)


def _missing(error: ModuleNotFoundError) -> str:
    """Return the missing top module; our own messages read "training needs MODULE: ..."."""
    return (error.name or str(error).partition(" needs ")[2].partition(":")[0]).partition(".")[0]
