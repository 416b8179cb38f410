"""Belief comes from measurement and networks alone: nothing that is drawn for the painter is in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

import car_street
from car_street import CAR, FAR_M
from lidar2pano.geometry.projection import directions
from lidar2pano.geometry.rasters import upsample_azimuth
from lidar2pano.labels import COMMON15
from lidar2pano.pipeline import Pipeline, load
from lidar2pano.scan import Scan
from lidar2pano.scene.surfaces import slopes
from lidar2pano.views import VIEWS

VIEW = replace(VIEWS["panorama"].scaled(0.375), origin=(0.0, 0.0, 0.0))
PLACE = (-6.0, 5.0, 0.3)  # of a car, and its heading
LIKELY = 0.85  # probability of the class of each pixel
IDS = torch.tensor([COMMON15.id_of(name) for name in ("road", "car", "building")])


class Told(nn.Module):
    """A translator that answers with a scene."""

    def __init__(self, probabilities: torch.Tensor, depth_m: torch.Tensor) -> None:
        super().__init__()
        self.answer = probabilities.log(), depth_m

    def forward(self, channels, condition):
        return self.answer


@pytest.fixture(scope="module")
def scene() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, Scan]:
    """Ids and depths (H, W) of a street with a car, pixels of its windows, and a scan that shows the wall there."""
    ids, radius_m = car_street.street(PLACE, view=VIEW)
    rows = (ids == CAR).any(1).nonzero()[:, 0]
    top, bottom = int(rows.min()), int(rows.max())
    windows = ids == CAR
    windows[: top + 6], windows[(2 * top + bottom) // 3 :], windows[:, ::2] = False, False, False
    along_ray = torch.sqrt(1 + slopes(VIEW)[:, None].square())
    range_m = torch.where(windows, torch.tensor(FAR_M), radius_m) * along_ray
    xyz = (directions(VIEW) * range_m[..., None]).reshape(-1, 3).numpy()
    return ids, radius_m * along_ray, windows, Scan(xyz=xyz, remission=np.full(len(xyz), 0.3, np.float32), name="car")


@pytest.fixture(scope="module")
def pipeline(random_weights, scene) -> Pipeline:
    ids, depth_m, _, _ = scene
    probabilities = torch.full((1, len(COMMON15), VIEW.rows, VIEW.columns), (1 - LIKELY) / (len(COMMON15) - 1))
    probabilities.scatter_(1, IDS[ids][None, None], LIKELY)
    return replace(load(random_weights, "cpu", "torch"), view=VIEW, translator=Told(probabilities, depth_m[None]))


@pytest.mark.parametrize("poses", [None, [np.eye(4)] * 2])
def test_a_car_has_the_confidence_of_the_network(pipeline, scene, poses):
    *_, panorama = pipeline.stream([scene[3]] * 2, poses)
    expected = upsample_azimuth(pipeline.translator.answer[0].softmax(1).amax(1, keepdim=True), 2)[0, 0]
    assert np.allclose(panorama.confidence, expected.numpy(), atol=1e-4)
    assert np.array_equal(np.unique(panorama.segments), np.sort(IDS.numpy()))


def test_a_distance_through_a_window_stays_as_measured(pipeline, scene):
    _, _, windows, scan = scene
    panorama = pipeline(scan)
    fine = windows.repeat_interleave(2, 0).repeat_interleave(2, 1).numpy() & panorama.measured
    assert fine.sum() > 100 and (panorama.depth_m[fine] > FAR_M).all()
    points = panorama.colour_points(scan)
    assert points.valid[windows.flatten().numpy()].all(), "and nothing invented hides the point"
