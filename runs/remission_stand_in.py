"""Write what point classes cost without remissions, by the constant that stands in, and on PandaSet by their scale.

    python runs/remission_stand_in.py [--weights streets] [--kitti data/kitti-mini] [--pandaset data/pandaset-mini]

mIoU of point classes over the classes that occur, one confusion matrix over all frames of the split "val", and of
PandaSet. "mean": remissions multiplied so that their mean is that of KITTI's; "ranks": each replaced by KITTI's
remission of the same rank.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from lidar2pano.data import pandaset
from lidar2pano.data.frames import Frame
from lidar2pano.data.layouts import frames
from lidar2pano.labels import SEMANTIC_KITTI
from lidar2pano.models.families import weight_files
from lidar2pano.pipeline import Segmenter, load_segmenter
from lidar2pano.views import VIEWS

CONSTANTS = (0.0, 0.1, 0.2, 0.25, 0.3, 0.4)
Change = Callable[[np.ndarray], np.ndarray]


def mean_iou(segmenter: Segmenter, chosen: Iterable[Frame], change: Change) -> float:
    """mIoU of point classes with changed remissions; labels 0 are not scored."""
    classes = len(SEMANTIC_KITTI)
    confusion = np.zeros((classes, classes), np.int64)
    for frame in chosen:
        scan, labels = frame.require("scan", "point_labels")
        ids = segmenter.points(replace(scan, remission=change(scan.remission).astype(np.float32))).numpy()
        confusion += np.bincount(labels * classes + ids, minlength=classes**2).reshape(classes, classes)
    confusion = confusion[1:]
    hits = confusion[np.arange(classes - 1), np.arange(1, classes)]
    union = confusion.sum(1) + confusion[:, 1:].sum(0) - hits
    return float((hits / np.maximum(union, 1))[confusion.sum(1) > 0].mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--weights", default="streets")
    parser.add_argument("--kitti", type=Path, default=Path("data/kitti-mini"))
    parser.add_argument("--pandaset", type=Path, default=Path("data/pandaset-mini"))
    parser.add_argument("--every", type=int, default=1, help="one of so many frames")
    arguments = parser.parse_args()
    segmenter, _ = load_segmenter(weight_files(arguments.weights)["segmenter"], torch.device("cpu"))
    street = list(frames(arguments.kitti, "val"))[:: arguments.every]
    reference = np.sort(np.concatenate([frame.require("scan")[0].remission[::20] for frame in street]))

    def ranked(values: np.ndarray) -> np.ndarray:
        rank = np.argsort(np.argsort(values, kind="stable"), kind="stable") / max(len(values) - 1, 1)
        return np.interp(rank, np.linspace(0, 1, len(reference)), reference)

    changes: dict[str, Change] = {"as they are": lambda values: values}
    changes |= {f"{constant:g}": lambda values, fill=constant: np.full_like(values, fill) for constant in CONSTANTS}
    print("| remission | KITTI val, mIoU | PandaSet, mIoU |\n| --- | ---: | ---: |", flush=True)
    pandaset_frames = list(pandaset.frames(arguments.pandaset, "all", VIEWS["panorama"]))[:: 3 * arguments.every]
    more: dict[str, Change] = {
        "mean": lambda values: np.minimum(values * (reference.mean() / values.mean()), 1),
        "ranks": ranked,
    }
    for name, change in (changes | more).items():
        first = f"{mean_iou(segmenter, street, change):.3f}" if name in changes else "-"
        print(f"| {name} | {first} | {mean_iou(segmenter, pandaset_frames, change):.3f} |", flush=True)


if __name__ == "__main__":
    main()
