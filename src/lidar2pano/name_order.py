"""The order of names: numbers in them compare as numbers: "scan2" comes before "scan10"."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import partial
from pathlib import Path, PurePath
from typing import TypeVar

NameT = TypeVar("NameT", str, Path)
DIGITS = re.compile(r"([0-9]+)")
DECIMAL = re.compile(r"([0-9]+)\.([0-9]+)(?![0-9.]*[0-9])")  # seconds before an ending: "12.5.pcd", but not "1.2.3"
Part = tuple[int, str, str] | str


def sort_names(names: Iterable[NameT]) -> list[NameT]:
    """Return names or paths in order: folder by folder, numbers by their values; equal numbers compare as text.

    A name with a decimal number at its beginning is a time, "3.5" after "3.25"; unless "3.10" is among names
    with fewer digits: a time is not written so, but the tenth frame is.
    """
    names = list(names)
    times = [time[2] for name in names if (time := DECIMAL.match(PurePath(name).name))]
    counted = len({len(digits) for digits in times}) > 1 and any(re.fullmatch(r"[0-9]+0", digits) for digits in times)
    return sorted(names, key=partial(_key, decimal=not counted))


def sort_listed(names: list[NameT]) -> list[NameT]:
    """Return names in order if they are sorted as text, as a shell's pattern lists them; else as they are."""
    return sort_names(names) if names == sorted(names, key=str) else names


def _key(name: str | PurePath, decimal: bool) -> tuple[tuple[tuple[Part, ...], ...], str]:
    text = name.as_posix() if isinstance(name, PurePath) else name
    return tuple(_parts(folder, decimal) for folder in text.split("/")), text


def _parts(text: str, decimal: bool) -> tuple[Part, ...]:
    """Return text, number, text, number ... in turn."""
    if decimal and (time := DECIMAL.match(text)):
        return "", _number(time[1], time[2].rstrip("0")), *_parts(text[time.end() :], decimal)
    parts = DIGITS.split(text)
    return tuple(_number(part) if place % 2 else part for place, part in enumerate(parts))


def _number(digits: str, fraction: str = "") -> Part:
    """Return the key of a number of any length: the more digits, the greater."""
    whole = digits.lstrip("0")
    return len(whole), whole, fraction
