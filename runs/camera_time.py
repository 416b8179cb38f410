"""Time panoramas of a data set's first frame with no camera, one, and all of them: CPU seconds by one thread.

    python runs/camera_time.py data/pandaset-mini streets 9

They take turns; a ratio is the median of those within a turn.
"""

from __future__ import annotations

import statistics
import sys
import time
from pathlib import Path

import torch

import lidar2pano
from lidar2pano.data.layouts import frames
from lidar2pano.evaluate.hidden_cameras import frame_cameras
from lidar2pano.hardware import keep_buffers


def main(root: str, family: str = "streets", turns: str = "9") -> None:
    """Time the panoramas and print a line for each number of cameras."""
    torch.set_num_threads(1)
    keep_buffers()
    frame, pipeline = frames(Path(root), "all")[0], lidar2pano.load(family, "cpu", "torch")
    cameras = frame_cameras(frame)
    times: dict[int, list[float]] = {0: [], 1: [], len(cameras): []}
    for _ in range(int(turns) + 1):
        for count, seconds in times.items():
            begin = time.process_time()
            pipeline(frame.scan, cameras[:count])
            seconds.append(time.process_time() - begin)
    for count, seconds in times.items():
        ratio = statistics.median(one / plain for one, plain in list(zip(seconds, times[0], strict=True))[1:])
        print(f"{count} cameras: {statistics.median(seconds[1:]):.3f} s, {ratio:.2f} of a plain panorama")


if __name__ == "__main__":
    main(*sys.argv[1:])
