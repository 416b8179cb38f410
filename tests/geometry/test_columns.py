"""What columns show, against its slow definition."""

from __future__ import annotations

import torch

from lidar2pano.geometry.columns import rows_beside


def test_rows_beside_are_the_next_above_and_below():
    there = torch.rand(2, 9, 30, generator=torch.Generator().manual_seed(2)) > 0.7
    above, below = rows_beside(there)
    for image in range(2):
        for column in range(30):
            found = there[image, :, column].nonzero()[:, 0].tolist()
            for row in range(9):
                assert above[image, row, column] == max((each for each in found if each <= row), default=-1)
                assert below[image, row, column] == min((each for each in found if each >= row), default=9)
