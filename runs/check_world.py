"""Consistency of a simulated data set: points of scans projected into the images by the package's own geometry.

    python runs/check_world.py ROOT [--frames N]

Compares each point's class with the class of its pixel in the panorama and in the camera image, and its distance with
the panorama's depth. Pixels at edges (a neighbour of another class, or much nearer or farther) are left out, because
the pixel centre and the point may lie on different objects. Points hidden from the panorama, by its own depth image,
are left out too: the LiDAR is a third of a metre beside the camera; their share is printed. Prints one Markdown table.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image

from lidar2pano.data.semantic_kitti import SemanticKittiFrame, frames
from lidar2pano.geometry.camera import points_in_camera
from lidar2pano.geometry.projection import pixels
from lidar2pano.labels import TABLES
from lidar2pano.views import VIEWS, View

STEPS = 256  # depth pictures: per metre
BEHIND = 0.02  # share of the depth, and a decimetre, that a hidden point lies farther
EDGE = 0.06  # share of the depth by which neighbours differ at an edge


class Agreement(NamedTuple):
    """Of one frame: points compared and share of them with the same class, in panorama and camera; depth error.

    hidden  share of the points that are not visible from the panorama's origin.
    """

    panorama_points: int
    hidden: float
    panorama_same: float
    camera_points: int
    camera_same: float
    depth_error_m: float


def edges(ids: np.ndarray, depth: np.ndarray | None) -> np.ndarray:
    """Pixels (H, W) bool with another class, or another depth, among their eight neighbours."""
    out = np.zeros(ids.shape, dtype=bool)
    out[0] = out[-1] = out[:, 0] = out[:, -1] = True
    middle = slice(1, -1)
    for row in (-1, 0, 1):
        for column in (-1, 0, 1):
            shifted = (slice(1 + row, ids.shape[0] - 1 + row), slice(1 + column, ids.shape[1] - 1 + column))
            out[middle, middle] |= ids[shifted] != ids[middle, middle]
            if depth is not None:
                out[middle, middle] |= np.abs(depth[shifted] - depth[middle, middle]) > EDGE * depth[middle, middle]
    return out


def interpolated(depth: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Depth between pixel middles (at .5): its inverse is linear on planes, so that is what is interpolated."""
    inverse = 1 / np.maximum(depth, 1e-3)
    i, j = np.floor(row - 0.5).astype(int), np.floor(column - 0.5).astype(int)
    p, q = row - 0.5 - i, column - 0.5 - j
    i2, j2 = np.minimum(i + 1, depth.shape[0] - 1), (j + 1) % depth.shape[1]
    upper = inverse[i, j] * (1 - q) + inverse[i, j2] * q
    return 1 / (upper * (1 - p) + (inverse[i2, j] * (1 - q) + inverse[i2, j2] * q) * p)


def agreement(frame: SemanticKittiFrame, view: View) -> Agreement:
    """Compare a frame's scan with its images; `view` is the raster of pano/."""
    scan = frame.scan
    labels = TABLES["semantic-kitti", "common-15"][frame.require("point_labels")[0]]
    images = {
        name: np.array(Image.open(frame.folder / name / f"{frame.stem}.png")) for name in ("pano_labels", "pano_depth")
    }
    ids, depth = images["pano_labels"], images["pano_depth"].astype(np.float64) / STEPS
    away = torch.from_numpy(scan.xyz).double() - torch.tensor(view.origin, dtype=torch.float64)
    x, y, z = away.unbind(-1)
    row, column = (place.numpy() for place in pixels(x, y, z, view))
    inside = (row >= 0) & (row < view.rows) & (labels > 0)
    points = np.flatnonzero(inside)
    r, c = row[points].astype(int), column[points].astype(int) % view.columns
    clear = ~edges(ids, depth)[r, c] & (depth[r, c] > 0)
    points, r, c = points[clear], r[clear], c[clear]
    gap = away[points].norm(dim=1).numpy() - interpolated(depth, row[points], column[points])
    visible = gap < BEHIND * depth[r, c] + 0.1
    agreed = ids[r, c][visible] == labels[points][visible]
    # The camera stands where the panorama does: what is hidden from one is hidden from the other.
    compared = np.zeros(len(scan), dtype=bool)
    compared[points[visible]] = True
    camera_points, camera_same = in_camera(frame, scan.xyz, np.where(compared, labels, 0))
    error = float(np.median(np.abs(gap[visible][agreed])))
    return Agreement(
        int(visible.sum()), float(1 - visible.mean()), float(agreed.mean()), camera_points, camera_same, error
    )


def in_camera(frame: SemanticKittiFrame, xyz: np.ndarray, labels: np.ndarray) -> tuple[int, float]:
    """Points compared in the camera's image, and the share of them with the same class; label 0: not compared."""
    raw = frame.require("camera_labels")[0]
    table = np.zeros(256, dtype=np.uint8)
    table[:19] = TABLES["cityscapes", "common-15"]
    ids = table[raw]
    height, width = ids.shape
    u, v, depth = (part.numpy() for part in points_in_camera(torch.from_numpy(xyz), frame.require("calibration")[0]))
    with np.errstate(invalid="ignore"):
        inside = (depth > 0) & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5) & (labels > 0)
    points = np.flatnonzero(inside)
    r, c = np.rint(v[points]).astype(int), np.rint(u[points]).astype(int)
    clear = ~edges(ids, None)[r, c] & (ids[r, c] > 0)
    return int(clear.sum()), float((ids[r, c] == labels[points])[clear].mean())


def main() -> None:
    """Read the arguments and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("--frames", type=int, default=10)
    arguments = parser.parse_args()
    base, _, part = json.loads((arguments.root / "world.json").read_text(encoding="utf-8"))["views"][0].partition("/")
    view = VIEWS[base].scaled(1 / int(part or 1))
    print(
        "| frame | points in panorama | hidden | same class | points in camera | same class | median depth error, cm |"
    )
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    some = frames(arguments.root, "all")
    for frame in some[:: max(len(some) // arguments.frames, 1)][: arguments.frames]:
        result = agreement(frame, view)
        print(
            f"| {frame.name} | {result.panorama_points} | {result.hidden:.2%} | {result.panorama_same:.2%} |"
            f" {result.camera_points} | {result.camera_same:.2%} | {100 * result.depth_error_m:.2f} |"
        )


if __name__ == "__main__":
    main()
