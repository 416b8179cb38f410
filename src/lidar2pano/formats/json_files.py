"""The gate for JSON from outside: bounded in size and depth, finite numbers, and typed values out of it.

All JSON passes here once: `read_json` and `parse_json` give plain values, `validated` makes a dataclass of them, and
`table_rows` reads a list of flat objects piece by piece, however large it is. It is not checked again elsewhere.
"""

from __future__ import annotations

import json
import math
import types
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from lidar2pano.bounded_files import MOST_TEXT_BYTES, open_regular, read_input
from lidar2pano.errors import InputError, closest

MOST_BUILT_BYTES = 1 << 28  # of a text and of the objects that its values become
# Bytes of an object that begins with a character, in CPython: dictionary, list, number and its place, text (of two).
OBJECT_BYTES = {"{": 240, "[": 64, ",": 32, '"': 25}
DEEPEST = 64  # lists and objects within each other
LARGEST = 2**63  # of whole numbers
BLOCK_BYTES = 1 << 22  # of a table are read at a time: nuScenes' sample_data.json has 2.6 million rows in 1.2 GB
LONGEST_ROW = 1 << 20
INCOMPLETE = "complete the data set"
NAMES = {bool: "true or false", int: "a whole number", float: "a number", str: "a text", type(None): "null"}
T = TypeVar("T")


def read_json(path: Path, mend: str = INCOMPLETE, *, nan: bool = False) -> Any:
    """Read a JSON file; InputError if it is missing, no regular file, too large, or refused by `parse_json`."""
    return parse_json(read_input(path, mend), str(path), mend, nan=nan)


def parse_json(data: str | bytes, source: str, mend: str = "replace it", *, nan: bool = False) -> Any:
    """Return the value of a JSON text; `source` begins the message of its InputError.

    Refused are texts over MOST_TEXT_BYTES or of many values (MOST_BUILT_BYTES), values nested deeper than DEEPEST, and
    numbers not finite or, whole ones, beyond LARGEST.
    nan  whether NaN and Infinity pass all the same: nuScenes' files have them in unused fields.
    """
    if len(data) > MOST_TEXT_BYTES:
        raise InputError(f"{source}: has {len(data)} characters of JSON, at most {MOST_TEXT_BYTES} are read; {mend}")
    if _built_bytes(data) > MOST_BUILT_BYTES:
        raise InputError(f"{source}: has JSON of more values than {MOST_BUILT_BYTES >> 20} MiB hold; {mend}")
    try:
        value = json.loads(data, parse_constant=float if nan else _refuse, parse_float=_finite, parse_int=_whole)
    except RecursionError:
        raise InputError(f"{source}: is no JSON (nested too deeply); {mend}") from None
    except ValueError as error:
        raise InputError(f"{source}: is no JSON ({_short(error)}); {mend}") from None
    if _depth(value) > DEEPEST:
        raise InputError(f"{source}: is no JSON (nested too deeply); {mend}")
    return value


def _built_bytes(data: str | bytes) -> int:
    """Return the memory that a JSON text and its values take, about; characters within its texts count, too."""
    built = len(data)
    for mark, size in OBJECT_BYTES.items():
        built += size * (data.count(mark) if isinstance(data, str) else data.count(mark.encode()))
    return built


def json_lines(data: bytes) -> Iterator[dict[str, Any]]:
    """Yield the objects of a journal, one a line; torn lines and other values are passed over."""
    for line in data.splitlines():
        try:
            entry = parse_json(line, "")
        except InputError:
            continue
        if isinstance(entry, dict):
            yield entry


def table_rows(path: Path, is_needed: Callable[[bytes], object] = lambda _: True) -> Iterator[dict[str, Any]]:
    """Yield the rows of a file: a list of objects without objects (or braces in a text) in them.

    is_needed  (text of a row without its braces) -> whether the row is parsed.
    Memory holds one piece of the file at a time. Raises InputError if the file is missing, damaged or ends early;
    only needed rows are looked into.
    """
    expected_separator, rest = b"[", b""
    for block in _blocks(path):
        *rows, rest = (rest + block).split(b"}")
        for row in rows:
            separator, brace, fields = row.partition(b"{")
            if not brace or separator.strip() != expected_separator:
                raise InputError(f"{path}: is no list of flat objects; {INCOMPLETE}")
            expected_separator = b","
            if is_needed(fields):
                yield parse_json(b"{%b}" % fields, str(path), INCOMPLETE)
        if len(rest) > LONGEST_ROW:
            raise InputError(f"{path}: has a row of more than {LONGEST_ROW} bytes; {INCOMPLETE}")
    if b"".join(rest.split()) != (b"]" if expected_separator == b"," else b"[]"):
        raise InputError(f"{path}: ends within a row; {INCOMPLETE}")


