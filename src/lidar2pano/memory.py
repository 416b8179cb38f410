"""What a stream of panoramas carries from one scan to the next, and how it steadies the next picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from lidar2pano.geometry.flow import ego_flow
from lidar2pano.geometry.warp import warp
from lidar2pano.views import View

MOST = 6  # pictures that a mean is taken of: more are sharper where poses are exact, and slower to believe a change
SAME = 0.3  # share by which two depths of one surface may differ: a translator guesses them anew each time


class Shown(NamedTuple):
    """A panorama as the next one is steadied by it, on the translator's raster H x W.

    picture     (1, 3, 2H, 2W) float32 in [-1, 1].
    ids         (H, W) uint8 ids of COMMON15.
    distance_m  (H, W) float32 metres from the view's origin; infinite for the sky.
    count       (H, W) float32: how many pictures each pixel is the mean of.
    pose        (4, 4) float64: the sensor's coordinates -> coordinates that stand still.
    """

    picture: Tensor
    ids: Tensor
    distance_m: Tensor
    count: Tensor
    pose: Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """What a stream carries from one scan to the next. `Memory()` is its beginning.

    frames   scans seen so far; a panorama's `frame` is its place in the stream.
    painted  what the painter wants back with the next scan (StreamPainter).
    shown    the latest panorama, where the sensor's pose was told.
    """

    frames: int = 0
    painted: Any = None
    shown: Shown | None = None


def steadied(now: Shown, before: Shown, view: View) -> Shown:
    """`now` with its picture averaged with those before, carried over to where the same things are now.

    Poses and distances say where a pixel was (geometry.flow.ego_flow). A pixel is averaged where both panoramas agree
    on its distance and class; elsewhere it begins anew. The newest picture weighs 1 / count, at least 1 / MOST.
    view  the raster H x W of both.
    """
    motion = torch.linalg.inv(before.pose) @ now.pose
    flow = ego_flow(now.distance_m, before.distance_m, motion, view, same=SAME)
    rows, columns = torch.meshgrid(
        torch.arange(view.rows, device=flow.shift.device),
        torch.arange(view.columns, device=flow.shift.device),
        indexing="ij",
    )
    there_row = (rows + flow.shift[1].round().long()).clamp(0, view.rows - 1)
    there_column = (columns + flow.shift[0].round().long()).remainder(view.columns)
    same = flow.known & (before.ids[there_row, there_column] == now.ids)
    held = before.count[there_row, there_column].clamp(max=MOST - 1) * same
    share, shift = (interpolate(part[None], scale_factor=2.0) for part in ((held / (held + 1))[None], 2 * flow.shift))
    past = warp(before.picture, shift, closed=True)
    return now._replace(picture=torch.lerp(now.picture, past, share), count=held + 1)
