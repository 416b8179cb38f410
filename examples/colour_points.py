"""A colour for every LiDAR point: python examples/colour_points.py [SCAN.bin] [OUT.ply].

The scan becomes a panorama; each point then takes the colour of the pixel that it lies in. Points that the panorama
does not show (above it, below it, or hidden behind something) are grey.
"""

from __future__ import annotations

import sys
from pathlib import Path

import lidar2pano
from lidar2pano import demo


def main(scan_file: str = "", out: str = "points.ply", weights: str = "world") -> Path:
    scan = lidar2pano.read(scan_file or demo.street())
    panorama = lidar2pano.load(weights)(scan)
    points = panorama.colour_points(scan)
    print(f"{points.valid.mean():.0%} of {len(scan)} points have a colour; {points.occluded.sum()} are hidden")
    return panorama.save_points(out, scan)


if __name__ == "__main__":
    print(main(*sys.argv[1:]))
