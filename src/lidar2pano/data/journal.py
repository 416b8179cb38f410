"""The journal of a sequence: files written by `prepare`, their sources, and stamps to recognise them.

One line of JSON per file written, appended before the file gets its name, so that a file of ours without its line
cannot be, whatever ends the process. A torn or strange line is passed over: its file then counts as somebody
else's and is left alone, never the other way round.
"""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from lidar2pano.bounded_files import read_bytes, sha256_of
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import append_bytes
from lidar2pano.formats.json_files import json_lines, validated

NAME = "prepared.jsonl"
MOST_BYTES = 1 << 28  # a quarter of a million files


@dataclass(frozen=True, slots=True, kw_only=True)
class Stamp:
    """A file's content: its SHA-256, and size in bytes and time of change (ns), to spare reading it again."""

    sha256: str
    size: int
    changed_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """One written file.

    file     its path within the sequence's folder, e.g. "labels/000000.label".
    made_by  the teacher: hash of its weights and settings.
    source   its scan or image;  stamp: the file itself.
    """

    file: str
    made_by: str
    source: Stamp
    stamp: Stamp


class Journal:
    """The records of one sequence; `folder` is ROOT/sequences/<seq>. InputError when its file may not be read."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / NAME
        self._records: dict[str, list[Record]] = {}
        self._size, self._torn = 0, False
        self.refresh()

    def refresh(self) -> None:
        """Read the file again if another process has appended to it."""
        try:
            if not self.path.is_file() or self.path.stat().st_size == self._size:
                return
            content = read_bytes(self.path, MOST_BYTES)
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read ({error.strerror}); ask for permission") from error
        self._size, self._torn = len(content), not content.endswith(b"\n")
        self._records = {}
        for entry in json_lines(content):
            with suppress(InputError):
                record = validated(Record, entry, "")
                self._records.setdefault(record.file, []).append(record)

    def of(self, file: str) -> list[Record]:
        """Records of `file`, the latest first."""
        return self._records.get(file, [])[::-1]

    def enter(self, record: Record) -> None:
        """Append a record: a killed process does not lose it, a power cut may. OSError if it cannot be written."""
        line = json.dumps(asdict(record), separators=(",", ":")).encode() + b"\n"
        line = b"\n" + line if self._torn else line
        self._torn = True  # until the whole line is there
        append_bytes(self.path, line)
        self._size, self._torn = self._size + len(line), False
        self._records.setdefault(record.file, []).append(record)


def stamp_of(path: Path, recorded: Stamp | None = None) -> Stamp:
    """Return the stamp of a file: `recorded` if its size and time of change still hold, otherwise read again.

    Raises InputError when the file cannot be read.
    """
    try:
        now = path.stat()
        if recorded and (now.st_size, now.st_mtime_ns) == (recorded.size, recorded.changed_ns):
            return recorded
        digest = sha256_of(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); ask for permission") from error
    return Stamp(sha256=digest, size=now.st_size, changed_ns=now.st_mtime_ns)
