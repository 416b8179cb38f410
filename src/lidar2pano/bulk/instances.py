"""Instances of a labelled scan on its panorama."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from lidar2pano.geometry.projection import project
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI, TABLES, THINGS
from lidar2pano.panorama import Panorama
from lidar2pano.scan import Scan

REACH = 12  # pixels of the translator's raster: beams are up to about so many rows apart


def instance_raster(scan: Scan, instance: np.ndarray, panorama: Panorama) -> np.ndarray:
    """Return instance ids (h, w) uint16 on the panorama's raster, 0 for none.

    scan      with labels;  instance: (N,) uint16 ids of its points, unique within a class.
    A pixel gets the instance of the nearest point of the pixel's own class, at most 2 REACH pixels away through pixels
    of that class; of several equally near ones, the greatest id.
    """
    assert scan.label is not None
    image = project(scan.beyond(), panorama.view.scaled(1 / 2))
    ids = image.spread(torch.from_numpy(instance.astype(np.int64)))
    table = torch.from_numpy(TABLES[SEMANTIC_KITTI.name, COMMON15.name])
    classes = image.spread(table[torch.from_numpy(scan.label)])
    segments = torch.from_numpy(panorama.segments)
    rows = [segments[row::2, column::2] for row in (0, 1) for column in (0, 1)]
    instances = torch.zeros(segments.shape, dtype=torch.int64)
    for thing in THINGS:
        seeds = ids * (classes == thing)
        if not bool(seeds.any()):
            continue
        inside = torch.stack([part == thing for part in rows]).any(0)
        grown = grow(seeds * inside, inside, REACH)
        instances = torch.where(segments == thing, grown.repeat_interleave(2, 0).repeat_interleave(2, 1), instances)
    return instances.numpy().astype(np.uint16)


def grow(seeds: Tensor, inside: Tensor, steps: int) -> Tensor:
    """Spread ids (H, W) int64 from `seeds` (0: none) over the pixels `inside`, one pixel all around per step.

    The columns are circular. Of several ids in the same step a pixel takes the greatest.
    """
    grown = seeds
    for _ in range(steps):
        padded = pad(pad(grown[None, None].float(), (1, 1, 0, 0), mode="circular"), (0, 0, 1, 1))
        reached = max_pool2d(padded, 3, stride=1)[0, 0].long()  # ids of 16 bits are exact as float32
        grown = torch.where((grown == 0) & inside, reached, grown)
    return grown
