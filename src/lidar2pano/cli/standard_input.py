"""Standard input as a scan: `-` on the command line."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from lidar2pano.errors import InputError

NAMES = {"-", "/dev/stdin", "/dev/fd/0", "/proc/self/fd/0"}
STEM = "stdin"  # of the outputs' names
MOST_BYTES = 1 << 34  # of a piped recording
CHUNK_BYTES = 1 << 20


@contextmanager
def spooled(paths: Iterable[Path]) -> Iterator[list[Path]]:
    """Give the paths with standard input as a temporary file, since formats are read from any place of a file.

    An InputError names it `-`. Raises InputError if it is a terminal, is named twice, or does not end.
    """
    paths = list(paths)
    places = [place for place, path in enumerate(paths) if str(path) in NAMES]
    if not places:
        yield paths
        return
    if len(places) > 1 or sys.stdin is None or sys.stdin.isatty():
        raise InputError("-: standard input is a terminal or named twice; pipe one scan into it")
    with tempfile.TemporaryDirectory(prefix="lidar2pano-") as folder:
        file = Path(folder, STEM)
        with file.open("wb") as target:
            while (chunk := sys.stdin.buffer.read(CHUNK_BYTES)) and target.tell() <= MOST_BYTES:
                target.write(chunk)
        if file.stat().st_size > MOST_BYTES:
            raise InputError(f"-: more than {MOST_BYTES} bytes came; write them to a file")
        paths[places[0]] = file
        try:
            yield paths
        except InputError as error:
            raise InputError(str(error).replace(str(file), "-")) from None
