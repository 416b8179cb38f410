"""Make the scan that ships with the package: one frame of the street world, as an HDL-64E on a car's roof sees it.

    python runs/demo_scan.py [OUT] [--seed N] [--labels]

OUT is a KITTI .bin (default: the one inside the package); --labels writes its SemanticKITTI .label beside it. Points
are rounded to millimetres. The frame is that of `lidar2pano world --place residential --seed N --frames 1`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from lidar2pano.simulate.dataset.sequence_writer import SequenceWriter
from lidar2pano.simulate.dataset.settings import WorldSettings

SHIPPED = Path(__file__).resolve().parent.parent / "src" / "lidar2pano" / "demo" / "street.bin"
SEED = 12


def main() -> None:
    """Read the arguments and write the scan."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, nargs="?", default=SHIPPED)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--labels", action="store_true")
    asked = parser.parse_args()
    settings = WorldSettings(seed=asked.seed, frames=1, place="residential")
    scan = SequenceWriter(asked.out.parent, settings, 0).scan(0)
    points = scan.points.astype(np.float64)
    points[:, :3] = np.round(points[:, :3], 3)
    points.astype("<f4").tofile(asked.out)
    if asked.labels:
        label = (scan.instance.astype(np.uint32) << 16) | scan.raw
        label.astype("<u4").tofile(asked.out.with_suffix(".label"))


if __name__ == "__main__":
    main()
