"""What README, the quick start and the guides tell readers to type: their shell lines and Python blocks."""

from __future__ import annotations

import re
import shlex
from typing import NamedTuple

from house_rules import ROOT

PAGES: dict[str, str] = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
}
TASKS = [page for page in PAGES if page in ("README.md", "docs/start.md") or page.startswith("docs/guides/")]
FILE_IN_COMMENT = re.compile(r"(?<![\w./-])[\w/-]+\.(?:png|html|mp4|rrd|ply)\b")


class Line(NamedTuple):
    """A shell line: its page, the words, and the comment behind them."""

    page: str
    text: str
    comment: str

    @property
    def words(self) -> list[str]:
        """The words as a shell splits them."""
        return shlex.split(self.text)

    @property
    def promised_files(self) -> list[str]:
        """Files that the comment names."""
        return FILE_IN_COMMENT.findall(self.comment)


def blocks(text: str, language: str) -> list[str]:
    """Return the insides of the fenced blocks of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)


def shell_lines(page: str, text: str) -> list[Line]:
    """Return the shell lines of a page, joined where they go on, without lines of comments alone."""
    lines = "\n".join(blocks(text, "sh")).replace("\\\n", " ").splitlines()
    parts = [re.match(r"(.*?)(?:\s#\s*(.*))?$", line) for line in lines if line.strip() and not line.startswith("#")]
    return [Line(page, " ".join(part[1].split()), part[2] or "") for part in parts if part]


def typed(text: str) -> list[list[str]]:
    """Return the words of every command `lidar2pano ...` in a text's shell blocks."""
    return [line.words for line in shell_lines("", text) if line.text.startswith("lidar2pano ")]
