"""A folder of scans as a video: python examples/drive_to_video.py [FOLDER] [OUT.webp].

The panoramas of the scans, in the order of their file names, become an animated WebP, which browsers play. Without a
folder, the scan that ships with the package is used; it makes a video of one frame.
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

import lidar2pano
from lidar2pano import demo

WIDTH = 1536  # pixels of the video; panoramas have three times as many
FRAME_MS = 100  # the time between two turns of the sensor


def main(folder: str = "", out: str = "drive.webp", weights: str = "world") -> Path:
    pipeline = lidar2pano.load(weights)
    frames = []
    for panorama in pipeline.stream(lidar2pano.scans(folder or demo.street())):
        height, width = panorama.colour.shape[:2]
        frames.append(Image.fromarray(panorama.colour).resize((WIDTH, round(WIDTH * height / width))))
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0, quality=80)
    return Path(out)


if __name__ == "__main__":
    print(main(*sys.argv[1:]))
