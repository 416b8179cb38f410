"""Write docs/failure.jpg: the rear half of a PandaSet frame, as six cameras saw it and as streets paints it alone.

    python runs/failure_image.py data/pandaset-mini 002/000000

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
from lidar2pano.pipeline.composition import compose, photographed

WIDTH, QUALITY = 1200, 80
FAMILY = "streets"  # the painter of `world` has learned from this street


def rear_half(image: np.ndarray) -> Image.Image:
    """Return the rear half of a panorama (H, W, 3), from right over back to left, as wide as the page."""
    columns = image.shape[1]
    part = Image.fromarray(np.ascontiguousarray(np.roll(image, columns // 2, axis=1)[:, columns // 4 : -columns // 4]))
    return part.resize((WIDTH, part.height * WIDTH // part.width), Image.Resampling.LANCZOS)


def main(root: str, name: str) -> None:
    """Make the panoramas and write the picture."""
    split = frames(Path(root), "all")
    frame = split[split.names.index(name)]
    alone = lidar2pano.load(FAMILY)(frame.scan)
    seen = compose(alone, photographed(alone, frame_cameras(frame)))
    assert seen.source is not None
    parts = [rear_half(seen.colour * (seen.source > 0)[..., None]), rear_half(alone.colour)]
    picture = Image.new("RGB", (WIDTH, sum(part.height + 4 for part in parts) - 4), "white")
    for number, part in enumerate(parts):
        picture.paste(part, (0, number * (part.height + 4)))
    picture.save(Path(__file__).parents[1] / "docs" / "failure.jpg", quality=QUALITY)


if __name__ == "__main__":
    main(*sys.argv[1:])