def _blocks(path: Path) -> Iterator[bytes]:
    try:
        with open_regular(path) as file:
            while block := file.read(BLOCK_BYTES):
                yield block
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {INCOMPLETE}") from error


def validated(cls: type[T], value: Any, source: str, mend: str = "replace it") -> T:  # noqa: ANN401
    """Return an object of the dataclass `cls` from a JSON object, strictly: with the names and types of its fields.

    A whole number may stand for a fraction; nothing else is converted. A field of the type `dict` or `list` takes any.
    Raises InputError for anything else, and if the class itself refuses a value (ValueError, TypeError).
    """
    try:
        return cast(T, _of_type(cls, value, "it"))
    except (ValueError, TypeError) as error:
        raise InputError(f"{source}: {_short(error)}; {mend}") from None


def _of_type(annotation: Any, value: Any, name: str) -> Any:  # noqa: ANN401
    origin, inner = get_origin(annotation) or annotation, get_args(annotation)
    if origin in (Union, types.UnionType):
        return _of_any(inner, value, name)
    if origin in (dict, Mapping):
        return _of_object(inner, value, name)
    if origin in (list, tuple):
        return _of_list(origin, inner, value, name)
    return _of_dataclass(origin, value, name) if is_dataclass(origin) else _plain(annotation, value, name)


def _plain(annotation: Any, value: Any, name: str) -> Any:  # noqa: ANN401
    """Return a value without parts: of a Literal, or of one of NAMES."""
    if get_origin(annotation) is Literal:
        if not isinstance(value, str) or value not in get_args(annotation):
            raise ValueError(f"{name} must be one of {', '.join(map(str, get_args(annotation)))}")
    elif annotation is float and type(value) is int:
        return float(value)
    elif annotation is not Any and type(value) is not annotation:
        raise ValueError(f"{name} must be {NAMES.get(annotation, annotation)}")
    return value


def _of_object(inner: tuple[Any, ...], value: Any, name: str) -> Any:  # noqa: ANN401
    if not isinstance(value, dict):
        raise ValueError(f"{name} must be an object")
    return {key: _of_type(inner[1], part, f"{name}.{key}") for key, part in value.items()} if inner else value


def _of_any(choices: tuple[Any, ...], value: Any, name: str) -> Any:  # noqa: ANN401
    for choice in choices:
        try:
            return _of_type(choice, value, name)
        except ValueError:
            continue
    raise ValueError(f"{name} must be {' or '.join(NAMES.get(choice, str(choice)) for choice in choices)}")


def _of_list(made: type, inner: tuple[Any, ...], value: Any, name: str) -> Any:  # noqa: ANN401
    if not isinstance(value, list):
        raise ValueError(f"{name} must be a list")
    if made is tuple and inner and inner[-1] is not Ellipsis:
        if len(value) != len(inner):
            raise ValueError(f"{name} must be a list of {len(inner)}")
        return tuple(_of_type(element, part, name) for element, part in zip(inner, value, strict=True))
    return made(_of_type(inner[0] if inner else Any, part, name) for part in value)


def _of_dataclass(annotation: Any, value: Any, name: str) -> Any:  # noqa: ANN401
    if not isinstance(value, dict):
        raise ValueError(f"{name} must be an object")
    hints, known_fields = get_type_hints(annotation), {field.name: field for field in fields(annotation) if field.init}
    if (unknown := next((key for key in value if key not in known_fields), None)) is not None:
        raise ValueError(f"{name} has an unknown field {unknown!r}{closest(unknown, known_fields)}")
    for field in known_fields.values():
        if field.name not in value and field.default is MISSING and field.default_factory is MISSING:
            raise ValueError(f"{name} has no {field.name!r}")
    return annotation(**{key: _of_type(hints[key], part, _below(name, key)) for key, part in value.items()})


def _below(name: str, key: str) -> str:
    return f"its {key!r}" if name == "it" else f"{name}.{key}"


def _depth(value: Any) -> int:  # noqa: ANN401
    """Return the depth of nested lists and objects, counted level by level: one more than DEEPEST at most."""
    level, depth = [value] if isinstance(value, dict | list) else [], 0
    while level and depth <= DEEPEST:
        nested = (parent.values() if isinstance(parent, dict) else parent for parent in level)
        level = [part for parts in nested for part in parts if isinstance(part, dict | list)]
        depth += 1
    return depth


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not a number")


def _finite(text: str) -> float:
    if not math.isfinite(number := float(text)):
        raise ValueError(f"{text[:20]} is beyond what float64 represents")
    return number


def _whole(text: str) -> int:
    if len(text) > 20 or not -LARGEST <= (number := int(text)) < LARGEST:
        raise ValueError(f"{text[:20]}... is beyond 64 bits")
    return number


def _short(error: Exception) -> str:
    return str(error).partition("\n")[0]
