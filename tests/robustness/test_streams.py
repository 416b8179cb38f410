"""What is not the program's own: closed and full streams, no memory, odd terminals and names, faults of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from lidar2pano.cli import main
from lidar2pano.cli.app import BROKEN, FAULT, INTERRUPTED, MISTAKE, TERMINATED, Terminated
from lidar2pano.cli.console import print_error
from random_weights import write_scan

PROGRAM = f"exec {sys.executable} -m lidar2pano"


def shell(words: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[bytes]:
    where = {**os.environ, **environment}
    return subprocess.run(["bash", "-c", words], cwd=folder, capture_output=True, check=False, env=where, timeout=120)


def test_a_full_stdout_is_one_line(tmp_path):
    done = shell(f"{PROGRAM} --version > /dev/full", tmp_path)
    assert done.returncode == BROKEN and done.stderr.count(b"\n") <= 1 and b"Traceback" not in done.stderr


@pytest.mark.parametrize(  # a command with torch, and those without it, which start in a third of the time
    ("command", "closed"), [("inspect a.bin", ">&-"), ("inspect a.bin", "2>&-"), ("weights list", ">&- 2>&-")]
)
def test_closed_streams_end_nothing(tmp_path, command, closed):
    write_scan(tmp_path / "a.bin")
    done = shell(f"{PROGRAM} {command} {closed}", tmp_path)
    assert done.returncode == 0 and b"Traceback" not in done.stderr
    assert (b"points" in done.stdout) == (closed == "2>&-")


def test_names_on_a_terminal_of_ascii(tmp_path):
    (tmp_path / "bad-\u00e9\u4e16.bin").write_bytes(b"x" * 33)
    done = shell(f"{PROGRAM} inspect bad-*.bin", tmp_path, LC_ALL="C", PYTHONIOENCODING="ascii", PYTHONUTF8="0")
    assert done.returncode == MISTAKE
    assert done.stderr.count(b"\n") == 1 and done.stderr.isascii() and b"33 bytes" in done.stderr


def fail(error: BaseException, monkeypatch, capsys, *words: str) -> tuple[int, str]:
    """Exit code and stderr of a command in which `error` is raised."""

    def raises(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("lidar2pano.models.families.families", raises)
    code = main([*words, "weights", "list"])
    return code, capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "code", "says"),
    [
        (OSError(28, "No space left on device", "a/b"), BROKEN, "a/b: No space"),
        (OSError(24, "Too many open files"), BROKEN, "Too many open files; fix this"),
        (OSError(36, "File name too long", "n" * 9000), MISTAKE, "too long"),
        (PermissionError(13, "Permission denied", "x"), MISTAKE, "x: Permission denied; fix this"),
        (MemoryError(), BROKEN, "not enough memory"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"), BROKEN, "not enough memory"),
        (RuntimeError("could not create a primitive"), BROKEN, "not enough memory"),
        (RuntimeError("std::bad_alloc"), BROKEN, "not enough memory"),
        (Exception("Failed to allocate memory for requested buffer of size 9"), BROKEN, "not enough memory"),
        (ZeroDivisionError("float division"), FAULT, "a fault of the program (ZeroDivisionError"),
        (KeyError("a\nb"), FAULT, "a fault of the program"),
        (RecursionError("too deep"), FAULT, "a fault of the program"),
        (Terminated("terminated"), TERMINATED, "terminated"),
        (KeyboardInterrupt(), INTERRUPTED, "interrupted"),
    ],
)
def test_anything_else_is_one_line_and_a_named_exit_code(monkeypatch, capsys, error, code, says):
    left, err = fail(error, monkeypatch, capsys)
    assert left == code and says in err and err.count("\n") == 1 and len(err) < 2500


@pytest.mark.parametrize("linked", ["cause", "context"])
def test_a_signal_amid_an_import_ends_as_the_signal_does(monkeypatch, capsys, linked):
    # so pybind11 reports whatever a module's import raises
    error, signalled = ImportError("initialization failed"), Terminated("terminated")
    setattr(error, f"__{linked}__", signalled)
    assert fail(error, monkeypatch, capsys) == (TERMINATED, "lidar2pano: terminated\n")


def test_debug_shows_the_traceback_wherever_it_stands(monkeypatch, capsys):
    _, err = fail(ZeroDivisionError("x"), monkeypatch, capsys, "--debug")
    assert "Traceback" in err and err.rstrip().splitlines()[-1].startswith("lidar2pano: a fault of the program")


def test_strange_names_are_escaped_and_long_ones_shortened(capsys):
    print_error(f"\x1b[2Ja\u202eb\udc80 {'n' * 100_000}: is wrong")
    err = capsys.readouterr().err
    assert (
        err.startswith("lidar2pano: \\x1b[2Ja\\u202eb\\udc80 nnn") and err.endswith(": is wrong\n") and len(err) < 600
    )


def test_hidden_files_are_no_scans(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_scan(tmp_path / "drive" / "a.bin")
    (tmp_path / "drive" / ".b.bin").write_bytes(b"half")
    assert main(["inspect", "drive"]) == 0
    assert ".b.bin" not in capsys.readouterr().out


def test_what_libraries_log_and_warn_of_is_not_printed(tmp_path):
    words = "import logging, warnings; logging.getLogger('a.library').warning('logged'); warnings.warn('warned')"
    program = f"from lidar2pano.cli.app import _quiet\nwith _quiet(False):\n    {words}"
    (tmp_path / "program.py").write_text(program)
    done = shell(f"exec {sys.executable} program.py", tmp_path, PYTHONWARNINGS="")
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")


IN_A_THREAD = "import threading; one = threading.Thread(target=lambda: 1 / 0); one.start(); one.join()"
CLEANING_UP = "one = type('Library', (), {'__del__': lambda self: 1 / 0})(); del one"


@pytest.mark.parametrize("words", [IN_A_THREAD, CLEANING_UP])
def test_what_ends_a_librarys_thread_or_its_cleaning_up_is_not_printed(tmp_path, words):
    (tmp_path / "program.py").write_text(f"from lidar2pano.cli.app import _quiet\nwith _quiet(False):\n    {words}")
    done = shell(f"exec {sys.executable} program.py", tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")
