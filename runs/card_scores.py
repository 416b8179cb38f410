"""Write the scores of docs/results beside the released weights, and the families' pages: runs/card_scores.py.

A family's scores are those of the set that is like what it is for: `world` in towns, all others on KITTI's `val`.
"""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path

from lidar2pano.models.card import read_card, write_scores
from lidar2pano.models.families import families, weight_files
from lidar2pano.models.hub import PAGE, model_page

RESULTS = runpy.run_path(str(Path(__file__).with_name("results.py")))
MEASURED_ON = {"world": "towns"}  # others: val
METRICS = {  # role -> (sector, metrics)
    "segmenter": (("points", ("miou", "accuracy")),),
    "translator": (("camera", ("miou", "accuracy")), ("panorama", ("miou", "accuracy", "depth_abs_rel"))),
    "painter": (("camera", ("ssim", "swd")), ("panorama", ("ssim", "swd"))),
}


def measured(family: str, role: str) -> dict[str, float | str]:
    """Return a role's scores as its card has them: values by sector and metric, and the set."""
    name = MEASURED_ON.get(family, "val")
    scores = RESULTS["read_scores"](RESULTS["SCORES"] / f"{name}.csv")
    values = {
        f"{sector.removesuffix('s')}_{metric}": scores[family, sector, metric]["value"]
        for sector, metrics in METRICS[role]
        for metric in metrics
        if (family, sector, metric) in scores
    }
    return {key: float(f"{value:.4g}") for key, value in values.items() if value is not None} | {"split": name}


def main() -> None:
    """Write every family's scores and its page."""
    for family in RESULTS["FAMILIES"]:
        folder = families()[family]
        cards = {
            role: replace(read_card(file), score=measured(family, role)) for role, file in weight_files(family).items()
        }
        write_scores(folder, cards.values())
        (folder / PAGE).write_text(model_page(family, cards), encoding="utf-8")


if __name__ == "__main__":
    main()
