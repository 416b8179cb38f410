"""Names of the frames of a split: those listed in splits.json, and the files in a folder."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

from lidar2pano.errors import InputError, closest
from lidar2pano.formats.json_files import read_json
from lidar2pano.name_order import sort_names


def is_frame_name(name: str) -> bool:
    """Return whether a name has the form "seq/NNNNNN"."""
    return name.count("/") == 1


def listed_splits(listing: Path) -> dict[str, object]:
    """Return split -> entries of the file, not checked; none without the file.

    Raises InputError if the file is no object.
    """
    splits = read_json(listing) if listing.is_file() else {}
    if not isinstance(splits, dict):
        raise InputError(f"{listing}: must be an object of split -> list of seq/NNNNNN; write it so")
    return splits


def listed_names(
    listing: Path, split: str, form: str = "seq/NNNNNN", accepts: Callable[[str], bool] = is_frame_name
) -> list[str]:
    """Return the names listed for a split, in order.

    form, accepts  of a name, for the message and to check it.
    Raises InputError if there is no such split, or it holds anything else.
    """
    splits = listed_splits(listing)
    if split not in splits:
        raise InputError(f"{listing}: has no split {split!r}" + closest(split, splits))
    names = splits[split]
    if not isinstance(names, list) or not all(isinstance(name, str) and accepts(name) for name in names):
        raise InputError(f"{listing}: split {split!r} must be a list of {form}; write it so")
    return names


def stems(folder: Path, *suffixes: str) -> list[str]:
    """Return sorted stems of the files in a folder with one of the suffixes; none if there is no such folder.

    Files whose names begin with a dot do not count. Raises InputError if the folder may not be read.
    """
    try:
        with os.scandir(folder) as entries:
            names = [entry.name for entry in entries]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise InputError(f"{folder}: cannot be looked into ({error.strerror}); ask for permission") from error
    files = [name for name in names if not name.startswith(".")]
    return sort_names({name[: -len(suffix)] for name in files for suffix in suffixes if name.endswith(suffix)})


def names_with_scans(names: list[str], scans: Callable[[str], Path], split: str = "") -> Iterator[str]:
    """Yield the names "seq/NNNNNN" whose scans NNNNNN.bin are in the folder `scans(seq)`, listed once.

    split  whose names must all have a scan: a missing one is an InputError; "": it is left out.
    """
    files: dict[str, set[str]] = {}
    for name in names:
        sequence, _, stem = name.partition("/")
        if sequence not in files:
            files[sequence] = set(stems(scans(sequence), ".bin"))
        if stem in files[sequence]:
            yield name
        elif split:
            raise InputError(f"{scans(sequence)}: scan {stem}.bin of split {split!r} is missing; complete the data")
