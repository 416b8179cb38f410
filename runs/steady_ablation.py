"""Write a table of what the numbers of `lidar2pano.memory` are worth, on a simulated drive.

    lidar2pano world DRIVE --sequences 2 --frames 10 --hz 10 --seed 3131
    python runs/steady_ablation.py DRIVE WEIGHTS... [--split all] [--only TEXT]

Each row changes one number; the first row is the stream as it is. Warping error, SSIM, mIoU and error of depth all
around, against the drive's true flow, colours, classes and depths.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any
from unittest.mock import patch

import lidar2pano
from lidar2pano import memory
from lidar2pano.data.frames import Frame
from lidar2pano.data.layouts import frames
from lidar2pano.evaluate.ground_truth import follows, panorama_flow
from lidar2pano.hardware import Timer
from lidar2pano.labels import COMMON15
from lidar2pano.metrics.confusion import MeanIoU
from lidar2pano.metrics.frame_metrics import SSIM, DepthError, WarpingError
from lidar2pano.pipeline import Pipeline

VARIANTS: dict[str, Mapping[str, Any]] = {
    "as it is": {},
    "without a memory": {"MOST": 1, "LEAST_IMAGES": 0, "FADED": 0.0, "DOUBT": inf},
    "MOST 3": {"MOST": 3},
    "MOST 12": {"MOST": 12},
    "LEAST_IMAGES 1": {"LEAST_IMAGES": 1},
    "LEAST_IMAGES 5": {"LEAST_IMAGES": 5},
    "DOUBT inf: contradicted means begin again": {"DOUBT": inf},
    "DOUBT 1": {"DOUBT": 1.0},
    "SAME 0.1": {"SAME": 0.1},
    "SAME 1": {"SAME": 1.0},
    "ANY 0.3: what stands is averaged where its distance agrees": {"ANY": 0.3},
    "FADED 0": {"FADED": 0.0},
}


def scores(pipeline: Pipeline, drive: list[tuple[Frame, Any]], numbers: Mapping[str, Any]) -> list[float]:
    """Return warping error x 1000, SSIM, mIoU and AbsRel of a drive's panoramas; drive: frames and their scenes."""
    warping, ssim, miou, depth = WarpingError(circular=True), SSIM(), MeanIoU(COMMON15), DepthError()
    stream, last, before = memory.Memory(), None, None
    with patch.dict(vars(memory), numbers):
        for frame, scene in drive:
            if not follows(last, frame):
                stream, before = memory.Memory(), None
            stream, fused = pipeline.remember(stream, scene, frame.pose, Timer(pipeline.device))
            stream, panorama = pipeline.paint(stream, fused, Timer(pipeline.device))
            truth = frame.panorama
            assert truth is not None and truth.labels is not None and truth.depth_m is not None, "simulated ones have"
            flow = panorama_flow(last, frame) if before is not None and last is not None else None
            if flow is not None and before is not None:
                warping.update(before, panorama.colour, flow.shift, frame.name, valid=flow.known)
            ssim.update(panorama.colour, truth.image, frame.name, valid=truth.valid)
            miou.update(panorama.segments, truth.labels, frame.name)
            depth.update(panorama.depth_m, truth.depth_m, frame.name)
            last, before = frame, panorama.colour
    error, *others = (next(iter(metric.values().values())) for metric in (warping, ssim, miou, depth))
    return [1000 * error, *others]


def rows(root: Path, split: str, weights: str, only: str) -> Iterator[str]:
    """Yield the rows of a family."""
    pipeline = lidar2pano.load(weights)
    drive = []
    for frame in frames(root, split):
        truth = frame.panorama
        assert truth is not None, f"{frame.name}: has no true panorama"
        own = replace(pipeline, view=replace(pipeline.view, origin=truth.view.origin))
        drive.append((frame, own.translate(frame.scan, Timer(own.device))))
    for name, numbers in VARIANTS.items():
        if only in name:
            values = scores(replace(pipeline, view=drive[0][1].view), drive, numbers)
            cells = [f"{values[0]:.2f}", *(f"{value:.3f}" for value in values[1:])]
            yield f"| {' | '.join([weights, name, *cells])} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("weights", nargs="+")
    parser.add_argument("--split", default="all")
    parser.add_argument("--only", default="", help="of the variants, those with this text in their name")
    options = parser.parse_args()
    print("| weights | numbers | warping error x 1000 | SSIM | mIoU | depth AbsRel |")
    print("| --- | --- | ---: | ---: | ---: | ---: |")
    for name in options.weights:
        for row in rows(options.root, options.split, name, options.only):
            print(row, flush=True)


if __name__ == "__main__":
    main()
