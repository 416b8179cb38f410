"""A metadata hook of hatchling: the package index's page is README.md with absolute addresses.

An index shows a README beside no repository: links and pictures that are relative there lead into the repository that
[project.urls] names.
"""

from __future__ import annotations

import re
from pathlib import Path

from hatchling.metadata.plugin.interface import MetadataHookInterface

RELATIVE = re.compile(r"(!?)\[([^]]*)\]\((?!https?:|mailto:|#)([^)\s]+)\)")


class IndexReadme(MetadataHookInterface):
    """Fill in the dynamic field `readme`."""

    def update(self, metadata: dict) -> None:
        """Set the readme of a project's metadata."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        text = absolute(text, metadata["urls"]["Homepage"])
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


def absolute(text: str, repository: str) -> str:
    """Return Markdown whose relative links and pictures lead into a repository."""

    def moved(match: re.Match[str]) -> str:
        picture, title, target = match.groups()
        return f"{picture}[{title}]({repository}/{'raw' if picture else 'blob'}/main/{target})"

    return RELATIVE.sub(moved, text)
