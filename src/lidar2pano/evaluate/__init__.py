"""Evaluation of systems frame by frame: classes, images and depths, in the camera and in the 360-degree panorama.

    system(weights, device="auto", sensor="") -> System
    score(systems, frames, *, data, split, config=None, after_each=...) -> Evaluation
    report.as_dict(evaluation) -> dict[str, Any]     ready for JSON; `table` is Markdown, `records` rows for CSV

weights   an argument of `lidar2pano evaluate`, or a chain "TRANSLATOR+PAINTER"; "oracle" is a TRANSLATOR.
systems   each gets the scan and the calibration of a frame (`SystemInput`); only the oracle gets ground-truth labels.
frames    `data.layouts.frames(root, split)`: the parts of a frame decide the metrics on it.

In the camera the whole image is scored at its own size, in the paper's 14 classes: pixels whose target is unlabeled,
sky or IGNORE do not count; predictions of unlabeled or sky are wrong. mIoU is the mean over those of the 14 classes
in the split's targets. Panoramas likewise, on the ground truth's raster. Unknown colours do not count.
Frames are read one at a time, and metrics keep their sums in temporary files: memory does not grow with the split.
"""

from __future__ import annotations

from lidar2pano.evaluate.evaluation import Evaluation, score
from lidar2pano.evaluate.metric_collection import MetricConfig
from lidar2pano.evaluate.panorama_system import Prediction, System, SystemInput
from lidar2pano.evaluate.systems import system

__all__ = ["Evaluation", "MetricConfig", "Prediction", "System", "SystemInput", "score", "system"]
