"""Files that commands write: checks of where they may go, and JSON that is written completely or not at all."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from lidar2pano.errors import InputError


def check_folder(folder: Path, option: str) -> Path:
    """Return `folder`; InputError unless it is, or can become, a folder to write into. Nothing is made yet."""
    above = folder
    while not above.exists() and above != above.parent:
        above = above.parent
    if not above.is_dir():
        raise InputError(f"{folder}: cannot be written ({above} is not a folder); choose another {option}")
    try:
        with tempfile.TemporaryFile(dir=above):  # permissions do not say everything: read-only disks, /proc
            return folder
    except OSError as error:
        reason = f"{error.strerror}, in {above}"
        raise InputError(f"{folder}: cannot be written ({reason}); choose another {option}") from error


def check_file(path: Path, option: str) -> None:
    """Raise InputError unless a file can be written to `path`."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file for {option}")
    check_folder(path.parent, option)


def write_json(path: Path, value: Any, option: str) -> None:  # noqa: ANN401
    """Write `value` as JSON, beside and then renamed; InputError where that cannot be done."""
    from lidar2pano.formats.image_files import write_whole

    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    write_whole(path, lambda beside: beside.write_text(text, encoding="utf-8"), option)
