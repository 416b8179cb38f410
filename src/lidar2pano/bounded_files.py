"""The gate for files from outside: only regular ones are opened, and read up to a size.

All functions but `read_input` raise OSError, whose `strerror` is the reason; callers add the kind of file.
"""

from __future__ import annotations

import errno
import hashlib
import io
import os
import stat
from pathlib import Path

from lidar2pano.errors import InputError

MOST_TEXT_BYTES = 1 << 26  # of JSON and of times: 64 MiB list a million frames
MOST_LINES = 1 << 20  # of such a text: each becomes an object of a hundred bytes or two
MOST_CALIBRATION_BYTES = 1 << 18  # of calibrations and settings, which have some kilobytes


def open_regular(path: str | Path) -> io.FileIO:
    """Open a file to read it; a folder, device, FIFO or socket raises OSError at once instead of blocking."""
    file = io.FileIO(os.fspath(path), "rb", opener=_without_waiting)
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(errno.EINVAL, "it is a device, FIFO or socket, no file", str(path))
    return file


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))  # a FIFO without a writer would wait for one


def name_of_open(file: io.FileIO) -> str:
    """Return a name by which a library opens the same file again: on Linux, whatever has taken its place meanwhile."""
    name = Path(f"/proc/self/fd/{file.fileno()}")
    return str(name if name.exists() else file.name)


def sha256_of(path: str | Path) -> str:
    """Return the SHA-256 of a regular file, in hexadecimal."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_bytes(path: str | Path, most: int) -> bytes:
    """Read all bytes of a regular file; one of more than `most` bytes, sparse or not, raises OSError before reading."""
    with open_regular(path) as file:
        if (size := os.fstat(file.fileno()).st_size) > most:
            raise OSError(errno.EFBIG, f"it has {size} bytes, at most {most} belong there", str(path))
        return file.readall()


def read_text(path: str | Path, most: int = MOST_TEXT_BYTES) -> str:
    """Read the UTF-8 text of a regular file; raises UnicodeDecodeError (a ValueError), and OSError as `read_bytes`."""
    return read_bytes(path, most).decode("utf-8")


def read_lines(path: str | Path, most: int = MOST_TEXT_BYTES) -> list[str]:
    """Read the lines of a text; more than MOST_LINES raise OSError, and what `read_text` raises."""
    text = read_text(path, most)
    if text.count("\n") > MOST_LINES:
        raise OSError(errno.EFBIG, f"it has more than {MOST_LINES} lines", str(path))
    return text.split("\n")


def read_input(path: str | Path, mend: str, most: int = MOST_TEXT_BYTES) -> bytes:
    """Read like `read_bytes`; InputError "PATH: cannot be read (REASON); MEND" in place of an OSError."""
    try:
        return read_bytes(path, most)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {mend}") from error
