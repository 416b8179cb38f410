"""What a stream of panoramas carries from one scan to the next, and temporal smoothing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from lidar2pano.geometry.flow import distances_before, ego_flow
from lidar2pano.geometry.warp import warp
from lidar2pano.labels import COMMON15
from lidar2pano.views import View

MOST = 6  # scans or images that a mean is taken of; larger flickers less, adapts slower
MOST_RATIO = 2.0  # of depths of one surface in two scans, as they are averaged
SKY = COMMON15.id_of("sky")
SAME = 0.3  # share by which two depths of one surface may differ: the translator predicts them for each scan


class Surroundings(NamedTuple):
    """Classes and depths as averaged over scans, on the translator's raster H x W.

    segments        (1, classes, H, W) float32 probabilities;  depth_m: (1, H, W) float32 metres from the view's origin.
    count           (H, W) float32: how many scans each pixel is the mean of.
    T_world_sensor  (4, 4) float64, metres.
    """

    segments: Tensor
    depth_m: Tensor
    count: Tensor
    T_world_sensor: Tensor

    @property
    def ids(self) -> Tensor:
        """(H, W) uint8: the likeliest classes."""
        return self.segments[0].max(0).indices.to(torch.uint8)

    @property
    def distance_m(self) -> Tensor:
        """(H, W) float32 metres; infinite for the sky."""
        return torch.where(self.ids == SKY, torch.inf, self.depth_m[0])


class PreviousFrame(NamedTuple):
    """A panorama as temporal smoothing needs it with the next scan, on the translator's raster H x W.

    image           (1, 3, 2H, 2W) float32 in [-1, 1].
    ids             (H, W) uint8 ids of COMMON15.
    distance_m      (H, W) float32 metres from the view's origin; infinite for the sky.
    count           (H, W) float32: how many images each pixel is the mean of.
    T_world_sensor  (4, 4) float64, metres.
    """

    image: Tensor
    ids: Tensor
    distance_m: Tensor
    count: Tensor
    T_world_sensor: Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """What a stream carries from one scan to the next. `Memory()` is its beginning.

    frames    number of scans before; a panorama's `frame` is its place in the stream.
    painted   what the painter gets back with the next scan (StreamPainter).
    around    classes and depths that were painted last, and previous: the latest panorama, where the sensor's pose was
              given.
    """

    frames: int = 0
    painted: Any = None
    around: Surroundings | None = None
    previous: PreviousFrame | None = None


def fused(now: Surroundings, before: Surroundings, view: View) -> Surroundings:
    """`now` averaged with the scans before it, moved to where the same surfaces are now.

    What is painted of it wavers less: invented windows and paint hang on depths, which the translator predicts for each
    scan again. Where `ego_flow` knows the flow, probabilities are averaged, and so are the logarithms of depths, each
    changed as the sensor's motion has changed it; elsewhere the mean starts again. Weights are those of `smoothed`.
    view  the raster of both.
    """
    T_before_now = torch.linalg.inv(before.T_world_sensor) @ now.T_world_sensor
    distance_m, distance_before_m = now.distance_m, before.distance_m
    flow = ego_flow(distance_m, distance_before_m, T_before_now, view, same=SAME)
    parts = [before.segments, before.count[None, None], (1 / distance_before_m)[None, None]]
    past = warp(torch.cat(parts, 1), flow.shift[None], circular=True)
    segments, count, inverse = past.split((now.segments.shape[1], 1, 1), 1)
    count = count[0, 0].clamp(max=MOST - 1) * flow.known
    weight = count / (count + 1)
    ratio = 1 / (inverse[0, 0] * distances_before(distance_m, T_before_now, view))
    ratio = torch.where(flow.known & distance_m.isfinite(), ratio.clamp(1 / MOST_RATIO, MOST_RATIO), 1.0)
    return now._replace(
        segments=torch.lerp(now.segments, segments, weight),
        depth_m=now.depth_m * ratio.pow(weight),
        count=count + 1,
    )


def smoothed(now: PreviousFrame, before: PreviousFrame, view: View) -> PreviousFrame:
    """`now` with its image averaged with those before, which are warped to where the same surfaces are now.

    Poses and distances give the warp (geometry.flow.ego_flow). A pixel is averaged where both panoramas agree on its
    distance and class; elsewhere the mean starts again. The newest image weighs 1 / count, at least 1 / MOST.
    view  the raster H x W of both.
    """
    T_before_now = torch.linalg.inv(before.T_world_sensor) @ now.T_world_sensor
    flow = ego_flow(now.distance_m, before.distance_m, T_before_now, view, same=SAME)
    rows, columns = torch.meshgrid(
        torch.arange(view.rows, device=flow.shift.device),
        torch.arange(view.columns, device=flow.shift.device),
        indexing="ij",
    )
    before_row = (rows + flow.shift[1].round().long()).clamp(0, view.rows - 1)
    before_column = (columns + flow.shift[0].round().long()).remainder(view.columns)
    same = flow.known & (before.ids[before_row, before_column] == now.ids)
    count = before.count[before_row, before_column].clamp(max=MOST - 1) * same
    weight, shift = (
        interpolate(part[None], scale_factor=2.0) for part in ((count / (count + 1))[None], 2 * flow.shift)
    )
    past = warp(before.image, shift, circular=True)
    return now._replace(image=torch.lerp(now.image, past, weight), count=count + 1)
