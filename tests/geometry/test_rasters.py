"""Fast operations on rasters against torch's own, and against their slow definitions."""

from __future__ import annotations

import torch

from lidar2pano.geometry.rasters import adjacent_rows, as_float, likeliest, select


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
