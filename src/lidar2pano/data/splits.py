"""splits.json: the splits of a data set that its user listed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from lidar2pano.errors import InputError, closest
from lidar2pano.formats.json_files import read_json


def is_frame_name(name: str) -> bool:
    """Whether a name has the form "seq/NNNNNN"."""
    return name.count("/") == 1


def listed_splits(listing: Path) -> dict[str, object]:
    """Split -> what the file lists of it, which `listed_names` checks; none without the file.

    Raises InputError where the file is no object.
    """
    splits = read_json(listing) if listing.is_file() else {}
    if not isinstance(splits, dict):
        raise InputError(f"{listing}: must be an object of split -> list of seq/NNNNNN; write it so")
    return splits


def listed_names(
    listing: Path, split: str, form: str = "seq/NNNNNN", accepts: Callable[[str], bool] = is_frame_name
) -> list[str]:
    """The names that the file lists of a split, in its order.

    form, accepts  of a name, for the message and to check it.
    Raises InputError where there is no such split, or it holds anything else.
    """
    splits = listed_splits(listing)
    if split not in splits:
        raise InputError(f"{listing}: has no split {split!r}" + closest(split, splits))
    names = splits[split]
    if not isinstance(names, list) or not all(isinstance(name, str) and accepts(name) for name in names):
        raise InputError(f"{listing}: split {split!r} must be a list of {form}; write it so")
    return names
