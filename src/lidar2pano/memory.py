"""What a stream of panoramas carries from one scan to the next, and temporal smoothing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from lidar2pano.geometry.flow import distances_before, ego_flow, moved_distances
from lidar2pano.geometry.warp import warp
from lidar2pano.labels import COMMON15, THINGS
from lidar2pano.views import View

MOST = 6  # scans or images that a mean is taken of; larger flickers less, adapts slower
LEAST_BEFORE = 2  # scans that what was there before counts for at least: any of them is as good as the newest
LEAST_IMAGES = 5  # likewise images: the mean of two is paler than either, so that one of them has to prevail
DOUBT = 0.5  # scans by which what was there counts for less with each that contradicts it
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


def fused(now: Surroundings, before: Surroundings, view: View, measured: Tensor) -> Surroundings:
    """`now` averaged with the scans before it, moved to where the same surfaces are now.

    What is painted of it wavers less: invented windows and paint hang on depths, which the translator predicts for each
    scan again. Where `ego_flow` knows the flow, probabilities are averaged, and so are the logarithms of depths, each
    changed as the sensor's motion has changed it; elsewhere the mean starts again. Weights are those of `smoothed`.
    Where this scan's depth contradicts those before and was not measured, crowns and roofs above the scan would come
    and go: what was there before stays, at its depth, until the mean of the probabilities is for another class, or
    `DOUBT` has used up its count. What may move does not stay.
    view      the raster of both.
    measured  (H, W) bool: where this scan's depths come from its points.
    """
    T_before_now = torch.linalg.inv(before.T_world_sensor) @ now.T_world_sensor
    distance_m, distance_before_m = now.distance_m, before.distance_m
    flow = ego_flow(distance_m, distance_before_m, T_before_now, view, same=SAME)
    moved_m = moved_distances(distance_before_m, torch.linalg.inv(T_before_now), view)
    stays = ego_flow(moved_m, distance_before_m, T_before_now, view, same=SAME)
    contradicted = stays.known & ~flow.known & ~measured
    shift = torch.where(contradicted, stays.shift, flow.shift)
    parts = [before.segments, before.count[None, None], (1 / distance_before_m)[None, None]]
    past = warp(torch.cat(parts, 1), shift[None], circular=True)
    segments, count, inverse = past.split((now.segments.shape[1], 1, 1), 1)
    ids = segments[0].max(0).indices
    count = count[0, 0].clamp(max=MOST - 1)
    contradicted &= ~may_move(ids) & (count > DOUBT)
    count = count * (flow.known | contradicted)
    weight = _weight(count, LEAST_BEFORE)
    mean = torch.lerp(now.segments, segments, weight)
    stay = contradicted & (mean[0].max(0).indices == ids)
    ratio = 1 / (inverse[0, 0] * distances_before(distance_m, T_before_now, view))
    ratio = torch.where(flow.known & distance_m.isfinite(), ratio.clamp(1 / MOST_RATIO, MOST_RATIO), 1.0)
    return now._replace(
        segments=mean,
        depth_m=torch.where(stay & moved_m.isfinite(), moved_m, now.depth_m * ratio.pow(weight)),
        count=torch.where(stay, count - DOUBT, torch.where(flow.known, count + 1, 1.0)),
    )


def smoothed(now: PreviousFrame, before: PreviousFrame, view: View) -> PreviousFrame:
    """`now` with its image averaged with those before, which are warped to where the same surfaces are now.

    Poses and distances give the warp (geometry.flow.ego_flow). A pixel is averaged where both panoramas agree on its
    distance, and on its class if either may move; elsewhere the mean starts again. Images before count for
    `LEAST_IMAGES` at least, the newest for 1 / `MOST` at least.
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
    ids = before.ids[before_row, before_column]
    same = flow.known & ((ids == now.ids) | ~(may_move(ids) | may_move(now.ids)))
    count = before.count[before_row, before_column].clamp(max=MOST - 1) * same
    weight, shift = (
        interpolate(part[None], scale_factor=2.0) for part in (_weight(count, LEAST_IMAGES)[None], 2 * flow.shift)
    )
    past = warp(before.image, shift, circular=True, cubic=True).clamp_(-1, 1)
    return now._replace(image=torch.lerp(now.image, past, weight), count=count + 1)


def may_move(ids: Tensor) -> Tensor:
    """Bool: which ids of COMMON15 are of classes that may move."""
    return torch.isin(ids, ids.new_tensor(THINGS))


def _weight(count: Tensor, least: float) -> Tensor:
    """Weight of what `count` scans or images were averaged to, in a mean with one more; 0 of none."""
    count = torch.where(count > 0, count.clamp(min=least), 0.0)
    return count / (count + 1)
