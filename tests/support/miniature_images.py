"""Images and labels without scans, in Cityscapes' layout and as plain folders, small enough for every test."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from lidar2pano.labels import CITYSCAPES, CITYSCAPES_IDS
from miniature import camera_view

CITIES = {"train": {"aachen": 3, "ulm": 1}, "val": {"lindau": 2}}  # city -> images


def label_ids(train_ids: np.ndarray) -> np.ndarray:
    """Cityscapes' label ids of train ids; unknown pixels are "static"."""
    ids = np.full_like(train_ids, CITYSCAPES_IDS.id_of("static"))
    for number, name in enumerate(CITYSCAPES.classes):
        ids[train_ids == number] = CITYSCAPES_IDS.id_of(name)
    return ids


def write_cityscapes(root: Path) -> Path:
    """Write leftImg8bit/ and gtFine/ with label ids; the first image has train ids, too, as their script makes them."""
    ids, colours = camera_view()
    for split, cities in CITIES.items():
        for city, count in cities.items():
            for number in range(count):
                stem = f"{city}_{number:06d}_000019"
                _save(colours, root / "leftImg8bit" / split / city / f"{stem}_leftImg8bit.png")
                labels = root / "gtFine" / split / city
                _save(label_ids(ids), labels / f"{stem}_gtFine_labelIds.png")
                _save(np.zeros_like(ids), labels / f"{stem}_gtFine_instanceIds.png")
                if not number:
                    _save(ids, labels / f"{stem}_gtFine_labelTrainIds.png")
    return root


def write_folders(root: Path, *splits: str) -> Path:
    """Write images/ and labels/ with two images a split, or without folders of splits."""
    ids, colours = camera_view()
    for split in splits or ("",):
        for name in ("a.jpg", "deep/er/b.png"):
            _save(colours, root / "images" / split / name)
            _save(ids, (root / "labels" / split / name).with_suffix(".png"))
    return root


def _save(pixels: np.ndarray, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)
