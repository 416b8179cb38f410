"""A sheet of truth panoramas that are composed from surround cameras: picture, depth and classes, frame by frame.

    python runs/surround_sheet.py ROOT OUT.png [--split all] [--frames 2] [--width 2304]

ROOT is any data set whose truth knows panoramas. Black in the picture: no camera sees it. Depth: what the pictures were
looked up by (near is bright), over it in red the pixels that a point of the scan owns. Each strip begins straight
behind; the third is known where labelled points are. Prints per frame what is valid.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from lidar2pano.data.truths import TruePanorama, Truth, truths
from lidar2pano.geometry.depth_completion import complete_depth
from lidar2pano.labels import COMMON15
from lidar2pano.views import VIEWS

NEAR, FAR, GAP = 2.0, 80.0, 6  # metres that are white and black; pixels


def strips(truth: Truth, around: TruePanorama) -> list[np.ndarray]:
    """Pictures (H, W, 3) uint8: colour, depth and classes."""
    depth = complete_depth(torch.from_numpy(truth.scan.xyz), around.view).clamp(NEAR, FAR).numpy()
    grey = 255 * (1 - np.log(depth / NEAR) / np.log(FAR / NEAR))
    shades = np.repeat(grey[..., None], 3, axis=-1).astype(np.uint8)
    if around.depth_m is not None:
        shades[around.depth_m > 0, 1:] //= 2
    found = [around.colour, shades]
    return found if around.ids is None else [*found, COMMON15.paint(around.ids)]


def main() -> None:
    """Read the arguments and write the sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--split", default="all")
    parser.add_argument("--frames", type=int, default=2)
    parser.add_argument("--width", type=int, default=VIEWS["panorama"].columns // 2)
    asked = parser.parse_args()
    found = truths(asked.root, asked.split, VIEWS["panorama"].scaled(asked.width / VIEWS["panorama"].columns))
    rows: list[np.ndarray] = []
    for index in np.linspace(0, len(found) - 1, min(asked.frames, len(found))).round().astype(int):
        truth = found[int(index)]
        if truth.panorama is None:
            raise SystemExit(f"{truth.name}: its data set knows no panorama")
        print(f"{truth.name}: {truth.panorama.valid.mean():.1%} of the panorama valid")
        for strip in strips(truth, truth.panorama):
            rows += [strip, np.full((GAP, strip.shape[1], 3), 255, dtype=np.uint8)]
    Image.fromarray(np.concatenate(rows[:-1])).save(asked.out)


if __name__ == "__main__":
    main()
