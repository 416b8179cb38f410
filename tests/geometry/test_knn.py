from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from golden_vectors import recorded
from lidar2pano.geometry.projection import RangeImage, project
from lidar2pano.pipeline.segmenter import clean_up, inverse_gaussian, vote
from lidar2pano.scan import Scan
from lidar2pano.views import VIEWS, View
from published_projection import published_projection, synthetic_scan
from slow_definitions import vote_slowly

AROUND = View(rows=16, columns=96, up=5, down=-25)
FRONT = View(rows=16, columns=64, up=5, down=-25, left=45, right=-45)


def scan_of(*points: tuple[float, float, float]) -> Scan:
    xyz = np.array(points, dtype=np.float32).reshape(-1, 3)
    return Scan(xyz=xyz, remission=np.zeros(len(xyz), np.float32))


def polar(azimuth: float, range_m: float = 10.0, elevation: float = 0.0) -> tuple[float, float, float]:
    a, e = math.radians(azimuth), math.radians(elevation)
    return (range_m * math.cos(a) * math.cos(e), range_m * math.sin(a) * math.cos(e), range_m * math.sin(e))


def crowded_scan(points: int = 2000) -> Scan:
    """Steps of one metre and less in range, several points a pixel, some unusable, some out of view."""
    generator = np.random.default_rng(1)
    azimuth, elevation = np.radians(generator.uniform([[-180], [-27]], [[180], [7]], (2, points)))
    range_m = 5 + 0.25 * generator.integers(0, 12, points) + generator.normal(0, 0.05, points)
    ray = np.stack([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], 1)
    xyz = (ray * range_m[:, None]).astype(np.float32)
    xyz[::97] = np.nan
    return Scan(xyz=xyz, remission=np.zeros(points, np.float32))


def class_map(view: View, classes: int = 6) -> Tensor:
    return torch.from_numpy(np.random.default_rng(2).integers(0, classes, (view.rows, view.columns)))


def slowly(image: RangeImage, ids: Tensor) -> list[int]:
    view = image.view
    ranges = torch.where(image.valid, image.channels[0], torch.inf).numpy()
    found = []
    for number in range(len(image.row)):
        row = min(max(int(image.row[number]), 0), view.rows - 1)
        column = min(max(int(image.column[number]), 0), view.columns - 1)
        own = bool(image.inside[number])
        answer = vote_slowly(
            ranges, ids.numpy(), (row, column), float(image.range_m[number]), own=own, circular=view.circular
        )
        found.append(answer if image.usable[number] else 0)
    return found


@pytest.mark.parametrize("view", [AROUND, FRONT])
def test_clean_up_agrees_with_its_definition(view):
    image, ids = project(crowded_scan(), view), class_map(view)
    ours = clean_up(image, ids)
    assert ours.dtype == torch.int64 and ours.shape == (2000,)
    assert ours.tolist() == slowly(image, ids)
    assert len(ours[image.inside].unique()) == 6


@pytest.fixture(scope="module")
def class_image(golden: Path) -> Tensor:
    """The class per pixel, (64, 2048) uint8, of the recorded clean-up."""
    return recorded(golden, "knn_synth")["argmax_blocks_16x128"].values.repeat_interleave(4, 0).repeat_interleave(16, 1)


@pytest.mark.parity
def test_vote_is_the_published_one(golden: Path, class_image: Tensor) -> None:
    """Given the published projection: equal but where it has no voter and answers 1, we unlabeled."""
    published, scan = recorded(golden, "knn_synth")["labels"].values.numpy(), synthetic_scan()
    projected = published_projection(scan, up=3.0, down=-25.0, half_width=180.0)
    ranges = torch.from_numpy(projected.proj_range)
    ours = vote(
        ranges.where(ranges >= 0, torch.inf),
        class_image,
        (torch.from_numpy(projected.proj_y).long(), torch.from_numpy(projected.proj_x).long()),
        torch.from_numpy(scan.xyz).norm(dim=1),
        own=torch.ones(len(scan), dtype=torch.bool),
        circular=False,
    ).numpy()
    differs = ours != published
    assert set(ours[differs]) == {0} and set(published[differs]) == {1} and differs.sum() == 4972


@pytest.mark.parity
def test_clean_up_of_our_projection_is_the_published_one(golden: Path, class_image: Tensor) -> None:
    """The whole way: also the points out of view (published: clamped) and the azimuth border (zero padding) differ."""
    published = recorded(golden, "knn_synth")["labels"].values.numpy()
    image = project(synthetic_scan(), VIEWS["hdl64e"])
    ours = clean_up(image, class_image)
    inner = (image.row >= 3) & (image.row < 61) & (image.column >= 3) & (image.column < 2045)
    differs = (ours.numpy() != published) & (ours.numpy() != 0) & inner.numpy()
    assert inner.sum() > 95_000 and differs.sum() <= 2


