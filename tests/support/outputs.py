"""What commands leave in a folder, for comparison of one run with another."""

from __future__ import annotations

from pathlib import Path

LEAVINGS = ("*.part", ".*", "*.old")
TIMES_AND_NAMES = ("milliseconds", "others", "hours", "weights", "key")  # which differ from run to run


def contents(folder: Path, without: tuple[str, ...] = ()) -> dict[str, bytes]:
    """All files of a folder by their paths in it; without files of some names."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name not in without)
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def check_leavings(folder: Path) -> None:
    """Fail if something unfinished lies in a folder."""
    assert not [path for pattern in LEAVINGS for path in folder.rglob(pattern)]


def plain(value: object) -> object:
    """A row's evaluation without what differs from run to run: times, and names of folders."""
    if isinstance(value, dict):
        return {key: plain(part) for key, part in value.items() if key not in TIMES_AND_NAMES}
    return [plain(part) for part in value] if isinstance(value, list) else value
