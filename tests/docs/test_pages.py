"""What the pages tell readers to type: commands have the options that are shown, and the guide's Python runs."""

from __future__ import annotations

import functools
import shutil
from itertools import pairwise
from typing import Any

import pytest
from typer.main import get_command

from documented import PAGES, blocks, typed
from lidar2pano import demo
from lidar2pano.cli import app
from lidar2pano.train.recipe import override
from lidar2pano.train.recipes import recipe_named
from map_street import street_points, write_las
from workshop import CALIB


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
    write_las(tmp_path / "map.laz", street_points(0.2)[0])
    monkeypatch.chdir(tmp_path)
    code = blocks(PAGES["docs/guides/python.md"].replace('"streets"', repr(str(random_weights))), "python")
    assert len(code) > 3
    names: dict[str, object] = {}
    for block in code:
        exec(compile(block, "python.md", "exec"), names)
    assert {path.name for path in (tmp_path / "panoramas").iterdir()} == {
        "000000.png",
        "my-scan.png",
        "my-scan.depth.png",
    }
