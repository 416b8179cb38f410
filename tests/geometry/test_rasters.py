"""Fast operations on rasters against torch's own, and against their slow definitions."""

from __future__ import annotations

from itertools import product

import pytest
import torch
from torch.nn.functional import max_pool2d

from lidar2pano.geometry.rasters import (
    adjacent_rows,
    as_float,
    enlarged_planes,
    indices_of,
    largest_around,
    likeliest,
    nearest_row,
    select,
    upsample_azimuth,
)


def test_selection_is_where():
    first, second = (
        torch.randn(2, 3, 50, generator=torch.Generator().manual_seed(5)) * torch.tensor([[[1e-6, 1.0, 1e6]]]).mT
    )
    mask = first > second
    assert torch.equal(select(mask, first, second), torch.where(mask, first, second))
    assert torch.equal(select(mask, first[:, :1], second), torch.where(mask, first[:, :1], second))
    assert torch.equal(as_float(mask), mask.float()) and torch.equal(as_float(mask.T), mask.T.float())


def test_the_likeliest_class_is_the_first_of_the_highest():
    scores = torch.randint(0, 6, (2, 7, 13, 40), generator=torch.Generator().manual_seed(3)).float()  # many are equal
    for variant in (scores, scores.bfloat16(), scores.contiguous(memory_format=torch.channels_last)):
        ids = likeliest(variant)
        assert ids.dtype == torch.uint8 and torch.equal(ids.long(), scores.argmax(1))


def test_adjacent_rows_are_the_next_above_and_below():
    mask = torch.rand(2, 9, 30, generator=torch.Generator().manual_seed(2)) > 0.7
    above, below = adjacent_rows(mask)
    for image in range(2):
        for column in range(30):
            rows = mask[image, :, column].nonzero()[:, 0].tolist()
            for row in range(9):
                assert above[image, row, column] == max((number for number in rows if number <= row), default=-1)
                assert below[image, row, column] == min((number for number in rows if number >= row), default=9)


@pytest.mark.parametrize("factor", [1, 2, 4, 16])
def test_planes_are_enlarged_as_images_are(factor):
    planes = torch.randn(3, 6, 10, generator=torch.Generator().manual_seed(4))
    torch.testing.assert_close(enlarged_planes(planes, factor), upsample_azimuth(planes[None], factor)[0])


@pytest.mark.parametrize("size", [(7, 12), (1, 5), (5, 1)])
def test_the_largest_around_a_pixel_is_max_pooling(size):
    image = torch.randn(size, generator=torch.Generator().manual_seed(6))
    assert torch.equal(largest_around(image), max_pool2d(image[None], 3, 1, 1)[0])


def test_indices_are_those_of_a_mask():
    mask = torch.rand(50, generator=torch.Generator().manual_seed(7)) > 0.5
    assert torch.equal(indices_of(mask), mask.nonzero()[:, 0])


def test_the_nearest_pixel_of_a_column_is_found():
    mask = torch.rand(2, 13, 9, generator=torch.Generator().manual_seed(0)) < 0.2
    mask[0, :, 4] = False
    found = nearest_row(mask)
    for sample, row, column in product(range(2), range(13), range(9)):
        rows = mask[sample, :, column].nonzero()[:, 0].tolist()
        wanted = min(rows, key=lambda r: (abs(r - row), -r), default=12)  # of equal ones the lower
        assert found[sample, row, column] == wanted
