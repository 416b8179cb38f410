"""A made-up data set in SemanticKITTI's layout, small enough to write for every test that wants one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image

from lidar2pano.formats.scan_files import write_bin, write_label
from lidar2pano.scan import Scan

# a camera of 240 x 72 pixels at the LiDAR's place, looking ahead: x right = -y, y down = -z, z ahead = x
CALIB = """P2: 140 0 119.5 0 0 140 33 0 0 0 1 0
Tr: 0 -1 0 0.02 0 0 -1 -0.08 1 0 0 -0.27
"""
SIZE = (240, 72)
ROAD, HOUSE = 9, 13  # ids of SEMANTIC_KITTI
SPLITS = {"train": ["00/000000", "00/000001", "00/000002"], "val": ["01/000000", "01/000001"]}


def street(seed: int, points: int = 6000) -> Scan:
    """A flat road below and house fronts at both sides, seen all around, labelled."""
    generator = np.random.default_rng(seed)
    azimuth = generator.uniform(-np.pi, np.pi, points)
    elevation = np.radians(generator.uniform(-24, 3, points))
    front = 8.0 / np.maximum(np.abs(np.sin(azimuth)), 0.1)
    ground = 1.73 / np.maximum(np.tan(-elevation), 1e-3)
    distance = np.minimum(front, ground)
    xyz = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), distance * np.tan(elevation)], 1)
    label = np.where(ground < front, ROAD, HOUSE)
    remission = generator.uniform(0, 0.6, points)
    return Scan(xyz=xyz.astype(np.float32), remission=remission.astype(np.float32), label=label.astype(np.int64))


def write_data_set(root: Path) -> Path:
    """Write the data set below `root`: three frames to train on, two to validate on."""
    for number, entry in enumerate(SPLITS["train"] + SPLITS["val"]):
        sequence, stem = entry.split("/")
        folder = root / "sequences" / sequence
        for part in ("velodyne", "labels", "image_2", "camera_labels"):
            (folder / part).mkdir(parents=True, exist_ok=True)
        scan = street(number)
        assert scan.label is not None
        write_bin(folder / "velodyne" / f"{stem}.bin", scan)
        write_label(folder / "labels" / f"{stem}.label", scan.label)
        (folder / "calib.txt").write_text(CALIB)
        ids, colours = camera_view()
        Image.fromarray(ids).save(folder / "camera_labels" / f"{stem}.png")
        Image.fromarray(colours).save(folder / "image_2" / f"{stem}.png")
    (root / "splits.json").write_text(json.dumps(SPLITS))
    return root


def camera_view() -> tuple[np.ndarray, np.ndarray]:
    """The camera's view: Cityscapes ids (h, w) uint8 of road, houses, sky, a strip unsure; RGB (h, w, 3) uint8."""
    width, height = SIZE
    ids = np.full((height, width), 2, dtype=np.uint8)
    ids[:12] = 10
    ids[40:] = 0
    ids[:, :5] = 255
    colours = np.zeros((height, width, 3), dtype=np.uint8)
    colours[ids == 10] = (150, 190, 240)
    colours[ids == 2] = (180, 120, 90)
    colours[ids == 0] = (90, 90, 95)
    return ids, colours
