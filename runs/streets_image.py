"""Write docs/streets.jpg: for six frames of KITTI the camera's image, and the panoramas of the scan alone.

    python runs/streets_image.py data/kitti-mini

KITTI (Geiger et al. 2012) is licensed CC BY-NC-SA 3.0.
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

import lidar2pano
from lidar2pano.data.frames import evenly_spaced
from lidar2pano.data.layouts import frames

WIDTH, GAP, QUALITY = 1536, 4, 80
FRAMES, FAMILIES = 6, ("streets", "world")


def main(root: str) -> None:
    """Make the panoramas and write the picture."""
    split = frames(Path(root), "val")
    pipelines = [lidar2pano.load(family) for family in FAMILIES]
    parts: list[Image.Image] = []
    for number in evenly_spaced(len(split), FRAMES):
        (image,) = split[number].require("image")
        panoramas = [Image.fromarray(pipeline(split[number].scan).colour) for pipeline in pipelines]
        strips = [one.resize((WIDTH, one.height * WIDTH // one.width), Image.Resampling.LANCZOS) for one in panoramas]
        camera = Image.fromarray(image)
        height = strips[0].height
        parts += [camera.resize((camera.width * height // camera.height, height), Image.Resampling.LANCZOS), *strips]
    picture = Image.new("RGB", (WIDTH, sum(part.height + GAP for part in parts) - GAP), "white")
    top = 0
    for part in parts:
        picture.paste(part, ((WIDTH - part.width) // 2, top))
        top += part.height + GAP
    picture.save(Path(__file__).parents[1] / "docs" / "streets.jpg", quality=QUALITY)


if __name__ == "__main__":
    main(*sys.argv[1:])
