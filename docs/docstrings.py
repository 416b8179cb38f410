"""A griffe extension: docstrings are plain text, not Markdown; their columns (name, shape, meaning) stay columns."""

from __future__ import annotations

import re
from typing import Any

import griffe

COLUMNS = re.compile(r"^\S.{0,60}?\s{2,}\S")  # a name, then at least two blanks, then its description


class Columns(griffe.Extension):
    """Make Markdown of docstrings: fences around columns, whose lines Markdown would join, and no accidental syntax."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:  # noqa: ANN401
        """Change the docstring of one object in place."""
        if obj.docstring:
            obj.docstring.value = fenced(obj.docstring.value)


def fenced(text: str) -> str:
    """The docstring as Markdown, with its columns in fences."""
    return "\n\n".join(_paragraph(part) for part in text.split("\n\n"))


def _paragraph(text: str) -> str:
    lines = text.split("\n")
    first = next((number for number, line in enumerate(lines) if COLUMNS.match(line)), None)
    if first is None:
        return _plain(text)
    last = max(n for n, line in enumerate(lines) if COLUMNS.match(line) or (n > first and line.startswith("  ")))
    before, table, after = lines[:first], lines[first : last + 1], lines[last + 1 :]
    parts = [_plain("\n".join(before)), "\n".join(["```text", *table, "```"]), _plain("\n".join(after))]
    return "\n\n".join(part for part in parts if part)


def _plain(text: str) -> str:
    """The text with brackets and stars that Markdown shows as they are; `code` needs no help."""
    spans = re.split(r"(`[^`]*`)", text)
    return "".join(span if span.startswith("`") else _escaped(span) for span in spans)


def _escaped(text: str) -> str:
    return re.sub(r"([\[\]*])", r"\\\1", text).replace("<", "&lt;")
