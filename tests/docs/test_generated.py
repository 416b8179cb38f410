"""The generated parts of the documentation, and what its pages say about the program."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterable
from types import ModuleType

import pytest

import house_rules
import lidar2pano
from installed_families import page_parameters

DOCS = house_rules.ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))


def hook(name: str) -> ModuleType:
    """A Python file of docs/ as a module."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


generated = hook("generated")


def known(quote: str, texts: Iterable[str]) -> bool:
    """Whether some text of the program contains the quoted one."""
    return any(quote.strip(generated.GAP) in text for text in texts)


def test_every_quoted_message_exists():
    page = (DOCS / "guides" / "troubleshooting.md").read_text(encoding="utf-8")
    quotes, texts = generated.quoted(page), generated.texts()
    assert len(quotes) > 10
    assert [quote for quote in quotes if not known(quote, texts)] == []


def test_messages_are_found_with_gaps_for_values(tmp_path):
    (tmp_path / "a.py").write_text(
        "def f(x):\n"
        "    raise InputError(f'{x}: is no {x!r} file' + closest(x))\n"
        "    raise ValueError('not for users')\n"
    )
    found = generated.messages(tmp_path)
    assert found == {"…: is no … file…": "a.py"}
    assert known("is no … file", found)
    assert not known("is no file", found)
    assert "not for users" in generated.texts(tmp_path)


def test_the_command_line_page_has_every_command_and_option():
    text = generated.command_line()
    for name, command in generated.commands():
        assert f"## {name}\n" in text
        for parameter in command.params:
            if parameter.param_type_name == "option" and "--help" not in parameter.opts:
                assert f"`{parameter.opts[0]}" in text, (name, parameter.opts)
    assert "&lt;stem>" in text, "angle brackets in help texts are not HTML"


def test_the_api_page_has_every_public_name():
    names = sorted(set(lidar2pano.__all__) - {"__version__"})
    directives = re.findall(r"^::: lidar2pano\.(\w+)$", generated.api_directives(), flags=re.MULTILINE)
    assert sorted(directives) == names
    assert sorted(re.findall(r"^(?:### |- `)(\w+)(?=$|`: a)", generated.api(), flags=re.MULTILINE)) == names


def test_every_part_is_used():
    used = {part[1] for page in PAGES for part in generated.PART.findall(page.read_text(encoding="utf-8"))}
    assert used == set(generated.PARTS)


@pytest.mark.parametrize("page", page_parameters(PAGES, "weights.md"))
def test_pages_hold_what_the_program_says(page):
    text = page.read_text(encoding="utf-8")
    assert text.count("<!-- generated: ") == len(generated.PART.findall(text))
    assert generated.fill(text, generated.PARTS) == text, "run: make generated"


def test_a_stale_part_is_filled_and_the_rest_is_kept():
    end = "<!-- end of generated -->\n"
    page = f"a\n<!-- generated: x -->\nold\n{end}b\n<!-- generated: y -->\n\n{end}"
    filled = generated.fill(page, {"x": lambda: r"new \1"})
    assert filled == page.replace("old\n", "\nnew \\1\n\n")
    assert generated.fill(filled, {"x": lambda: r"new \1"}) == filled


@pytest.mark.parametrize("name", sorted(set(generated.PARTS) - {"messages", "api", "commands"}))
def test_parts_are_tables(name):
    part = generated.PARTS[name]()
    assert part.startswith(("| ", "### "))
    assert part.count("\n| ") >= 3, part


def test_every_recipe_is_described():
    rows = [row.split(" | ") for row in generated.recipes().splitlines()[2:]]
    assert [row for row in rows if len(row) != 4 or not row[1].strip()] == []
    assert generated._variant("titan-no-range", {"titan", "titan-no-range"}).startswith("`titan` without range")
    assert generated._variant("a-mini", {"a", "a-mini"}) == "`a` for two CPU cores."


def test_links_lead_to_the_site_or_the_repository():
    text = "[a](docs/world.md) [b](CHANGELOG.md) [c](runs/release.sh) [d](https://x.org) ![e](docs/p.jpg) [f](#g)"
    repository = f"{generated.REPOSITORY}/runs/release.sh"
    assert generated.site_links(text, generated.ROOT) == (
        f"[a](world.md) [b](changelog.md) [c]({repository}) [d](https://x.org) ![e](p.jpg) [f](#g)"
    )
    guide = "[a](../world.md) [b](../../RESULTS.md#times) [c](../../runs/release.sh) [d](view.md)"
    assert generated.site_links(guide, DOCS / "guides") == (
        f"[a](../world.md) [b](../results.md#times) [c]({repository}) [d](view.md)"
    )


@pytest.mark.parametrize(
    ("tag", "outside"),
    [
        ('<script src="https://x.org/a.js">', True),
        ('<link href="https://x.org/a.css" rel="stylesheet">', True),
        ('<link rel="stylesheet" href="assets/a.css">', False),
        ('<img alt="" src="http://x.org/a.png">', True),
        ('<a href="https://x.org/">', False),
    ],
)
def test_what_a_page_loads_from_elsewhere_is_found(tag, outside):
    assert bool(generated.OUTSIDE.search(tag)) == outside


def test_columns_of_docstrings_are_fenced():
    fenced = hook("docstrings").fenced
    text = "First sentence.\n\nxyz        (N, 3) float32.\nremission  (N,) float32,\n           in [0, 1].\nRaises."
    assert fenced(text) == (
        "First sentence.\n\n"
        "```text\nxyz        (N, 3) float32.\nremission  (N,) float32,\n           in [0, 1].\n```\n\nRaises."
    )
    assert fenced("Plain text.\n\nMore of it.") == "Plain text.\n\nMore of it."


def test_docstrings_are_no_markdown():
    fenced = hook("docstrings").fenced
    assert fenced("P2 [x y z] * 2, `a[0] * b`, <stem>.png") == r"P2 \[x y z\] \* 2, `a[0] * b`, &lt;stem>.png"
