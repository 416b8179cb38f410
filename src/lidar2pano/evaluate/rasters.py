"""A system's panorama on the truth's raster, and the windows in which panoramas are compared as pictures."""

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
GREY = 128  # of what is not known, on both sides
HERE = (0.0, 0.0, 0.0)


class Carried(NamedTuple):
    """A panorama on another raster (H, W); what lies beyond the old one is black, unlabeled and has no depth.

    colour (H, W, 3) uint8;  ids (H, W) uint8 of COMMON15;  depth_m (H, W) float32.
    """

    colour: np.ndarray
    ids: np.ndarray
    depth_m: np.ndarray


def carried(panorama: Panorama, view: View) -> Carried:
    """The panorama on the raster `view`; both are taken to be seen from one point."""
    if same_raster(panorama.view, view):
        return Carried(panorama.colour, panorama.segments, panorama.depth_m)
    lookup = between(replace(panorama.view, origin=HERE), replace(view, origin=HERE))
    colour = lookup.linear(torch.from_numpy(panorama.colour).movedim(2, 0).float())
    return Carried(
        colour=colour.round().movedim(0, 2).to(torch.uint8).numpy(),
        ids=lookup.nearest(torch.from_numpy(panorama.segments)).numpy(),
        depth_m=lookup.nearest(torch.from_numpy(panorama.depth_m)).numpy(),
    )


def same_raster(one: View, other: View) -> bool:
    """Whether two views have the same pixels, wherever they stand."""
    mine, theirs = (astuple(replace(view, kind="sphere", origin=HERE)) for view in (one, other))
    numbers = [np.array([value for value in values if isinstance(value, int | float)]) for values in (mine, theirs)]
    return one.kind == other.kind and np.allclose(numbers[0], numbers[1], rtol=0, atol=1e-9)


@lru_cache(maxsize=4)
def between(old: View, new: View) -> Lookup:
    """Look-up that resamples a picture on the raster `old` onto `new`, both seen from one point."""
    x, y, z = directions(new).unbind(-1)
    row, column = pixels(x, y, z, old)
    valid = (row >= 0) & (row < old.rows)
    if not old.circular:
        valid &= (column >= 0) & (column < old.columns)
    row, column = (torch.where(valid, place, 0.0).float() for place in (row, column))
    return Lookup(row=row, column=column, valid=valid, circular=old.circular)


def windows(colour: np.ndarray, truth: np.ndarray, valid: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Quarters of two panoramas (H, W, 3) uint8 where at least half of the truth is known; the rest grey on both."""
    hidden = ~valid[..., None]
    sides = [np.where(hidden, np.uint8(GREY), side) for side in (colour, truth)]
    for part in np.array_split(np.arange(valid.shape[1]), min(WINDOWS, valid.shape[1])):
        cut = slice(int(part[0]), int(part[-1]) + 1)
        if valid[:, cut].mean() >= 0.5:
            yield sides[0][:, cut], sides[1][:, cut]
