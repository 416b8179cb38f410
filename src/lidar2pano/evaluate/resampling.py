"""Resampling a predicted panorama to the ground truth's raster, and the windows in which panoramas are compared."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch

from lidar2pano.geometry.camera import Lookup
from lidar2pano.geometry.projection import directions, pixels
from lidar2pano.panorama import Panorama
from lidar2pano.views import View

WINDOWS = 4  # a quarter of KITTI's panorama has about the shape of the camera's image
GREY = 128  # of unknown pixels, on both sides
ZERO = (0.0, 0.0, 0.0)


class Resampled(NamedTuple):
    """A panorama on another raster (H, W); beyond the old one it is black, unlabeled and without depth.

    image (H, W, 3) uint8;  labels (H, W) uint8 of COMMON15;  depth_m (H, W) float32.
    """

    image: np.ndarray
    labels: np.ndarray
    depth_m: np.ndarray


def resampled(panorama: Panorama, view: View) -> Resampled:
    """The panorama on the raster `view`; the origins of the two views are ignored."""
    if same_raster(panorama.view, view):
        return Resampled(panorama.colour, panorama.segments, panorama.depth_m)
    lookup = resampling_lookup(replace(panorama.view, origin=ZERO), replace(view, origin=ZERO))
    image = lookup.linear(torch.from_numpy(panorama.colour).movedim(2, 0).float())
    return Resampled(
        image=image.round().movedim(0, 2).to(torch.uint8).numpy(),
        labels=lookup.nearest(torch.from_numpy(panorama.segments)).numpy(),
        depth_m=lookup.nearest(torch.from_numpy(panorama.depth_m)).numpy(),
    )


def same_raster(one: View, other: View) -> bool:
    """Whether two views have the same pixels, whatever their origins."""
    first, second = (astuple(replace(view, kind="sphere", origin=ZERO)) for view in (one, other))
    numbers = [np.array([value for value in values if isinstance(value, int | float)]) for values in (first, second)]
    return one.kind == other.kind and np.allclose(numbers[0], numbers[1], rtol=0, atol=1e-9)


@lru_cache(maxsize=4)
def resampling_lookup(old: View, new: View) -> Lookup:
    """Look-up that resamples an image on the raster `old` to `new`, around the same origin."""
    x, y, z = directions(new).unbind(-1)
    row, column = pixels(x, y, z, old)
    valid = (row >= 0) & (row < old.rows)
    if not old.circular:
        valid &= (column >= 0) & (column < old.columns)
    row, column = (torch.where(valid, position, 0.0).float() for position in (row, column))
    return Lookup(row=row, column=column, valid=valid, circular=old.circular)


def windows(predicted: np.ndarray, target: np.ndarray, valid: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Quarters of two panoramas (H, W, 3) uint8 of which at least half is valid; other pixels are grey in both."""
    hidden = ~valid[..., None]
    sides = [np.where(hidden, np.uint8(GREY), side) for side in (predicted, target)]
    for part in np.array_split(np.arange(valid.shape[1]), min(WINDOWS, valid.shape[1])):
        cut = slice(int(part[0]), int(part[-1]) + 1)
        if valid[:, cut].mean() >= 0.5:
            yield sides[0][:, cut], sides[1][:, cut]
