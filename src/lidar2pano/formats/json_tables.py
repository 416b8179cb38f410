"""Tables as JSON: files that hold a list of flat objects, its rows, read piece by piece however large they are.

nuScenes' sample_data.json has 2.6 million rows in 1.2 GB, of which a tenth is needed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from lidar2pano.bounded_files import open_regular
from lidar2pano.errors import InputError
from lidar2pano.formats.json_files import parse_json

BLOCK_BYTES = 1 << 22
LONGEST_ROW = 1 << 20


def table_rows(
    path: Path, wanted: Callable[[bytes], object] | None = None, mend: str = "complete the data set"
) -> Iterator[dict[str, Any]]:
    """The rows of a file that is a list of objects without objects (or braces in a text) in them, in its order.

    wanted  is given the text of a row without its braces, and says whether it is parsed; all are without it.
    Memory holds one piece of the file at a time. Raises InputError where the file is missing, damaged or ends early;
    a row that is not wanted is not looked into.
    """
    before, rest = b"[", b""
    for block in _blocks(path, mend):
        *rows, rest = (rest + block).split(b"}")
        for row in rows:
            separator, brace, fields = row.partition(b"{")
            if not brace or separator.strip() != before:
                raise InputError(f"{path}: is no list of flat objects; {mend}")
            before = b","
            if wanted is None or wanted(fields):
                yield parse_json(b"{%b}" % fields, str(path), mend)
        if len(rest) > LONGEST_ROW:
            raise InputError(f"{path}: has a row of more than {LONGEST_ROW} bytes; {mend}")
    if b"".join(rest.split()) != (b"]" if before == b"," else b"[]"):
        raise InputError(f"{path}: ends within a row; {mend}")


def _blocks(path: Path, mend: str) -> Iterator[bytes]:
    try:
        with open_regular(path) as file:
            while block := file.read(BLOCK_BYTES):
                yield block
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {mend}") from error
