"""The README's Python runs as it stands, from top to bottom, beside a scan file and a folder of scans."""

from __future__ import annotations

import shutil
from typing import Any

import pytest

import house_rules
from documented import blocks

README = house_rules.ROOT / "README.md"
DEMO = house_rules.SOURCE / "demo"


@pytest.fixture
def beside_scans(tmp_path, monkeypatch):
    """A working folder with the scan that ships with the package: as `scan.bin`, by its own name, and in `drive/`."""
    scans = sorted(DEMO.rglob("*.bin"))
    assert scans, f"{DEMO} holds no scan"
    (tmp_path / "drive").mkdir()
    for copy in ("scan.bin", scans[0].name, "drive/000000.bin", "drive/000001.bin"):
        shutil.copy(scans[0], tmp_path / copy)
    for calibration in DEMO.rglob("calib.txt"):
        shutil.copy(calibration, tmp_path / "calib.txt")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_readme_runs(beside_scans):
    text = README.read_text(encoding="utf-8")
    parts = blocks(text, "python")
    assert parts and len(parts) == text.count("```python"), "README.md shows no Python, or not all of it is run"
    names: dict[str, Any] = {"__name__": "__main__"}
    for block in parts:
        exec(compile(block, "README.md", "exec"), names)
    assert names["panorama"].colour.shape == (384, 4608, 3)
    files = {path.name for path in (beside_scans / "panoramas").iterdir()}
    assert files == {"scan.png", "scan.segments.png", "scan.label", "scan.depth.png"}
