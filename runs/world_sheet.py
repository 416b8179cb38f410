"""A contact sheet of a simulated data set: panorama, its classes and the scan's range image, frame by frame.

    python runs/world_sheet.py ROOT OUT.jpg [--frames 12]

Frames are spread over the whole set. Range images have HDL-64E's raster; near is bright, black is no return.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from lidar2pano.data.layouts import frames
from lidar2pano.data.semantic_kitti import SemanticKittiFrame
from lidar2pano.geometry.projection import project
from lidar2pano.labels import COMMON15
from lidar2pano.views import VIEWS

WIDTH, GAP, COLUMNS = 800, 4, 2
FAR = 60.0  # metres that are dark


def cell(frame: SemanticKittiFrame) -> Image.Image:
    """One frame: three strips."""
    panorama = Image.open(frame.folder / "pano" / f"{frame.stem}.png").convert("RGB")
    ids = np.array(Image.open(frame.folder / "pano_labels" / f"{frame.stem}.png"))
    strips = [panorama, Image.fromarray(COMMON15.paint(ids)), shaded_range(frame)]
    heights = [round(WIDTH * strip.height / strip.width) for strip in strips[:2]] + [48]
    out = Image.new("RGB", (WIDTH, sum(heights) + 2 * 2), "white")
    top = 0
    for strip, height in zip(strips, heights, strict=True):
        out.paste(strip.resize((WIDTH, height), Image.Resampling.LANCZOS), (0, top))
        top += height + 2
    return out


def shaded_range(frame: SemanticKittiFrame) -> Image.Image:
    """The range image: brightness falls with the logarithm of the distance."""
    image = project(frame.scan, VIEWS["hdl64e"])
    far = image.channels[0].clamp(min=1.0).numpy()
    bright = np.clip(1 - np.log(far) / np.log(FAR), 0.06, 1) * image.valid.numpy()
    return Image.fromarray((bright * 255).astype(np.uint8)).convert("RGB")


def main() -> None:
    """Read the arguments and write the sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, default=12)
    arguments = parser.parse_args()
    there = frames(arguments.root, "all")
    picked = np.linspace(0, len(there) - 1, min(arguments.frames, len(there))).round().astype(int)
    cells = [cell(there[index]) for index in picked]
    width, height = cells[0].size
    rows = -(-len(cells) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * (width + GAP) - GAP, rows * (height + 2 * GAP) - 2 * GAP), "white")
    for number, one in enumerate(cells):
        row, column = divmod(number, COLUMNS)
        sheet.paste(one, (column * (width + GAP), row * (height + 2 * GAP)))
    sheet.save(arguments.out, quality=86)


if __name__ == "__main__":
    main()