@pytest.mark.parity
def test_inverse_gaussian_is_the_published_one(golden: Path) -> None:
    recorded(golden, "knn_inv_gauss")["inv_gauss"].assert_close(inverse_gaussian(), 1e-7)


def test_a_hidden_point_takes_the_class_of_its_own_surface():
    """A far point behind a near one in its pixel: its neighbours at its own range outvote the pixel."""
    step = 360 / AROUND.columns
    wall = [polar(step * (i + 0.5), 20.0) for i in (-2, -1, 1, 2)]
    scan = scan_of(polar(step / 2, 5.0), polar(step / 2, 20.0), *wall)
    image = project(scan, AROUND)
    ids = image.spread(torch.tensor([1, 2, 2, 2, 2, 2]))
    assert clean_up(image, ids).tolist() == [1, 2, 2, 2, 2, 2]


def test_the_window_wraps_around_a_circular_view():
    step = 360 / AROUND.columns
    scan = scan_of(polar(180 - step / 2), polar(-180 + step / 2), polar(-180 + 1.5 * step), polar(0))
    image = project(scan, AROUND)
    assert image.column.tolist() == [0, 95, 94, 48]
    assert clean_up(image, image.spread(torch.tensor([1, 3, 3, 5]))).tolist() == [3, 3, 3, 5]
    front = project(scan, View(rows=16, columns=96, up=5, down=-25, left=180, right=-179.999))
    assert clean_up(front, front.spread(torch.tensor([1, 3, 3, 5]))).tolist() == [1, 3, 3, 5]


def test_points_out_of_view_ask_the_border_next_to_them():
    scan = scan_of(polar(44.9), polar(-44.9), polar(46), polar(-46), polar(100), polar(46, 30.0))
    image = project(scan, FRONT)
    ids = image.spread(torch.tensor([3, 4, 0, 0, 0, 0]))
    assert clean_up(image, ids).tolist() == [3, 4, 3, 4, 3, 0], "the last is too far from anything that was seen"


def test_points_above_and_below_ask_their_border():
    scan = scan_of(polar(0, elevation=4.9), polar(0, elevation=8), polar(90, elevation=-24.9), polar(90, elevation=-40))
    image = project(scan, AROUND)
    assert clean_up(image, image.spread(torch.tensor([2, 0, 5, 0]))).tolist() == [2, 2, 5, 5]


def test_unusable_points_and_lone_unlabeled_ones_are_unlabeled():
    image = project(scan_of((0, 0, 0), (math.nan, 0, 0), polar(0, range_m=0.5), polar(90)), AROUND)
    assert clean_up(image, image.spread(torch.tensor([7, 7, 7, 0]))).tolist() == [0, 0, 7, 0]


@pytest.mark.parametrize(("farthest", "winner"), [(2, 5), (3, 2)])
def test_five_neighbours_vote(farthest, winner):
    """Around a point of class 2: one more 2 at 1 cm, then 5s at 2 cm, the last of them perhaps out of the window."""
    step = 360 / AROUND.columns
    ranges = {0: 10.0, 1: 10.01, -1: 10.02, 2: 10.02, -farthest: 10.02}
    scan = scan_of(*(polar(step * (i + 0.5), r) for i, r in ranges.items()))
    image = project(scan, AROUND)
    ids = image.spread(torch.tensor([2, 2, 5, 5, 5]))
    assert clean_up(image, ids)[0] == winner


def test_of_equal_votes_the_lowest_id_wins():
    step = 360 / AROUND.columns
    image = project(scan_of(polar(step / 2), polar(1.5 * step)), AROUND)
    assert clean_up(image, image.spread(torch.tensor([6, 4]))).tolist() == [4, 4]


@pytest.mark.parametrize("label", [1, 127, 128, 255])
def test_every_id_up_to_255_survives(label):
    image = project(scan_of(polar(0), polar(1)), AROUND)
    assert clean_up(image, torch.full((16, 96), label)).tolist() == [label, label]


def test_cut_off():
    step = 360 / AROUND.columns
    image = project(scan_of(polar(step / 2, 10), polar(1.5 * step, 11.2)), AROUND)
    ids = image.spread(torch.tensor([0, 3]))
    assert clean_up(image, ids).tolist() == [0, 3]


def test_an_empty_scan_has_no_labels():
    assert clean_up(project(scan_of(), AROUND), class_map(AROUND)).shape == (0,)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_agrees_with_the_cpu():
    ids = class_map(AROUND)
    here, there = (
        clean_up(project(crowded_scan(), AROUND, device=device), ids.to(device)) for device in ("cpu", "cuda")
    )
    assert torch.equal(here, there.cpu())
