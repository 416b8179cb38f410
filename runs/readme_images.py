"""Make the README's images from the scan that is part of the package: python runs/readme_images.py [WEIGHTS].

docs/panorama.jpg   the panorama, front half above, rear half below
docs/stages.jpg     range image, LiDAR segments, panorama of segments, depth, colours: left and right ends are behind
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from lidar2pano import demo
from lidar2pano.formats.readers import read
from lidar2pano.geometry.projection import project
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI
from lidar2pano.pipeline import load

FAMILY = "world"  # that of `demo`
DOCS = Path(__file__).parent.parent / "docs"
WIDTH = 1600


def shades(metres: np.ndarray) -> np.ndarray:
    """Depths as grey values, near bright, nothing black: (h, w, 3) uint8."""
    grey = np.where(metres > 0, 255 * np.exp(-metres / 25) + 20, 0).clip(0, 255)
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)


def strip(image: np.ndarray, height: int, smooth: bool = True) -> np.ndarray:
    """The image WIDTH pixels wide and `height` high."""
    how = Image.Resampling.LANCZOS if smooth else Image.Resampling.NEAREST
    return np.array(Image.fromarray(image).resize((WIDTH, height), how))


def main() -> None:
    """Run the pipeline once and write both images."""
    scan = read(demo.street())
    pipeline = load(sys.argv[1] if len(sys.argv) > 1 else FAMILY)
    panorama = pipeline(scan)
    DOCS.mkdir(exist_ok=True)

    quarter = panorama.colour.shape[1] // 4
    turned = np.roll(panorama.colour, -quarter, axis=1)  # begins at the left, the rear half ends it
    halves = [turned[:, : 2 * quarter], turned[:, 2 * quarter :]]
    height = round(WIDTH * halves[0].shape[0] / halves[0].shape[1])
    Image.fromarray(np.concatenate([strip(half, height) for half in halves])).save(DOCS / "panorama.jpg", quality=88)

    range_image = project(scan, pipeline.segmenter.view)
    labels = SEMANTIC_KITTI.paint(panorama.labels)[range_image.index.numpy()] * range_image.valid.numpy()[..., None]
    thin = round(WIDTH * panorama.colour.shape[0] / panorama.colour.shape[1])
    rows = [
        strip(shades(range_image.channels[0].numpy()), 64, smooth=False),
        strip(labels.astype(np.uint8), 64, smooth=False),
        strip(COMMON15.paint(panorama.segments), thin, smooth=False),
        strip(shades(panorama.depth_m), thin),
        strip(panorama.colour, thin),
    ]
    gap = np.full((6, WIDTH, 3), 255, dtype=np.uint8)
    stacked = np.concatenate([part for row in rows for part in (row, gap)][:-1])
    Image.fromarray(stacked).save(DOCS / "stages.jpg", quality=88)


if __name__ == "__main__":
    main()
