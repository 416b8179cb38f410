"""Pictures for people: the frames with a system's worst scores, and a page to choose between two systems' pictures.

No score decides alone: measures of textures err in ways that an eye sees at once.
"""

from __future__ import annotations

import hashlib
import heapq
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from lidar2pano.data.frames import CITYSCAPES_TO_COMMON15, Frame
from lidar2pano.errors import InputError
from lidar2pano.evaluate.ground_truth import Resampled
from lidar2pano.evaluate.panorama_system import Prediction
from lidar2pano.formats.image_files import write_png, write_text, write_whole
from lidar2pano.labels import COMMON15

CAPTION_ROWS = 14  # of pixels, for Pillow's own font


class WorstFrame(NamedTuple):
    """A frame, the metric of its rank and its value (more is better), and its sheet (H, W, 3) uint8."""

    name: str
    metric: str
    value: float
    sheet: np.ndarray | None


@dataclass(slots=True)
class WorstFrames:
    """The `number` worst frames of a system so far; only their sheets are kept."""

    number: int
    held: list[WorstFrame] = field(default_factory=list)

    def take(self, frame: WorstFrame) -> None:
        """Hold a frame if it is among the worst; of equal ones the first in the alphabet."""
        self.held = heapq.nsmallest(self.number, [*self.held, frame], key=lambda item: (item.value, item.name))

    def wanted(self, value: float) -> bool:
        """Return whether a frame of this value would be held."""
        return len(self.held) < self.number or value <= max(frame.value for frame in self.held)


def sheet(frame: Frame, prediction: Prediction, panorama: Resampled | None) -> np.ndarray | None:
    """Put colours above classes, ground truth on the left (of panoramas: above), prediction on the right (below).

    Returns (H, W, 3) uint8, each image under its caption; None if there is nothing to show.
    """
    labels = None if frame.camera_labels is None else CITYSCAPES_TO_COMMON15[frame.camera_labels]
    rows = [
        {"image": frame.image, "predicted image": prediction.image},
        {"classes": _painted(labels), "predicted classes": _painted(prediction.camera_labels)},
    ]
    true = frame.panorama
    if true is not None and panorama is not None:
        painted = panorama.image if prediction.painted else None
        rows += [{"panorama": true.image}, {"predicted panorama": painted}]
        rows += [{"panorama's classes": _painted(true.labels)}]
        rows += [{"predicted panorama's classes": _painted(panorama.labels)}]
    joined = [row for row in map(captioned, rows) if row is not None]
    if not joined:
        return None
    width = max(row.shape[1] for row in joined)
    return np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in joined])


def captioned(images: Mapping[str, np.ndarray | None]) -> np.ndarray | None:
    """Join images (h, w, 3) uint8 of one height side by side, each under its caption; None if all are missing."""
    columns: list[np.ndarray] = []
    for caption, image in images.items():
        if image is not None:
            strip = Image.new("RGB", (image.shape[1], CAPTION_ROWS))
            ImageDraw.Draw(strip).text((2, 1), caption, fill="white")
            columns.append(np.concatenate([np.asarray(strip), image]))
    return np.concatenate(columns, axis=1) if columns else None


def _painted(ids: np.ndarray | None) -> np.ndarray | None:
    return None if ids is None else COMMON15.paint(np.asarray(ids))


class Preferences:
    """Pairs of pictures of the camera's view, beside its photograph, written as they come.

    folder   gets index.html and three pictures per frame; their names do not say the system.
    systems  names of the two.
    """

    def __init__(self, folder: Path, systems: Sequence[str]) -> None:
        if len(systems) != 2:
            raise InputError(f"--pairs compares two systems, not {len(systems)}; name two")
        self.folder, self.systems = folder, tuple(systems)
        self.pairs: list[dict[str, str | int]] = []

    def take(self, frame: str, real: np.ndarray | None, images: Sequence[np.ndarray | None]) -> None:
        """Write the pictures (h, w, 3) uint8 of a frame; one without all three is left out. Sides are drawn by name."""
        first, second = images
        if real is None or first is None or second is None:
            return
        swapped = hashlib.sha256(os.fsencode(frame)).digest()[0] % 2
        left, right = (second, first) if swapped else (first, second)
        pair: dict[str, str | int] = {"frame": frame, "swapped": swapped}
        for side, image in (("real", real), ("left", left), ("right", right)):
            name = f"{len(self.pairs):04d}-{side}.png"
            write_whole(self.folder / name, lambda file, image=image: write_png(file, image), "--pairs")
            pair[side] = name
        self.pairs.append(pair)

    def write(self) -> Path:
        """Write the page; return its path. InputError without any pair."""
        if not self.pairs:
            raise InputError("--pairs: no frame has a photograph and both systems' pictures; choose another split")
        data = json.dumps({"systems": self.systems, "pairs": self.pairs}).replace("<", "\\u003c")
        page = Path(__file__).with_name("pairs.html").read_text(encoding="utf-8").replace("{{data}}", data)
        return write_text(self.folder / "index.html", page, "--pairs")
