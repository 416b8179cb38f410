"""Errors of panoramas that are stitched from surround cameras with depths completed from a scan.

    python runs/surround_cost.py [--sensor pandar64] [--seeds 3] [--view panorama/2]

In the street world everything is known: six cameras that stand as PandaSet's do are rendered, and the true panorama and
its depth from the front camera's place. Panoramas are stitched with the true depth, the scan's (`complete_depth`),
and with none (everything far). Prints one Markdown table: the share of valid pixels; their mean difference to the true
panorama in steps of 8 bits, and that of the true panorama to itself shifted by a column, for scale; the displacement of
their sampling positions from those of the true depth, in pixels of the view: median, 90th percentile, share above 4.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lidar2pano.calibration import Calibration
from lidar2pano.geometry.camera import at_camera, points_in_camera
from lidar2pano.geometry.depth_completion import complete_depth
from lidar2pano.geometry.projection import directions
from lidar2pano.geometry.stitching import CameraImage, stitch
from lidar2pano.simulate.dataset.generation import SequenceWriter
from lidar2pano.simulate.dataset.settings import WorldSettings, panorama_view
from lidar2pano.simulate.render.looks import look
from lidar2pano.simulate.render.renderer import cylinder, pinhole, render
from lidar2pano.views import View

SIZE = (960, 540)
# PandaSet's cameras: place in the sensor's frame (metres), degrees to the left of ahead, focal length (pixels).
MOUNTS = (
    ((0.05, 0.0, -0.05), 0.0, 985.0),
    ((0.71, 0.64, -0.33), 57.7, 465.0),
    ((-0.26, 0.54, -0.28), 91.5, 465.0),
    ((-1.06, -0.03, -0.21), 181.7, 467.0),
    ((-0.21, -0.70, -0.31), -91.4, 461.0),
    ((0.68, -0.60, -0.26), -57.8, 465.0),
)


def cameras() -> list[Calibration]:
    """The six, level."""
    found = []
    for place, left, focal in MOUNTS:
        c, s = math.cos(math.radians(left)), math.sin(math.radians(left))
        T = np.eye(4)
        T[:3, :3] = [[s, -c, 0], [0, 0, -1], [c, s, 0]]
        T[:3, 3] = -T[:3, :3] @ np.array(place)
        K = np.array([[focal, 0, (SIZE[0] - 1) / 2], [0, focal, (SIZE[1] - 1) / 2], [0, 0, 1]])
        found.append(Calibration(K=K, T_camera_lidar=T, size=SIZE))
    return found


def displaced(true_m: Tensor, guess_m: Tensor, view: View, mounts: list[Calibration]) -> Tensor:
    """Distances (H, W) in the view's pixels between the look-ups by two depths, in the camera nearest to the true one.

    NaN where no camera sees the true place.
    """
    ray = directions(view).reshape(-1, 3)
    far = 1e5
    ends = [
        depth.reshape(-1, 1).clamp(max=far) * ray + torch.tensor(view.origin)
        for depth in (true_m.where(true_m > 0, far), guess_m)
    ]
    best, gap = torch.full((len(ray),), torch.inf), torch.full((len(ray),), torch.nan, dtype=torch.float64)
    for camera in mounts:
        (u, v, depth), (u2, v2, _) = (points_in_camera(end, camera) for end in ends)
        inside = (depth > 0) & (u > 0) & (u < SIZE[0] - 1) & (v > 0) & (v < SIZE[1] - 1)
        axis = torch.hypot(u - camera.K[0, 2], v - camera.K[1, 2]) / float(camera.K[0, 0])
        nearer = inside & (axis < best)
        shift = torch.hypot(u2 - u, v2 - v) * (view.focal_px / float(camera.K[0, 0]))
        gap = torch.where(nearer, shift.nan_to_num(nan=view.focal_px), gap)
        best = torch.where(nearer, axis.float(), best)
    return gap.view(true_m.shape)


def rows(settings: WorldSettings, seed: int) -> dict[str, list[float]]:
    """Of one street, per depth: valid share, difference, difference to itself when shifted, displacements."""
    writer = SequenceWriter(Path("nowhere"), settings, 0)
    scene, light = writer.scene(0), look(settings.look, writer.seed)
    pose = writer.world.drive.poses(np.array([0.0]))[0]
    mounts = cameras()
    view = at_camera(panorama_view(settings.views[0]), mounts[0])
    rendered = render(scene, *cylinder(view, pose), light, seed=seed)
    photos = [
        CameraImage(image=render(scene, *pinhole(one, pose), light, seed=seed + 1 + n).image, calibration=one)
        for n, one in enumerate(mounts)
    ]
    scan = torch.from_numpy(writer.scan(0).points[:, :3].astype(np.float32))
    true_m = torch.from_numpy(rendered.distance)
    guesses = {"true": true_m, "scan": complete_depth(scan, view), "far": torch.full_like(true_m, torch.inf)}
    colour = rendered.image.astype(np.int64)
    found = {}
    for name, guess in guesses.items():
        made, valid = stitch(photos, view, guess)
        off = np.abs(made.astype(np.int64) - colour)[valid].mean()
        aside = np.abs(np.roll(colour, 1, 1) - colour)[valid].mean()
        gap = displaced(true_m, guess, view, mounts)
        quantiles = [
            float(gap.median()),
            float(gap.sort().values[int(0.9 * len(gap))]),
            float((gap > 4).double().mean()),
        ]
        found[name] = [float(valid.mean()), float(off), float(aside), *quantiles]
    return found


def main() -> None:
    """Read the arguments and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensor", default="pandar64")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--view", default="panorama/2")
    arguments = parser.parse_args()
    print(f"{arguments.sensor}, {arguments.view}, {arguments.seeds} streets\n")
    print("| depth | valid | difference | a pixel's | median, px | 90 %, px | above 4 px |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    values = []
    for seed in range(arguments.seeds):
        settings = WorldSettings(seed=seed, frames=1, sensor=arguments.sensor, views=(arguments.view,))
        values.append(rows(settings, seed))
    for name in values[0]:
        valid, off, aside, median, most, share = np.mean([one[name] for one in values], axis=0)
        print(f"| {name} | {valid:.1%} | {off:.2f} | {aside:.2f} | {median:.2f} | {most:.2f} | {share:.1%} |")


if __name__ == "__main__":
    main()
