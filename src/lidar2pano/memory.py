"""Memory of a stream of panoramas, and temporal smoothing."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from lidar2pano.geometry.flow import ego_flow, ego_flows, moved_distances, relative_pose
from lidar2pano.geometry.rasters import adjacent_rows, likeliest, warp
from lidar2pano.labels import COMMON15, THINGS
from lidar2pano.scene.record import Scene
from lidar2pano.views import View

MOST = 6  # scans or images that a mean is taken of; larger flickers less, adapts slower
LEAST_IMAGES = 3  # images that the previous ones count for at least: the mean of two is paler than either
DOUBT = 0.5  # scans that are subtracted from a count for each scan that contradicts it
SKY = COMMON15.id_of("sky")
SAME = 0.3  # share by which two depths of one surface may differ: the translator predicts them for each scan
ANY = 1.0  # such a share that all depths agree
FADED = 0.75  # weight of the previous image where a class has changed at the same distance


class Surroundings(NamedTuple):
    """Classes averaged over scans, and depths, on the scene's raster H x W.

    probabilities   (1, classes, H, W) float32;  depth_m: (1, H, W) float32 metres from the view's origin.
    count           (H, W) float32: how many scans each pixel is the mean of.
    supported       (H, W) bool: the latest scan has a point in the pixel or above it, which says its depth.
    T_world_sensor  (4, 4) float64, metres.
    """

    probabilities: Tensor
    depth_m: Tensor
    count: Tensor
    supported: Tensor
    T_world_sensor: Tensor

    @classmethod
    def of(cls, scene: Scene) -> Surroundings:
        """Return those of a single scan whose pose is known."""
        upper_row, _ = adjacent_rows(scene.measured)
        pose = torch.from_numpy(np.asarray(scene.T_world_sensor, dtype=np.float64)).to(scene.depth_m.device)
        return cls(scene.probabilities, scene.depth_m, torch.ones_like(scene.depth_m[0]), upper_row[0] >= 0, pose)

    @property
    def ids(self) -> Tensor:
        """(H, W) uint8: the likeliest classes."""
        return likeliest(self.probabilities)[0]

    @property
    def surface_share(self) -> Tensor:
        """(H, W) float32: probability that a pixel shows a surface and not the sky; 1 where it is supported."""
        return torch.where(self.supported | (self.ids == SKY), 1.0, 1 - self.probabilities[0, SKY])

    @property
    def parallax_distance_m(self) -> Tensor:
        """(H, W) float32 metres, by which a pixel moves as the sensor does; infinite for the sky.

        Its inverse is the mean over the surface and the sky, whose inverse is 0: possible sky moves less.
        """
        return torch.where(self.ids == SKY, torch.inf, self.depth_m[0] / self.surface_share)


class PreviousFrame(NamedTuple):
    """The latest panorama for temporal smoothing, on the scene's raster H x W.

    image                (1, 3, 2H, 2W) float32 in [-1, 1].
    ids                  (H, W) uint8 ids of COMMON15.
    parallax_distance_m  (H, W) float32 metres, as of Surroundings.
    count                (H, W) float32: how many images each pixel is the mean of.
    T_world_sensor       (4, 4) float64, metres.
    """

    image: Tensor
    ids: Tensor
    parallax_distance_m: Tensor
    count: Tensor
    T_world_sensor: Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """State that a stream carries from one scan to the next. `Memory()` is its beginning.

    frames    number of scans so far; a panorama's `frame` is its place in the stream.
    view      raster on which the first scan decided, if it did;  painted: the painter's own record of the latest scan
              (StreamPainter).
    around    classes and depths, and previous: the latest panorama, where the sensor's pose was given.
    """

    frames: int = 0
    view: View | None = None
    painted: Any = None
    around: Surroundings | None = None
    previous: PreviousFrame | None = None


def remember(memory: Memory, scene: Scene) -> tuple[Memory, Scene]:
    """Fuse a scene, whose pose is known, with the previous ones; returns the memory with it, and the fused scene."""
    around = Surroundings.of(scene)
    if memory.around is not None:
        around = fused(around, memory.around, scene.view)
    return replace(memory, around=around), replace(scene, probabilities=around.probabilities, depth_m=around.depth_m)


def steady(memory: Memory, image: Tensor, view: View) -> tuple[Memory, Tensor]:
    """Average a painted image (1, 3, 2H, 2W) with the previous ones; returns the memory with it, and the image.

    view  the raster H x W of `memory.around`, which is the scene that was painted.
    """
    around = memory.around
    assert around is not None, "of a stream with poses"
    latest = PreviousFrame(
        image=image.float(),
        ids=around.ids,
        parallax_distance_m=around.parallax_distance_m,
        count=torch.ones_like(around.count),
        T_world_sensor=around.T_world_sensor,
    )
    if memory.previous is not None:
        latest = smoothed(latest, memory.previous, view)
    return replace(memory, previous=latest), latest.image


def fused(now: Surroundings, previous: Surroundings, view: View) -> Surroundings:
    """`now` averaged with the scans before it, moved to where the same surfaces are now.

    Where `ego_flow` knows the flow, probabilities are averaged; elsewhere the mean starts again. The newest scan counts
    for a share of 1 / `MOST` or more, and depths are its own: means of depths were less exact, and flickered more
    (RESULTS.md). Where its depth contradicts those before and was not measured, crowns and roofs above the scan would
    come and go: what was there before stays, at its depth, until the mean of the probabilities is for another class, or
    `DOUBT` has used up its count. What may move does not stay.
    view  the raster of both.
    """
    T_before_now = relative_pose(previous.T_world_sensor, now.T_world_sensor)
    distance_before_m = previous.parallax_distance_m
    flow = ego_flow(now.parallax_distance_m, distance_before_m, T_before_now, view, same=SAME)
    moved_m = moved_distances(distance_before_m, torch.linalg.inv(T_before_now), view)
    stays = ego_flow(moved_m, distance_before_m, T_before_now, view, same=SAME)
    contradicted = stays.known & ~flow.known & ~now.supported
    shift = torch.where(contradicted, stays.shift, flow.shift)
    parts = [previous.probabilities, previous.count[None, None], previous.surface_share[None, None]]
    past = warp(torch.cat(parts, 1), shift[None], circular=True)
    probabilities, count, surface = past.split((now.probabilities.shape[1], 1, 1), 1)
    ids = likeliest(probabilities)[0]
    count = count[0, 0].clamp(max=MOST - 1)
    contradicted &= ~may_move(ids) & (count > DOUBT)
    count = count * (flow.known | contradicted)
    weight = count / (count + 1)
    mean = torch.lerp(now.probabilities, probabilities, weight)
    stay = contradicted & (likeliest(mean)[0] == ids)
    return now._replace(
        probabilities=mean,
        depth_m=torch.where(stay & moved_m.isfinite(), moved_m * surface[0, 0], now.depth_m),
        count=torch.where(stay, count - DOUBT, torch.where(flow.known, count + 1, 1.0)),
    )


def smoothed(now: PreviousFrame, previous: PreviousFrame, view: View) -> PreviousFrame:
    """`now` with its image averaged with those before, which are warped to where the same surfaces are now.

    Poses and distances give the warp (geometry.flow.ego_flow). A pixel is averaged unless its class has changed and one
    of both may move: what has left would leave a trail of itself. Where both panoramas agree on its distance, it fades
    and does not jump: it has the weight `FADED`. Images before count for `LEAST_IMAGES` at least, the newest for
    1 / `MOST` at least.
    view  the raster H x W of both.
    """
    T_before_now = relative_pose(previous.T_world_sensor, now.T_world_sensor)
    flow, agreeing = ego_flows(now.parallax_distance_m, previous.parallax_distance_m, T_before_now, view, (ANY, SAME))
    rows, columns = torch.meshgrid(
        torch.arange(view.rows, device=flow.shift.device),
        torch.arange(view.columns, device=flow.shift.device),
        indexing="ij",
    )
    before_row = (rows + flow.shift[1].round().long()).clamp(0, view.rows - 1)
    before_column = (columns + flow.shift[0].round().long()).remainder(view.columns)
    ids = previous.ids[before_row, before_column]
    stands = ~may_move(torch.stack([ids, now.ids])).any(0)
    unchanged = flow.known & ((ids == now.ids) | stands)
    count = previous.count[before_row, before_column].clamp(max=MOST - 1) * unchanged
    counted = count.clamp(min=LEAST_IMAGES)
    weights = torch.where(unchanged, counted / (counted + 1), FADED * agreeing.known)
    weight, shift = (interpolate(part[None], scale_factor=2.0) for part in (weights[None], 2 * flow.shift))
    past = warp(previous.image, shift, circular=True, cubic=True).clamp_(-1, 1)
    return now._replace(image=torch.lerp(now.image, past, weight), count=count + 1)


def may_move(ids: Tensor) -> Tensor:
    """Bool: which ids of COMMON15 are of classes that may move."""
    return torch.isin(ids, ids.new_tensor(THINGS))
