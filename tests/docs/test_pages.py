"""What the pages tell readers to type: commands have the options that are shown, and the guide's Python runs."""

from __future__ import annotations

import functools
import re
import shlex
import shutil
from itertools import pairwise
from typing import Any

import pytest
from typer.main import get_command

import house_rules
from lidar2pano import demo
from lidar2pano.cli import app
from lidar2pano.train.recipe import override
from lidar2pano.train.recipes import recipe_named

PAGES = {
    path.relative_to(house_rules.ROOT).as_posix(): path.read_text(encoding="utf-8")
    for path in [house_rules.ROOT / "README.md", *sorted((house_rules.ROOT / "docs").rglob("*.md"))]
}
CALIB = """P2: 718.856 0 607.1928 45.38225 0 718.856 185.2157 -0.1130887 0 0 1 0.003779761
Tr: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27
"""


def blocks(text: str, language: str) -> list[str]:
    """The insides of the fenced blocks of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)


def typed(text: str) -> list[list[str]]:
    """The words of every command `lidar2pano ...` in the text's shell blocks."""
    lines = "\n".join(blocks(text, "sh")).replace("\\\n", " ").splitlines()
    return [shlex.split(line, comments=True) for line in lines if line.startswith("lidar2pano ")]


@functools.cache
def program() -> Any:
    """The click command of the program."""
    return get_command(app)


def unknown(words: list[str]) -> list[str]:
    """Commands and options among a command line's words that the program does not have."""
    command, rest = program(), words[1:]
    while getattr(command, "commands", None) and rest:
        name, *rest = rest
        if name not in command.commands:
            return [name]
        command = command.commands[name]
    options = {flag for parameter in command.params for flag in parameter.opts}
    return [word for word in rest if word.startswith("--") and word not in options | {"--help"}]


@pytest.mark.parametrize("page", [name for name, text in PAGES.items() if typed(text)])
def test_commands_have_the_options_on_the_page(page):
    assert [(words, unknown(words)) for words in typed(PAGES[page]) if unknown(words)] == []


@pytest.mark.parametrize("page", [name for name, text in PAGES.items() if "--set " in "\n".join(blocks(text, "sh"))])
def test_changes_of_recipes_are_accepted(page):
    for words in typed(PAGES[page]):
        if words[1] == "train":
            recipe = recipe_named(words[2])
            for before, change in pairwise(words):
                recipe = override(recipe, change) if before == "--set" else recipe


def test_unknown_options_are_found():
    text = "```sh\nlidar2pano translate a.bin --out b  # comment --no\nlidar2pano train x \\\n  --dta y\nmake\n```\n"
    assert [unknown(words) for words in typed(text)] == [[], ["--dta"]]
    assert unknown(["lidar2pano", "weights", "lst"]) == ["lst"]


def test_the_python_guide_runs(tmp_path, monkeypatch, random_weights):
    (tmp_path / "drive").mkdir()
    for name in ("scan.bin", "drive/000000.bin"):
        shutil.copy(demo.street(), tmp_path / name)
    (tmp_path / "calib.txt").write_text(CALIB)
    monkeypatch.chdir(tmp_path)
    code = blocks(PAGES["docs/guides/python.md"].replace('"kitti-mini"', repr(str(random_weights))), "python")
    assert len(code) > 3
    names: dict[str, object] = {}
    for block in code:
        exec(compile(block, "python.md", "exec"), names)
    assert {path.name for path in (tmp_path / "panoramas").iterdir()} == {
        "000000.png",
        "my-scan.png",
        "my-scan.depth.png",
    }
