"""Shares of the classes among the points of a simulated and a real data set, as a Markdown table.

python runs/class_shares.py SIMULATED REAL
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from lidar2pano.data.layouts import frames
from lidar2pano.labels import SEMANTIC_KITTI


def shares(root: Path, splits: tuple[str, ...]) -> tuple[np.ndarray, int]:
    """Share of each class (20,) and the number of scans."""
    counts, scans = np.zeros(len(SEMANTIC_KITTI)), 0
    for split in splits:
        for frame in frames(root, split):
            (labels,) = frame.require("point_labels")
            counts += np.bincount(labels, minlength=len(counts))
            scans += 1
    return counts / counts.sum(), scans


def main() -> None:
    """Print the table."""
    simulated, real = (Path(word) for word in sys.argv[1:3])
    (simulated_shares, simulated_scans), (real_shares, real_scans) = (
        shares(simulated, ("all",)),
        shares(real, ("train", "val", "labelled")),
    )
    print(
        f"| class | simulated ({simulated_scans} scans) | real ({real_scans} scans, most of them with pseudo-labels) |"
    )
    print("| --- | ---: | ---: |")
    for name, a, b in zip(SEMANTIC_KITTI.classes, simulated_shares, real_shares, strict=True):
        print(f"| {name} | {a:.2%} | {b:.2%} |")


if __name__ == "__main__":
    main()
