"""Write a table of how weights bear fewer beams: every beam of an HDL-64E, every second, every fourth.

    python runs/fewer_beams.py ROOT WEIGHTS... [--split val]

Scored like `lidar2pano evaluate`: classes in the camera from the scan alone, and classes of the points that are left.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from lidar2pano.data.augment import bands
from lidar2pano.data.range_images import BEAM_DEG
from lidar2pano.data.truths import Truth, truths
from lidar2pano.evaluate.evaluation import score
from lidar2pano.evaluate.measures import Measures
from lidar2pano.evaluate.systems import system

EVERY = (1, 2, 4)
ROWS = {
    "camera mIoU": ("camera", "miou"),
    "camera accuracy": ("camera", "accuracy"),
    "points mIoU": ("points", "miou"),
    "points accuracy": ("points", "accuracy"),
}


def thinned(truth: Truth, every: int) -> Truth:
    """The truth with a scan of which one beam in `every` is left; its pictures stay."""
    scan = truth.scan
    kept = bands(scan, BEAM_DEG) % every == 0
    ids = None if truth.point_ids is None else truth.point_ids[kept]
    scan = replace(scan, xyz=scan.xyz[kept], remission=scan.remission[kept])
    return replace(truth, scan=scan, point_ids=ids)


def rows(root: Path, split: str, weights: list[str]) -> Iterator[str]:
    """Lines of the table."""
    yield "| beams | figure | " + " | ".join(weights) + " |"
    yield "| ---: | --- |" + " ---: |" * len(weights)
    systems, measures = [system(name) for name in weights], Measures(kinds=("classes", "points"), sectors=("camera",))
    for every in EVERY:
        found = score(
            systems,
            (thinned(one, every) for one in truths(root, split)),
            data=root.name,
            split=split,
            measures=measures,
        )
        told = [{(one.sector, one.name): one.value for one in found.figures(each.tally)} for each in found.contenders]
        for title, figure in ROWS.items():
            yield f"| {64 // every} | {title} | " + " | ".join(f"{each[figure]:.3f}" for each in told) + " |"


def main() -> None:
    """Read the arguments and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("weights", nargs="+")
    parser.add_argument("--split", default="val")
    asked = parser.parse_args()
    print("\n".join(rows(asked.root, asked.split, asked.weights)))


if __name__ == "__main__":
    main()
