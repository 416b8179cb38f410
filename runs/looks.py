"""The same street in every look, through the camera: python runs/looks.py OUT.jpg [SEED]."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from lidar2pano.simulate.dataset.settings import recording_camera
from lidar2pano.simulate.layout.street_world import build_world
from lidar2pano.simulate.render.looks import LOOKS, look
from lidar2pano.simulate.render.renderer import pinhole, render

SCALE, TIME = 0.6, 0.5  # of the camera image; seconds after the drive's start


def main() -> None:
    """Render and write the sheet, two looks a row."""
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else 5
    street = build_world(seed, 1.0, "residential")
    scene = street.scene_at(street.window(0), TIME)
    rays = pinhole(recording_camera().scaled(SCALE), street.drive.poses(np.array([TIME]))[0])
    images = [render(scene, *rays, look(name, seed)).image for name in LOOKS]
    rows = [np.concatenate(images[first : first + 2], axis=1) for first in range(0, len(images), 2)]
    Image.fromarray(np.concatenate(rows)).save(Path(sys.argv[1]), quality=86)


if __name__ == "__main__":
    main()
