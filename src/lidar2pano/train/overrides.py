"""One value changed by its dotted name in nested frozen dataclasses and dictionaries, strictly by name and by type."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, Literal, cast, get_args, get_origin, get_type_hints

from lidar2pano.errors import InputError, closest

Value = bool | int | float | str | tuple
SWITCH = {"true": True, "false": False}
LARGEST = 2**53  # whole numbers that float64 represents


def changed(node: Any, steps: list[str], text: str, path: str) -> Any:  # noqa: ANN401
    """A copy of `node` with the value at `steps` below it parsed from `text`; `path` is its full name in messages."""
    name, *rest = steps
    if is_dataclass(node):
        known: Any = {one.name: getattr(node, one.name) for one in fields(node)}
        wanted_type = get_type_hints(type(node)).get(name)
    elif isinstance(node, Mapping):
        known, wanted_type = node, None
    else:
        raise InputError(f"{path}: {type(node).__name__} values have no parts; leave out {'.'.join(steps)!r}")
    if name not in known:
        owner = type(node).__name__ if is_dataclass(node) else "this recipe"
        raise InputError(f"{path}: {owner} has no {name!r}{closest(name, known)}")
    old = known[name]
    if rest:
        new = changed(old, rest, text, path)
    elif is_dataclass(old) or isinstance(old, Mapping):
        inner = [one.name for one in fields(old)] if is_dataclass(old) else list(old)
        raise InputError(f"{path} holds several values; set one of them: {', '.join(inner)}")
    else:
        new = _parsed(text, wanted_type or _type_of(old), path)
    return {**node, name: new} if isinstance(node, Mapping) else replace(cast(Any, node), **{name: new})


def _type_of(value: Any) -> Any:  # noqa: ANN401
    """The type to parse for a dictionary's entry: that of the value that is there."""
    if isinstance(value, tuple | list):
        return tuple[type(value[0]) if value else str, ...]
    return type(value)


def _parsed(text: str, wanted_type: Any, path: str) -> Value:  # noqa: ANN401
    """`text` as a value of `wanted_type`: bool, int, float, str, a Literal of strings, or a tuple of one of them."""
    if get_origin(wanted_type) is Literal:
        if text not in get_args(wanted_type):
            raise InputError(f"{path} cannot be {text!r}{closest(text, get_args(wanted_type))}")
        return text
    if get_origin(wanted_type) is tuple:
        first, *others = get_args(wanted_type)
        parts = [part.strip() for part in text.strip("()[]").split(",") if part.strip()]
        if others and others[-1] is not Ellipsis and len(parts) != len(others) + 1:
            raise InputError(f"{path} wants {len(others) + 1} values with commas between, not {text!r}")
        return tuple(_parsed(part, first, path) for part in parts)
    if wanted_type is str:
        return text
    if wanted_type is bool:
        if text.lower() not in SWITCH:
            raise InputError(f"{path} wants true or false, not {text!r}")
        return SWITCH[text.lower()]
    try:
        number = wanted_type(text)
    except ValueError:  # more digits than Python reads are one, too
        number = math.nan
    if not abs(number) < (LARGEST if wanted_type is int else math.inf):
        wanted = "a whole number" if wanted_type is int else "a number"
        raise InputError(f"{path} wants {wanted}, not {text[:40]!r}")
    return number
