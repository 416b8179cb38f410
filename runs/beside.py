"""A sheet of what several families make of the same scans, below what the cameras saw.

    python runs/beside.py OUT.jpg FAMILY... --data ROOT [--split val] [--frames 14] [--sensor NAME] [--segments]
        [--width 1536]

FAMILY is whatever `lidar2pano translate --weights` takes. Per frame: the true panorama where there is one, else
the camera's picture; then each family's panorama, in the order given.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from lidar2pano import load
from lidar2pano.data.truths import Truth, truths
from lidar2pano.labels import COMMON15

GAP = 4  # pixels


def strip(picture: np.ndarray, sheet: int, width: int) -> np.ndarray:
    """(H, W, 3) uint8, `width` wide, on a white ground as wide as the sheet."""
    image = Image.fromarray(picture)
    small = np.asarray(image.resize((width, round(image.height * width / image.width)), Image.Resampling.BOX))
    ground = np.full((small.shape[0] + GAP, sheet, 3), 255, dtype=np.uint8)
    start = (sheet - width) // 2
    ground[: small.shape[0], start : start + width] = small
    return ground


def reference(truth: Truth, sheet: int) -> np.ndarray:
    """What the cameras saw, on the sheet's scale: a camera's picture is as wide as its part of the turn."""
    if truth.panorama is not None:
        return strip(truth.panorama.colour, sheet, sheet)
    assert truth.picture is not None and truth.calibration is not None
    turn = 2 * np.arctan(truth.calibration.size[0] / 2 / truth.calibration.K[0, 0]) / (2 * np.pi)
    return strip(truth.picture, sheet, round(sheet * turn))


def main() -> None:
    """Read the arguments and write the sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("families", nargs="+")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--split", default="val")
    parser.add_argument("--frames", type=int, default=14)
    parser.add_argument("--sensor", default="")
    parser.add_argument("--segments", action="store_true", help="show classes, not colours")
    parser.add_argument("--width", type=int, default=1536)
    asked = parser.parse_args()
    pipelines = [load(family) for family in asked.families]
    if asked.sensor:
        pipelines = [pipeline.for_sensor(asked.sensor) for pipeline in pipelines]
    found, rows = truths(asked.data, asked.split), []
    for index in np.linspace(0, len(found) - 1, min(asked.frames, len(found))).round().astype(int):
        truth = found[int(index)]
        rows.append(reference(truth, asked.width))
        for pipeline in pipelines:
            panorama = (pipeline.at(truth.calibration) if truth.calibration is not None else pipeline)(truth.scan)
            picture = COMMON15.paint(panorama.segments) if asked.segments else panorama.colour
            rows.append(strip(picture, asked.width, asked.width))
    Image.fromarray(np.concatenate(rows)).save(asked.out, quality=85)


if __name__ == "__main__":
    main()
