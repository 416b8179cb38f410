"""What the repository says about itself: one version everywhere, costs as measured, licences as they are."""

from __future__ import annotations

import re
import runpy
import tomllib
from pathlib import Path

import pytest

import house_rules
import lidar2pano
from installed_families import needs_streets, page_parameters
from lidar2pano.models.card import read_card
from lidar2pano.models.families import weight_files

ROOT = house_rules.ROOT
README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_the_citation_names_this_version():
    lines = (ROOT / "CITATION.cff").read_text(encoding="utf-8").splitlines()
    assert f"version: {lidar2pano.__version__}" in lines


@needs_streets
def test_the_readme_states_the_measured_costs():
    readme = runpy.run_path(str(ROOT / "runs" / "readme.py"))
    results = (ROOT / "RESULTS.md").read_text(encoding="utf-8")
    written = README.partition(readme["BEGIN"])[2].partition(readme["END"])[0]
    expected = readme["costs"](results, 1024.0).partition(readme["BEGIN"])[2].partition(readme["END"])[0]
    skipping_memory = [[line for line in text.splitlines() if "| memory" not in line] for text in (written, expected)]
    assert skipping_memory[0] == skipping_memory[1], "run runs/readme.py"
    assert "| memory | " in written


def test_the_results_are_those_of_the_measured_scores():
    results = runpy.run_path(str(ROOT / "runs" / "results.py"))
    assert (ROOT / "RESULTS.md").read_text(encoding="utf-8") == results["text"](), "run runs/results.py"


@needs_streets
def test_the_cards_state_the_measured_scores():
    measured = runpy.run_path(str(ROOT / "runs" / "card_scores.py"))["measured"]
    for family in ("streets", "world"):
        for role, file in weight_files(family).items():
            assert read_card(file).score == measured(family, role), "run runs/card_scores.py"


def test_scores_that_were_not_measured_are_dashes(tmp_path):
    results = runpy.run_path(str(ROOT / "runs" / "results.py"))
    (tmp_path / "val.csv").write_text(
        "system,sector,metric,value,low,high,frames\nworld,camera,miou,0.25,0.2,0.3,14\nworld,camera,accuracy,,,,14\n"
    )
    scores = dict.fromkeys(results["SETS"], {}) | {"val": results["read_scores"](tmp_path / "val.csv")}
    page = results["page"](scores, {"times": "no time"})
    assert "| camera: mIoU of 14 classes, % | KITTI | - | 25.0 (20.0 to 30.0) | 31.1 | 54.8 |" in page
    assert "| camera: accuracy, % | KITTI | - | - | - | - |" in page and "14 street images" in page
    assert page.endswith("## Times\n\nno time\n")


def test_the_time_is_that_of_the_whole_panorama():
    time_of = runpy.run_path(str(ROOT / "runs" / "readme.py"))["time_of"]
    text = "device cpu, threads 4, runs 9\n\n| stage save | 5.0 | 4 |\n| whole panorama | 1161.4 | 1117.6 |\n"
    assert time_of(text) == ("1161.4", "4")
    arithmetic_of = runpy.run_path(str(ROOT / "runs" / "readme.py"))["arithmetic_of"]
    assert arithmetic_of(text) == "torch; float32"
    line = "device cpu, threads 2, bfloat16 True, torch 2.13.0+cpu, buffers kept True, engine openvino"
    assert arithmetic_of(f"# Results\n{line}\n") == "OpenVINO, extra `fast`; bfloat16 in hardware"
    with pytest.raises(SystemExit, match="whole panorama"):
        time_of("device cuda, threads 4\n| whole panorama | 1.0 | 1 |\n")


PAGES = [*ROOT.glob("*.md"), *(ROOT / "examples").glob("*.md"), *(ROOT / "docs").rglob("*.md")]


def heading_names(text: str) -> set[str]:
    """The names of a page's headings, as repository hosts make them."""
    prose = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    titles = re.findall(r"^#+ (.+)$", prose, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.strip().lower()).replace(" ", "-") for title in titles}


def broken_links(page: Path) -> list[str]:
    """Relative links of a page that lead to no file of the repository, or to no heading of it."""
    links = re.findall(r"\]\((?!https?:|mailto:)([^)\s]+)\)", page.read_text(encoding="utf-8"))
    broken = []
    for link in links:
        name, _, heading = link.partition("#")
        target = page.parent / name if name else page
        if not target.exists() or (heading and heading not in heading_names(target.read_text(encoding="utf-8"))):
            broken.append(link)
    return broken


@pytest.mark.parametrize("page", page_parameters(PAGES, "README.md"))
def test_links_lead_somewhere(page):
    assert broken_links(page) == []


def test_broken_links_are_found(tmp_path):
    (tmp_path / "b.md").write_text("# On a GPU, now\n")
    page = tmp_path / "a.md"
    page.write_text("# A\n[1](b.md) [2](b.md#on-a-gpu-now) [3](#a) [4](c.md) [5](b.md#on) [6](#b) ![7](x.png)\n")
    assert broken_links(page) == ["c.md", "b.md#on", "#b", "x.png"]


@pytest.mark.parametrize("page", page_parameters(PAGES))
def test_pages_are_plain_markdown(page):
    """Admonitions and other extensions of mkdocs are raw text on a repository host."""
    assert re.findall(r"^(?:!!!|\?\?\?|=== |::: ).*", page.read_text(encoding="utf-8"), flags=re.MULTILINE) == []


def test_contributing_lists_the_floors():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| (\d) \| (.*?) \|", text, flags=re.MULTILINE))
    listed = [set(re.findall(r"`(\w+)`", rows[str(floor)])) for floor in range(len(house_rules.FLOORS))]
    floors = [set(floor) - {"__main__"} for floor in house_rules.FLOORS]
    floors[0] |= house_rules.ANYWHERE
    assert listed == floors


def test_the_tree_of_the_readme_has_every_module():
    tree = README.partition("## The tree")[2].partition("\n## ")[0]
    listed = set(re.findall(r"[\w.]+/?(?= )", tree.partition("src/lidar2pano/")[2].partition("docs/ ")[0]))
    present = {f"{path.name}/" if path.is_dir() else path.name for path in house_rules.SOURCE.glob("[!_.]*")}
    assert present - {"py.typed"} - listed == set()
    assert {name for name in listed if name.endswith((".py", "/"))} - present == set()
