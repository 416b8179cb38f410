"""A sheet of panoramas that are stitched from surround cameras: image, depth and classes, frame by frame.

    python runs/surround_sheet.py ROOT OUT.png [--split all] [--frames 2] [--width 2304]

ROOT is any data set with ground-truth panoramas. Black in the image: no camera sees it. Depth: the completed depth that
the images were stitched by (near is bright), in red the pixels that have a point of the scan. Strips begin straight
behind; the third is known where there are labelled points. Prints the valid share of every frame.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from lidar2pano.data.frames import Frame, PanoramaGroundTruth
from lidar2pano.data.layouts import frames
from lidar2pano.geometry.depth_completion import complete_depth
from lidar2pano.labels import COMMON15
from lidar2pano.views import VIEWS

NEAR, FAR, GAP = 2.0, 80.0, 6  # metres that are white and black; pixels


def strips(frame: Frame, around: PanoramaGroundTruth) -> list[np.ndarray]:
    """Images (H, W, 3) uint8: colour, depth and classes."""
    depth = complete_depth(torch.from_numpy(frame.scan.xyz), around.view).clamp(NEAR, FAR).numpy()
    grey = 255 * (1 - np.log(depth / NEAR) / np.log(FAR / NEAR))
    shades = np.repeat(grey[..., None], 3, axis=-1).astype(np.uint8)
    if around.depth_m is not None:
        shades[around.depth_m > 0, 1:] //= 2
    found = [around.image, shades]
    return found if around.labels is None else [*found, COMMON15.paint(around.labels)]


def main() -> None:
    """Read the arguments and write the sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--split", default="all")
    parser.add_argument("--frames", type=int, default=2)
    parser.add_argument("--width", type=int, default=VIEWS["panorama"].columns // 2)
    arguments = parser.parse_args()
    split = frames(
        arguments.root, arguments.split, VIEWS["panorama"].scaled(arguments.width / VIEWS["panorama"].columns)
    )
    rows: list[np.ndarray] = []
    for index in np.linspace(0, len(split) - 1, min(arguments.frames, len(split))).round().astype(int):
        frame = split[int(index)]
        (around,) = frame.require("panorama")
        print(f"{frame.name}: {around.valid.mean():.1%} of the panorama valid")
        for strip in strips(frame, around):
            rows += [strip, np.full((GAP, strip.shape[1], 3), 255, dtype=np.uint8)]
    Image.fromarray(np.concatenate(rows[:-1])).save(arguments.out)


if __name__ == "__main__":
    main()
