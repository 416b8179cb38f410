"""Labels that `lidar2pano prepare` wrote: predictions of a teacher network, which are scored like ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from lidar2pano.data.frames import Frame
from lidar2pano.data.semantic_kitti import SemanticKittiFrame
from lidar2pano.formats.json_files import json_lines

JOURNAL = "prepared.jsonl"  # of a sequence's folder: a line of JSON per file that `prepare` wrote
PARTS = {"point labels": ("labels", ".label"), "camera labels": ("camera_labels", ".png")}


def pseudo_labels(frame: Frame) -> dict[str, str]:
    """Parts of a frame ("point labels", "camera labels") that a teacher wrote -> the teacher's hash.

    A file counts as the teacher's while it has the size and the modification time that `prepare` noted.
    """
    if not isinstance(frame, SemanticKittiFrame):
        return {}
    found, journal = {}, _journal(frame.folder / JOURNAL)
    for part, (folder, suffix) in PARTS.items():
        path = frame.file(folder, suffix)
        stamp, teacher = journal.get(f"{folder}/{path.name}", (None, ""))
        if stamp and path.is_file() and stamp == [path.stat().st_size, path.stat().st_mtime_ns]:
            found[part] = teacher
    return found


@lru_cache(maxsize=1)
def _journal(path: Path) -> Mapping[str, tuple[list[Any], str]]:
    """File -> its latest [size, modification time in ns], and the teacher; damaged lines are skipped."""
    entries: dict[str, tuple[list[Any], str]] = {}
    for entry in json_lines(path.read_bytes()) if path.is_file() else ():
        try:
            stamp = [entry["stamp"][name] for name in ("size", "changed_ns")]
            entries[entry["file"]] = (stamp, str(entry["made_by"]))
        except (ValueError, TypeError, KeyError):
            continue
    return entries
