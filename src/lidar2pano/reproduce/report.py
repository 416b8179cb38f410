"""What a reproduction writes: RESULTS.md, sheets of pictures, training curves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lidar2pano.formats.image_files import write_whole
from lidar2pano.reproduce.curves import write_curves
from lidar2pano.reproduce.plan import Plan
from lidar2pano.reproduce.run import Outcome
from lidar2pano.reproduce.sheets import write_sheets
from lidar2pano.reproduce.tables import report


def write_report(plan: Plan, outcome: Outcome) -> Path:
    """Write DIR/RESULTS.md with the pictures it shows; return its path."""
    names = {"truth": "truth"} | {name: row.name for name, row in plan.rows.items()}
    sheets = write_sheets(plan.out / "pictures", plan.out / "sheets", names)
    curves = write_curves({part: plan.run(part) for part in plan.parts}, plan.out / "sheets" / "curves.png")
    text = report(plan, outcome, sheets, curves)
    return write_whole(plan.out / "RESULTS.md", lambda path: path.write_text(text, encoding="utf-8"))


def records(plan: Plan, outcome: Outcome) -> list[dict[str, Any]]:
    """Every figure of every row, ready for CSV."""
    return [
        {"row": name, "approach": plan.rows[name].name, **one}
        for name, result in outcome.results.items()
        for one in result["results"][0]["figures"]
    ]
