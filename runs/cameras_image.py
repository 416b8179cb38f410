"""Write docs/cameras.jpg: a PandaSet frame whose front camera is hidden, without and with the five other cameras.

    python runs/cameras_image.py data/pandaset-mini 002/000000

PandaSet (Xiao et al. 2021) is licensed CC BY 4.0.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

import lidar2pano
from lidar2pano.data.layouts import frames
from lidar2pano.evaluate.hidden_cameras import frame_cameras
from lidar2pano.panorama import Panorama

WIDTH, MOST_BYTES = 1200, 150_000
COLOURS = np.array([[60, 60, 60], [230, 159, 0], [86, 180, 233], [0, 158, 115], [240, 228, 66], [204, 121, 167]])


def front_half(image: np.ndarray) -> Image.Image:
    """Return the front half of a panorama (H, W, 3), as wide as the page."""
    quarter = image.shape[1] // 4
    part = Image.fromarray(np.ascontiguousarray(image[:, quarter:-quarter].astype(np.uint8)))
    return part.resize((WIDTH, part.height * WIDTH // part.width), Image.Resampling.LANCZOS)


def rows(alone: Panorama, helped: Panorama) -> list[Image.Image]:
    """Return the rows of the picture."""
    assert helped.source is not None
    return [front_half(alone.colour), front_half(helped.colour), front_half(COLOURS[helped.source])]


def main(root: str, name: str) -> None:
    """Make the panoramas and write the picture."""
    split = frames(Path(root), "all")
    frame = split[split.names.index(name)]
    front, *others = frame_cameras(frame)
    pipeline = lidar2pano.load().at(front.calibration)
    parts = rows(pipeline(frame.scan), pipeline(frame.scan, others))
    picture = Image.new("RGB", (WIDTH, sum(part.height + 4 for part in parts) - 4), "white")
    top = 0
    for part in parts:
        picture.paste(part, (0, top))
        top += part.height + 4
    path = Path(__file__).parents[1] / "docs" / "cameras.jpg"
    for quality in range(90, 20, -5):
        picture.save(path, quality=quality)
        if path.stat().st_size <= MOST_BYTES:
            return


if __name__ == "__main__":
    main(*sys.argv[1:])
