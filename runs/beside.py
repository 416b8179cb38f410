"""A sheet of the panoramas of several weight families for the same scans, below the ground truth.

    python runs/beside.py OUT.jpg FAMILY... --data ROOT [--split val] [--frames 14] [--sensor NAME] [--segments]
        [--width 1536]

FAMILY is an argument of `lidar2pano translate --weights`. Per frame: the ground-truth panorama where there is one, else
the camera's image; then each family's panorama, in the given order.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from lidar2pano import load
from lidar2pano.data.frames import Frame
from lidar2pano.data.layouts import frames
from lidar2pano.labels import COMMON15

GAP = 4  # pixels


def strip(pixels: np.ndarray, sheet: int, width: int) -> np.ndarray:
    """(H, W, 3) uint8, `width` wide, on a white ground as wide as the sheet."""
    image = Image.fromarray(pixels)
    small = np.asarray(image.resize((width, round(image.height * width / image.width)), Image.Resampling.BOX))
    ground = np.full((small.shape[0] + GAP, sheet, 3), 255, dtype=np.uint8)
    start = (sheet - width) // 2
    ground[: small.shape[0], start : start + width] = small
    return ground


def reference(frame: Frame, sheet: int) -> np.ndarray:
    """The ground truth on the sheet's scale: the width of a camera's image is its share of 360 degrees."""
    if frame.panorama is not None:
        return strip(frame.panorama.image, sheet, sheet)
    image, calibration = frame.require("image", "calibration")
    share = 2 * np.arctan(calibration.size[0] / 2 / calibration.K[0, 0]) / (2 * np.pi)
    return strip(image, sheet, round(sheet * share))


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
    arguments = parser.parse_args()
    pipelines = [load(family) for family in arguments.families]
    if arguments.sensor:
        pipelines = [pipeline.for_sensor(arguments.sensor) for pipeline in pipelines]
    split, rows = frames(arguments.data, arguments.split), []
    for index in np.linspace(0, len(split) - 1, min(arguments.frames, len(split))).round().astype(int):
        frame = split[int(index)]
        rows.append(reference(frame, arguments.width))
        for pipeline in pipelines:
            panorama = (pipeline.at(frame.calibration) if frame.calibration is not None else pipeline)(frame.scan)
            pixels = COMMON15.paint(panorama.segments) if arguments.segments else panorama.colour
            rows.append(strip(pixels, arguments.width, arguments.width))
    Image.fromarray(np.concatenate(rows)).save(arguments.out, quality=85)


if __name__ == "__main__":
    main()
