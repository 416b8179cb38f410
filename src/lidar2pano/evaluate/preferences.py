"""A page on which a person chooses between the pictures of two systems, and which keeps the count.

No score decides alone: measures of textures err in ways that an eye sees at once.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import write_png, write_whole


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
        swapped = hashlib.sha256(frame.encode()).digest()[0] % 2
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
        return write_whole(self.folder / "index.html", lambda file: file.write_text(page, encoding="utf-8"), "--pairs")
