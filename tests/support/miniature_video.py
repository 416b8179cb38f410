"""A made-up data set whose frames follow each other, small enough to write for every test that wants one."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image

from lidar2pano.formats.image_files import write_depth
from lidar2pano.formats.scan_files import write_bin, write_label
from miniature import CALIB, SIZE, street

FRAMES = 7
STEP = 3  # pixels to the left that the picture moves from frame to frame
TURN = 5  # columns that the panorama turns by from frame to frame
PANORAMA = (96, 1152)  # rows, columns: a quarter of VIEWS["panorama"]
SPLITS = {
    "train": [f"00/{number:06d}" for number in range(FRAMES)],
    "val": [f"01/{number:06d}" for number in range(FRAMES)],
    "alone": ["00/000001", "00/000004", "01/000005"],
}


@cache
def texture(seed: int, rows: int, columns: int) -> np.ndarray:
    """Smooth colours (rows, columns, 3) uint8 whose last column goes over into the first."""
    generator = np.random.default_rng(seed)
    y, x = np.linspace(0, 1, rows)[:, None], np.linspace(0, 2 * np.pi, columns, endpoint=False)[None]
    layers = [
        np.sin(generator.integers(1, 40) * x + generator.uniform(0, 40) * y + generator.uniform(0, 6))
        for _ in range(3 * 24)
    ]
    waves = np.stack(layers, -1).reshape(rows, columns, 3, 24).mean(-1)
    return np.clip(128 + 300 * waves, 0, 255).astype(np.uint8)


def write_video(root: Path, *, panorama: bool = False) -> Path:
    """Write two sequences below `root`; with `panorama`, ground truth all around and poses of a turning car.

    The turn is to the left, so that the panorama's pictures move to the right; everything is 10 m away.
    """
    for name, seed in (("00", 3), ("01", 4)):
        folder = root / "sequences" / name
        for part in ("velodyne", "labels", "image_2", "camera_labels", "pano", "pano_labels", "pano_depth"):
            if panorama or not part.startswith("pano"):
                (folder / part).mkdir(parents=True, exist_ok=True)
        (folder / "calib.txt").write_text("P2: 140 0 119.5 0 0 140 33 0 0 0 1 0\nTr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
        if not panorama:
            (folder / "calib.txt").write_text(CALIB)
        for number in range(FRAMES):
            _write_frame(folder, f"{number:06d}", seed, number, panorama)
        if panorama:
            turns = np.arange(FRAMES) * TURN * 2 * np.pi / PANORAMA[1]
            # of camera 0, whose y points down: a turn to the left is one about -y
            rows = [[np.cos(a), 0, -np.sin(a), 0, 0, 1, 0, 0, np.sin(a), 0, np.cos(a), 0] for a in turns]
            np.savetxt(folder / "poses.txt", np.array(rows), fmt="%.12e")
    (root / "splits.json").write_text(json.dumps(SPLITS))
    return root


def _write_frame(folder: Path, stem: str, seed: int, number: int, panorama: bool) -> None:
    scan = street(number, points=500)
    assert scan.label is not None
    write_bin(folder / "velodyne" / f"{stem}.bin", scan)
    write_label(folder / "labels" / f"{stem}.label", scan.label)
    width, height = SIZE
    wide = texture(seed, height, 2 * width)
    colour = np.ascontiguousarray(wide[:, STEP * number : STEP * number + width])
    ids = (colour[..., 0] > 128).astype(np.uint8) * 2  # road and building of CITYSCAPES
    ids[:5] = 255
    Image.fromarray(colour).save(folder / "image_2" / f"{stem}.png")
    Image.fromarray(ids).save(folder / "camera_labels" / f"{stem}.png")
    if panorama:
        whole = np.roll(texture(seed, *PANORAMA), TURN * number, axis=1)
        Image.fromarray(whole).save(folder / "pano" / f"{stem}.png")
        Image.fromarray((whole[..., 1] > 128).astype(np.uint8) * 8 + 7).save(folder / "pano_labels" / f"{stem}.png")
        write_depth(folder / "pano_depth" / f"{stem}.png", np.full(PANORAMA, 10.0))
