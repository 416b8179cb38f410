"""SemanticKITTI as users have it, in small: its sequences, its pictures' sizes, labels where it has them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from lidar2pano.formats.scan_files import write_bin, write_label
from miniature import SIZE, camera_view, street

LABELLED = range(11)  # of 22 sequences
FOCAL = 140 / SIZE[0]  # as miniature's camera, in parts of the width


def size_of(sequence: int) -> tuple[int, int]:
    """Width and height of a sequence's pictures in the odometry benchmark."""
    if sequence == 3:
        return 1242, 375
    return (1226, 370) if 4 <= sequence <= 12 else (1241, 376)


def write_semantic_kitti(root: Path, *, camera_labels: bool = True, scale: float = 1.0) -> Path:
    """Write sequences 00 to 21, a frame each, without splits.json; ground truth of the points in 00 to 10 alone.

    scale  of the images; without camera labels there is no folder for them, either.
    """
    ids, colours = camera_view()
    for sequence in range(22):
        folder = root / "sequences" / f"{sequence:02d}"
        width, height = (round(scale * length) for length in size_of(sequence))
        for part in ("velodyne", "labels", "image_2", "camera_labels"):
            if part != "camera_labels" or camera_labels:
                (folder / part).mkdir(parents=True)
        scan = street(sequence, points=900)
        write_bin(folder / "velodyne" / "000000.bin", scan)
        if sequence in LABELLED:
            assert scan.label is not None
            write_label(folder / "labels" / "000000.label", scan.label)
        f = FOCAL * width
        (folder / "calib.txt").write_text(
            f"P2: {f} 0 {width / 2} 0 0 {f} {height / 2.2} 0 0 0 1 0\nTr: 0 -1 0 0.02 0 0 -1 -0.08 1 0 0 -0.27\n"
        )
        _resized(colours, (width, height)).save(folder / "image_2" / "000000.png", compress_level=1)
        if camera_labels:
            _resized(ids, (width, height)).save(folder / "camera_labels" / "000000.png", compress_level=1)
    return root


def _resized(pixels: np.ndarray, size: tuple[int, int]) -> Image.Image:
    return Image.fromarray(pixels).resize(size, Image.Resampling.NEAREST)
