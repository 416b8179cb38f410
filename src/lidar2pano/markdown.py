"""Parts of Markdown pages: tables and headers."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence


def front_matter(fields: Mapping[str, object]) -> str:
    """Return the YAML header of a Markdown page, as hubs of models and data sets read it: JSON values are YAML."""
    lines = (f"{key}: {json.dumps(value, ensure_ascii=False)}\n" for key, value in fields.items())
    return "---\n" + "".join(lines) + "---\n"


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table whose columns are aligned to the right, but for the first."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
