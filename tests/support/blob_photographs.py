"""Photographs of blobs of colour, as a folder of images and labels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image


def write_blobs(root: Path, rows: int, columns: int) -> Path:
    """Write three photographs of rows x columns blobs, 8 pixels each way, as a data set; returns its folder."""
    folder = root / "images"
    folder.mkdir(parents=True)
    (root / "labels").mkdir()
    for number in range(3):
        blobs = np.random.default_rng(number).integers(0, 256, (rows, columns, 3)).astype(np.uint8)
        picture = Image.fromarray(blobs).resize((8 * columns, 8 * rows), Image.Resampling.BICUBIC)
        picture.save(folder / f"{number}.png")
    return root
