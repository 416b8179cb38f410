"""Figures in prose: what a page says is what docs/results holds, to the digits that the page prints."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import pytest

from documented import PAGES
from house_rules import ROOT

RESULTS = ROOT / "docs" / "results"
PROSE = {page: text for page, text in PAGES.items() if not page.startswith(("docs/reproduce", "docs/results"))}
TIMES = {
    name: float(value)
    for name, value in re.findall(
        r"^\| ([\w -]+?) \| ([\d.]+) \|", (RESULTS / "times.txt").read_text(encoding="utf-8"), flags=re.MULTILINE
    )
}
NUMBER = r"(\d+(?:\.\d+)?)"
FIGURES = {  # a phrase with a number -> the measured value
    rf"{NUMBER} s per panorama on": TIMES["whole panorama"] / 1000,
    rf"{NUMBER} ms for the whole panorama": TIMES["whole panorama"],
    rf"PNG\s+takes {NUMBER} m(?:illi)?s": TIMES["stage save"],
}


def score(family: str, metric: str, sector: str = "camera") -> float:
    """A value of docs/results/val.csv."""
    with (RESULTS / "val.csv").open(encoding="utf-8", newline="") as file:
        rows = {(row["system"], row["sector"], row["metric"]): row["value"] for row in csv.DictReader(file)}
    return float(rows[family, sector, metric])


def agrees(text: str, value: float) -> bool:
    """Whether a printed number is a value, rounded to its digits; of a whole number the last digit may be one off."""
    digits = len(text.partition(".")[2])
    return abs(float(text) - value) <= (0.5 if digits else 1.0) * 10**-digits + 1e-9


def contradictions(text: str) -> list[str]:
    """Phrases of a page with another number than the measured one."""
    phrases = [(match, value) for pattern, value in FIGURES.items() for match in re.finditer(pattern, text)]
    wrong = [match[0] for match, value in phrases if not agrees(match[1], value)]
    for family in ("streets", "world"):
        named = re.finditer(rf"`{family}`[^.|\n]{{0,40}}mIoU(?: of| is)? {NUMBER} ?%", text)
        wrong += [match[0] for match in named if not agrees(match[1], 100 * score(family, "miou"))]
    return wrong


@pytest.mark.parametrize("page", PROSE)
def test_no_page_contradicts_the_results(page):
    assert contradictions(" ".join(PROSE[page].split(" "))) == []


@pytest.mark.parametrize("pattern", FIGURES)
def test_every_phrase_is_on_some_page(pattern):
    assert any(re.search(pattern, text) for text in PROSE.values())


def test_contradictions_are_found():
    whole, save = TIMES["whole panorama"], TIMES["stage save"]
    assert contradictions(f"{whole / 1000:.1f} s per panorama on 2 cores; a PNG takes {save:.0f} milliseconds") == []
    found = contradictions(
        f"{2 * whole / 1000:.1f} s per panorama on 2 cores; as PNG takes {3 * save:.0f} ms of a core"
    )
    assert len(found) == 2
    miou = 100 * score("world", "miou")
    assert contradictions(f"`world` has a camera mIoU of {miou:.1f} %") == []
    assert len(contradictions(f"`world` has a camera mIoU of {miou + 1:.1f} %")) == 1


def test_the_times_are_read():
    assert {"whole panorama", "stage save", "stage paint"} <= TIMES.keys()
    assert Path(RESULTS / "val.csv").is_file()
