"""Mutants: what bytes, texts and JSON values become when they are damaged or written by somebody hostile."""

from __future__ import annotations

import copy
import json
import random
import struct
from collections.abc import Sequence
from typing import Any

ODD_WORDS = [
    *("", "nan", "-nan", "inf", "-inf", "NaN", "Infinity", "1e999", "-1e999", "1e38", "1e-320", "-0", "0", "-1", "2"),
    *("255", "256", "65535", "65536", "2147483647", "2147483648", "4294967295", "4294967296", "9223372036854775808"),
    *("9" * 400, "0x10", "1_000", "1,5", "١٢", "true", "null", "[]", "{}", "\x00", "\x1b[2J", "\u202e", "é", "\ud800"),
    *("../../etc/passwd", "/dev/zero", "a" * 300, "%s%n", "{0}", "'", '"', "<script>", "\n", "\r\n", "\t"),
]
ODD_BYTES = [
    *(b"", b"\x00", b"\xff", b"\x7f", b"\x80", b"\x00" * 8, b"\xff" * 8, b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f"),
    *(struct.pack("<f", value) for value in (float("nan"), float("inf"), -float("inf"), 1e38, -1e-40)),
    *(struct.pack("<q", value) for value in (-1, 2**31, 2**63 - 1, -(2**63))),
    *(word.encode("utf-8", "surrogatepass") for word in ODD_WORDS[:40]),
]
ODD_VALUES: list[Any] = [
    *(None, True, False, 0, -1, 1, 2, 0.5, -0.0, 1e308, 2**31, 2**53, 2**63 - 1, -(2**63), "", "a", "nan", "0", [], {}),
    *([0], [[]], [None], {"": 0}, {"a": []}, ["x"] * 5, [0] * 16, [[1, 0, 0, 0]] * 4, [[1.5] * 3] * 3, "x" * 1000),
]


def mutant(draw: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """A damaged copy of `data`: one to four changes of its bytes; `others` are what pieces are taken from."""
    content = bytearray(data)
    for _ in range(draw.choice((1, 1, 1, 2, 4))):
        start = draw.randrange(len(content) + 1)
        stop = min(len(content), start + draw.choice((0, 1, 1, 2, 4, 8, 64, 1024)))
        change = draw.randrange(6)
        if change == 0 and content:  # a bit
            content[start - 1] ^= 1 << draw.randrange(8)
        elif change == 1:  # cut off
            del content[start:]
        elif change == 2:  # a piece is gone
            del content[start:stop]
        elif change == 3:  # a piece is there twice
            content[start:start] = content[start:stop]
        elif change == 4:  # odd bytes instead
            content[start:stop] = draw.choice(ODD_BYTES)
        else:  # a piece of another file
            other = draw.choice(others)
            place = draw.randrange(len(other) + 1)
            content[start:stop] = other[place : place + draw.choice((4, 32, 256))]
    return bytes(content)


def odd_text(draw: random.Random, data: bytes) -> bytes:
    """A copy of a text with one to three of its words replaced by odd ones."""
    words = data.split(b" ")
    for _ in range(draw.choice((1, 1, 2, 3))):
        words[draw.randrange(len(words))] = draw.choice(ODD_WORDS).encode("utf-8", "surrogatepass")
    return b" ".join(words)


def odd_json(draw: random.Random, data: bytes) -> bytes:
    """A copy of a JSON text with one to three of its values replaced, removed or renamed."""
    value = json.loads(data)
    for _ in range(draw.choice((1, 1, 2, 3))):
        value = _changed(draw, value)
    return json.dumps(value).encode()


def _changed(draw: random.Random, value: Any) -> Any:
    if draw.random() < 0.25 or not isinstance(value, dict | list) or not value:
        return copy.deepcopy(draw.choice(ODD_VALUES))
    key = draw.choice(list(value)) if isinstance(value, dict) else draw.randrange(len(value))
    change = draw.randrange(8)
    if change == 0:
        del value[key]
    elif change == 1 and isinstance(value, dict):
        value[draw.choice(ODD_WORDS)] = value.pop(key)
    else:
        value[key] = _changed(draw, value[key])
    return value
