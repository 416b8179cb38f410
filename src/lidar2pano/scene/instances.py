"""Instances of things: the connected surfaces of one class, from belief alone."""

from __future__ import annotations

import numpy as np
import torch

from lidar2pano.labels import THINGS
from lidar2pano.scene.surfaces import same_surface

# Least number of pixels of an instance: that of Cityscapes' benchmark of instances (cityscapesscripts,
# evalInstanceLevelSemanticLabeling.py, minRegionSizes). Smaller surfaces have a class only.
LEAST_PIXELS = 100


def thing_instances(segments: np.ndarray, depth_m: np.ndarray, measured: np.ndarray, *, circular: bool) -> np.ndarray:
    """Return the number (H, W) int32 of each pixel's instance, from 1 in the order of rows; 0 for none.

    An instance is a connected surface (`same_surface` of neighbours to the side, above and below) of one class of
    THINGS with LEAST_PIXELS and a point of the scan at least; others are guesses about one thing or several.

    segments  (H, W) ids of COMMON15;  depth_m: (H, W) metres;  measured: (H, W) bool, pixels with a point.
    circular  whether the first column is the last one's neighbour.
    """
    things = np.isin(segments, THINGS) & (depth_m > 0)
    node = np.full(segments.shape, -1)
    node[things] = np.arange(things.sum())
    pairs = [_joined(node, segments, depth_m, axis, circular=circular and axis == 1) for axis in (0, 1)]
    first, second = (np.concatenate(ends) for ends in zip(*pairs, strict=True))
    surface = np.full(segments.shape, -1)
    surface[things] = components(int(things.sum()), first, second)
    pixels = np.bincount(surface[things], minlength=1)
    points = np.bincount(surface[things], weights=measured[things], minlength=1)
    kept = (pixels >= LEAST_PIXELS) & (points > 0)
    number = np.where(kept, kept.cumsum(), 0).astype(np.int32)
    return np.where(things, number[surface], 0).astype(np.int32)


def _joined(
    node: np.ndarray, segments: np.ndarray, depth_m: np.ndarray, axis: int, *, circular: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs of nodes that are neighbours along an axis and of one class and surface."""
    next_node, next_class, next_m = (np.roll(layer, -1, axis) for layer in (node, segments, depth_m))
    joined = (node >= 0) & (next_node >= 0) & (segments == next_class)
    joined &= same_surface(torch.from_numpy(depth_m), torch.from_numpy(next_m)).numpy()
    if not circular:
        joined[(slice(None),) * axis + (-1,)] = False
    return node[joined], next_node[joined]


def components(nodes: int, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the number (N,) of each node's connected component, from 0 in the order of their first nodes.

    first, second  the ends of each edge. Roots are hooked onto smaller ones and paths halved, in a number of rounds
    that grows with the logarithm of N (Shiloach and Vishkin, 1982).
    """
    root = np.arange(nodes)
    while True:
        one, other = root[first], root[second]
        if (one == other).all():
            return np.unique(root, return_inverse=True)[1]
        np.minimum.at(root, np.maximum(one, other), np.minimum(one, other))
        while (root[root] != root).any():
            root = root[root]
