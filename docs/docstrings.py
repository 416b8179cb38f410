"""A griffe extension: parts of docstrings that are set in columns (name, shape, meaning) keep their columns."""

from __future__ import annotations

import re
from typing import Any

import griffe

COLUMNS = re.compile(r"^\S.{0,60}?\s{2,}\S")  # a name, then at least two blanks, then its description


class Columns(griffe.Extension):
    """Fence the paragraphs of docstrings that align text in columns, since Markdown would join their lines."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:  # noqa: ANN401
        """Change the docstring of one object in place."""
        if obj.docstring:
            obj.docstring.value = fenced(obj.docstring.value)


def fenced(text: str) -> str:
    """The docstring with its column paragraphs in fences and each "Raises" sentence in a paragraph of its own."""
    return "\n\n".join(_paragraph(part) for part in text.split("\n\n"))


def _paragraph(text: str) -> str:
    lines = text.split("\n")
    first = next((number for number, line in enumerate(lines) if COLUMNS.match(line)), None)
    if first is None:
        return text
    last = max(n for n, line in enumerate(lines) if COLUMNS.match(line) or (n > first and line.startswith("  ")))
    before, table, after = lines[:first], lines[first : last + 1], lines[last + 1 :]
    parts = ["\n".join(before), "\n".join(["```text", *table, "```"]), "\n".join(after)]
    return "\n\n".join(part for part in parts if part)
