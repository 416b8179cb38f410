"""Outlines: sharp and leafy against the sky, and nothing else changed."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.nn.functional import max_pool2d

from lidar2pano.appearance.invented_textures import (
    CROWN,
    LEAVES_M,
    SLOPE_REACH,
    _nearest,
    _pixels_inside,
    against_the_sky,
)
from lidar2pano.views import View

GROUND, SKY, TREE, WALL = (1, 2), 0, 3, 4
ROWS, COLUMNS = 16, 256
VIEW = View(rows=ROWS, columns=COLUMNS, up=0.4, down=-0.2, kind="cylinder")


def made_up() -> torch.Tensor:
    return 3 * torch.randn(2, 5, ROWS, COLUMNS, generator=torch.Generator().manual_seed(3))


def soft_edge(below: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A class below the sky: probabilities that change over all rows from one to the other; and depths."""
    sky = torch.linspace(0.95, 0.05, ROWS)[None, :, None].expand(1, ROWS, COLUMNS)
    probabilities = torch.zeros(1, 5, ROWS, COLUMNS)
    probabilities[:, SKY], probabilities[:, below] = sky, 1 - sky
    return probabilities, torch.full((1, ROWS, COLUMNS), 8.0)


def cut(below: int, pose: np.ndarray | None = None) -> torch.Tensor:
    probabilities, depth_m = soft_edge(below)
    return against_the_sky(probabilities, probabilities, depth_m, VIEW, pose, SKY, TREE)


def test_a_roof_ends_on_one_row():
    found, before = cut(WALL), soft_edge(WALL)[0]
    assert torch.equal(found.argmax(1), before.argmax(1)), "where it was likelier before"
    grey = (found[:, SKY] > 0.1) & (found[:, SKY] < 0.9)
    assert grey.float().mean() < 0.2 < ((before[:, SKY] > 0.1) & (before[:, SKY] < 0.9)).float().mean()
    assert torch.allclose(found.sum(1), torch.ones(1, ROWS, COLUMNS), atol=1e-5)


def test_a_crown_has_leaves_that_hang_on_the_world():
    tree = (cut(TREE)[0].argmax(0) == TREE).sum(0).float()
    assert tree.std() > 0.3 and (cut(WALL)[0].argmax(0) == WALL).sum(0).float().std() == 0
    assert abs(tree.mean() - ROWS / 2) < 1, "as high as before, on average"
    angle = 2 * math.pi * 32 / COLUMNS
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    turned = cut(TREE, pose).roll(-32, 3)
    assert (turned - cut(TREE)).abs().median() < 1e-4, "the sensor turned left: all moves right, and so do the leaves"


@pytest.mark.parametrize("depth_m", [10.0, 40.0])
def test_leaves_are_as_far_from_the_crown_as_they_are_in_metres(depth_m):
    rows = 120  # so that the sky's probability hardly changes from row to row
    view = View(rows=rows, columns=COLUMNS, up=1.5, down=-1.5, kind="cylinder")
    sky = torch.linspace(0.6, 0.4, rows)[None, :, None].expand(1, rows, COLUMNS)
    probabilities = torch.zeros(1, 5, rows, COLUMNS)
    probabilities[:, SKY], probabilities[:, TREE] = sky, 1 - sky
    depths = torch.full((1, rows, COLUMNS), depth_m)
    found = against_the_sky(probabilities, probabilities, depths, view, None, SKY, TREE)[0].argmax(0)
    reach = 2 * sum(LEAVES_M.values()) * view.focal_px / depth_m + 2
    row = torch.arange(rows)
    assert (found[row < rows / 2 - reach] == SKY).all() and (found[row > rows / 2 + reach] == TREE).all()
    if depth_m < 20:
        assert (found[rows // 2 - 1 : rows // 2 + 1] == TREE).float().std() > 0.3, "a crown's outline is no line"


def test_nearby_leaves_open_no_hole_where_a_sky_is_unlikely():
    sky = 0.02 + 0.17 * (torch.arange(COLUMNS) % 16 - 8).abs() / 8
    probabilities = torch.zeros(1, 5, ROWS, COLUMNS)
    probabilities[:, SKY], probabilities[:, TREE] = sky, 1 - sky
    found = against_the_sky(probabilities, probabilities, torch.full((1, ROWS, COLUMNS), 2.0), VIEW, None, SKY, TREE)
    assert (found.argmax(1) == TREE).all(), "a metre is twenty pixels there"


def test_how_far_inside_a_pixel_is():
    row, column = torch.arange(20.0)[:, None], torch.arange(30.0)
    plane = (0.03 * (column - 15) + 0.04 * (row - 8))[None]
    inner = (slice(None), slice(SLOPE_REACH, -SLOPE_REACH), slice(SLOPE_REACH, -SLOPE_REACH))
    assert torch.allclose(_pixels_inside(plane)[inner], plane[inner] / 0.05, atol=1e-4)
    assert _pixels_inside(torch.full((1, 9, 9), 0.4)).min() >= 40, "where nothing changes, no outline is near"


def test_what_stands_below_the_sky_keeps_its_shares():
    probabilities = made_up().softmax(1)
    segments = probabilities.square() / probabilities.square().sum(1, keepdim=True)
    depth_m = torch.full((2, ROWS, COLUMNS), 8.0)
    found = against_the_sky(segments, probabilities, depth_m, VIEW, None, SKY, TREE)
    expected = segments[:, 1:] / segments[:, 1:].sum(1, keepdim=True)
    some = found[:, SKY] < 0.99
    share = found[:, 1:] / found[:, 1:].sum(1, keepdim=True)
    assert some.any() and torch.allclose((share - expected).movedim(1, 3)[some], torch.tensor(0.0), atol=1e-3)


def test_the_nearest_thing_around_is_found():
    depth_m = torch.rand(2, 20, 40, generator=torch.Generator().manual_seed(1))
    closed = torch.cat([depth_m[..., -8:], depth_m, depth_m[..., :8]], -1)
    expected = -max_pool2d(-closed, CROWN, 1, (CROWN // 2, 0))
    assert torch.equal(_nearest(depth_m), expected)
