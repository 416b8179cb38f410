"""Write a table of scores with fewer beams: every beam of an HDL-64E, every second, every fourth.

    python runs/fewer_beams.py ROOT WEIGHTS... [--split val]

Scored like `lidar2pano evaluate`: classes in the camera from the scan alone, and classes of the remaining points.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from lidar2pano.data.frames import Frame
from lidar2pano.data.layouts import frames
from lidar2pano.data.range_images import HDL64E_BEAM_DEG
from lidar2pano.evaluate import MetricConfig, score, system
from lidar2pano.scan import bands, subset

EVERY = (1, 2, 4)
ROWS = {
    "camera mIoU": ("camera", "miou"),
    "camera accuracy": ("camera", "accuracy"),
    "points mIoU": ("points", "miou"),
    "points accuracy": ("points", "accuracy"),
}


def thinned(frame: Frame, every: int) -> Frame:
    """The frame's camera labels, and its scan with one beam in `every`."""
    scan, labels = frame.scan, frame.point_labels
    kept = bands(scan, HDL64E_BEAM_DEG) % every == 0
    return Frame(
        frame.name,
        scan=subset(scan, kept),
        point_labels=None if labels is None else labels[kept],
        camera_labels=frame.camera_labels,
        calibration=frame.calibration,
    )


def rows(root: Path, split: str, weights: list[str]) -> Iterator[str]:
    """Lines of the table."""
    yield "| beams | metric | " + " | ".join(weights) + " |"
    yield "| ---: | --- |" + " ---: |" * len(weights)
    systems, config = (
        [system(name) for name in weights],
        MetricConfig(groups=("classes", "points"), sectors=("camera",)),
    )
    for every in EVERY:
        found = score(
            systems,
            (thinned(one, every) for one in frames(root, split)),
            data=root.name,
            split=split,
            config=config,
        )
        values = [{(of, name): part.value for of, name, part in found.values(each.metrics)} for each in found.systems]
        for title, key in ROWS.items():
            yield f"| {64 // every} | {title} | " + " | ".join(f"{each[key]:.3f}" for each in values) + " |"


def main() -> None:
    """Read the arguments and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("weights", nargs="+")
    parser.add_argument("--split", default="val")
    arguments = parser.parse_args()
    print("\n".join(rows(arguments.root, arguments.split, arguments.weights)))


if __name__ == "__main__":
    main()
