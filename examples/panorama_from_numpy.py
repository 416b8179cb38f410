"""A panorama from arrays: python examples/panorama_from_numpy.py [POINTS.npy] [OUT].

POINTS.npy holds (N, 4) numbers: x, y, z in metres (x forward, y left, z up) and remission from 0 to 1. Without it, the
scan that ships with the package is used.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import lidar2pano
from lidar2pano import demo


def main(points_file: str = "", out: str = "panoramas", weights: str = "world") -> list[Path]:
    points = np.load(points_file) if points_file else np.fromfile(demo.street(), dtype="<f4").reshape(-1, 4)
    scan = lidar2pano.Scan(
        xyz=points[:, :3].astype(np.float32),
        remission=points[:, 3].astype(np.float32),
        name=Path(points_file or "demo").stem,
    )
    panorama = lidar2pano.load(weights)(scan)

    names, counts = np.unique(panorama.segments, return_counts=True)
    for index in counts.argsort()[::-1][:5]:
        share = counts[index] / panorama.segments.size
        print(f"{lidar2pano.COMMON15.classes[names[index]]:>12}  {share:.0%} of the pixels")
    return panorama.save(out, what=("rgb", "segments", "depth"))


if __name__ == "__main__":
    for path in main(*sys.argv[1:]):
        print(path)
