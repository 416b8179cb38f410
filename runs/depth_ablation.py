"""Write a table of what the numbers of `lidar2pano.scene.depth` are worth, on hidden points of scans and in towns.

    python runs/depth_ablation.py WEIGHTS DATA:SPLIT... [--frames 5]

Of each scan every second band of a degree of elevation is hidden, and all above three quarters of its points: the mean
relative error of depths (AbsRel) of hidden points between those that are left, and above them. Of simulated towns:
AbsRel and the share within 25 % (delta1) all around, of the whole scan. Each place counts once; each row changes one
number, and the first is as it is.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

import lidar2pano
from lidar2pano.data.frames import Frame, PanoramaGroundTruth
from lidar2pano.data.layouts import frames
from lidar2pano.evaluate.ground_truth import is_dense
from lidar2pano.geometry.projection import project
from lidar2pano.hardware import Timer
from lidar2pano.metrics.frame_metrics import DepthError
from lidar2pano.pipeline import Pipeline, stages
from lidar2pano.scan import Scan, bands, subset
from lidar2pano.scene import depth, surfaces

BETWEEN, ABOVE, AROUND = "hidden between", "hidden above", "towns"
COLUMNS = ((BETWEEN, "AbsRel"), (ABOVE, "AbsRel"), (AROUND, "AbsRel"), (AROUND, "delta1"))
VARIANTS: dict[str, Mapping[str, Any]] = {
    "as it is": {},
    "ON_GROUND 1: no point lies on the ground": {"ON_GROUND": 1.0},
    "ON_GROUND 1.1": {"ON_GROUND": 1.1},
    "ON_GROUND 1.4": {"ON_GROUND": 1.4},
    "TOPMOST_PX 0": {"TOPMOST_PX": 0},
    "TOPMOST_PX 1": {"TOPMOST_PX": 1},
    "TOPMOST_PX 4": {"TOPMOST_PX": 4},
    "EVEN_PX none: no averages on planes": {"EVEN_PX": ()},
    "EVEN_PX 1": {"EVEN_PX": (1,)},
    "EVEN_PX 1 2 4 8": {"EVEN_PX": (1, 2, 4, 8)},
    "ON_PLANE 0.015": {"ON_PLANE": 0.015},
    "ON_PLANE 0.06": {"ON_PLANE": 0.06},
    "crowns as all else": {"VEGETATION": -1},
    "CROWN_PX 4": {"CROWN_PX": 4},
    "CROWN_PX 24": {"CROWN_PX": 24},
    "CROWN_GUESSED 0": {"CROWN_GUESSED": 0.0},
    "CROWN_GUESSED 0.5": {"CROWN_GUESSED": 0.5},
    "CROWN_GUESSED 1": {"CROWN_GUESSED": 1.0},
    "neither crowns nor TOPMOST_PX": {"VEGETATION": -1, "TOPMOST_PX": 0},
    "SAME_SURFACE 1.2": {"SAME_SURFACE": 1.2},
    "SAME_SURFACE 1.8": {"SAME_SURFACE": 1.8},
    "SAME_SURFACE inf: all between two points is one surface": {"SAME_SURFACE": 1e9},
}


class Case(NamedTuple):
    """Arguments of `measured_depth` of a scan, and true depths (H, W) by name, metres, 0 where none counts."""

    arguments: tuple[Any, ...]
    true_m: Mapping[str, Tensor]


def arguments_of(pipeline: Pipeline, scan: Scan) -> tuple[Any, ...]:
    """Translate a scan, and return what `measured_depth` is called with."""
    with patch.object(stages, "measured_depth", wraps=depth.measured_depth) as function:
        pipeline.translate(scan, Timer(pipeline.device))
    return function.call_args.args


def town_case(pipeline: Pipeline, frame: Frame, truth: PanoramaGroundTruth) -> Case:
    """Take depths of a true panorama, in the middle of each pixel of the pipeline's."""
    assert truth.depth_m is not None, f"{frame.name}: its true panorama has no depths"
    own = replace(pipeline, view=replace(pipeline.view, origin=truth.view.origin))
    finer = truth.depth_m.shape[1] // own.view.columns
    true_m = torch.as_tensor(truth.depth_m)[finer // 2 :: finer, finer // 2 :: finer].float()
    return Case(arguments_of(own, frame.scan), {AROUND: torch.where(true_m.isfinite(), true_m, 0.0)})


def hidden_case(pipeline: Pipeline, scan: Scan) -> Case:
    """Hide points of a scan; pixels with a point that is left do not count."""
    scan = scan.beyond()
    above = np.argsort(np.argsort(bands(scan, 0.01), kind="stable")) >= 0.75 * len(scan)
    between = (bands(scan, 1.0) % 2 == 1) & ~above
    left = subset(scan, ~between & ~above)
    empty = ~project(left, pipeline.view).valid
    true_m = {}
    for name, mask in ((BETWEEN, between), (ABOVE, above)):
        image = project(subset(scan, mask), pipeline.view)
        true_m[name] = image.channels[0] * (image.valid & empty)
    return Case(arguments_of(pipeline, left), true_m)


def errors(cases: Sequence[Case], numbers: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the metrics of depths of a place, by the name of what is true."""
    metrics: dict[str, DepthError] = {}
    with ExitStack() as stack:
        for module in (depth, surfaces):
            names = {name: value for name, value in numbers.items() if name in vars(module)}
            stack.enter_context(patch.dict(vars(module), names))
        for number, case in enumerate(cases):
            depth_m = depth.measured_depth(*case.arguments)[0]
            for name, true_m in case.true_m.items():
                metrics.setdefault(name, DepthError()).update(depth_m, true_m, str(number))
    return {name: metric.values() for name, metric in metrics.items()}


def rows(weights: str, places: Sequence[tuple[Path, str]], most: int) -> Iterator[str]:
    """Yield the lines of the table."""
    pipeline = lidar2pano.load(weights)
    cases = []
    for root, split in places:
        scans = list(frames(root, split))
        chosen = scans[:: max(1, len(scans) // most)][:most]
        cases.append(
            [
                town_case(pipeline, frame, frame.panorama)
                if frame.panorama and is_dense(frame.panorama)
                else hidden_case(pipeline, frame.scan)
                for frame in chosen
            ]
        )
    yield f"| numbers | {BETWEEN}: AbsRel | {ABOVE}: AbsRel | {AROUND}: AbsRel | delta1 |"
    yield "| --- | ---: | ---: | ---: | ---: |"
    for title, numbers in VARIANTS.items():
        values = [errors(part, numbers) for part in cases]
        cells = [
            f"{np.mean([place[name][metric] for place in values if name in place]):.4f}" for name, metric in COLUMNS
        ]
        yield f"| {title} | {' | '.join(cells)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights")
    parser.add_argument("places", nargs="+", metavar="DATA:SPLIT")
    parser.add_argument("--frames", type=int, default=5, help="of each place, spread over the split")
    options = parser.parse_args()
    places = [(Path(root), split) for root, _, split in (place.rpartition(":") for place in options.places)]
    with torch.inference_mode():
        for row in rows(options.weights, places, options.frames):
            print(row, flush=True)


if __name__ == "__main__":
    main()
