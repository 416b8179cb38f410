"""Streaks: as defined pixel by pixel, blind to texture and to what an image has nearby; their gradient removes them."""

from __future__ import annotations

import pytest
import torch

from lidar2pano.losses import inside, streaks
from lidar2pano.losses.painting import EVEN, LENGTH_PX, NEARBY_PX, STEP_PX


def with_line(row: int, brightness: float = 0.6) -> torch.Tensor:
    """(1, 3, 40, 60): grey, with a line of four rows."""
    image = torch.zeros(1, 3, 40, 60)
    image[:, :, row : row + 4, 10:50] = brightness
    return image


def by_hand(painted: torch.Tensor, image: torch.Tensor, where: torch.Tensor) -> float:
    def change(x: torch.Tensor, row: int, column: int) -> float:
        reach = slice(max(column - LENGTH_PX // 2, 0), column + LENGTH_PX // 2 + 1)
        return abs(float(x[:, row, reach].mean() - x[:, row - STEP_PX, reach].mean()))

    total, rows, columns, half = 0.0, where.shape[0], where.shape[1], NEARBY_PX // 2
    for row in range(STEP_PX, rows):
        for column in range(columns):
            nearby = max(
                change(image, other, beside)
                for other in range(max(row - half, STEP_PX), min(row + half + 1, rows))
                for beside in range(max(column - half, 0), min(column + half + 1, columns))
            )
            total += float(where[row, column]) * max(change(painted, row, column) - nearby - EVEN, 0)
    return total / max(float(where[STEP_PX:].sum()), 1)


def test_streaks_are_as_defined():
    painted, image = torch.rand(2, 1, 3, 14, 22, generator=torch.Generator().manual_seed(1)).mul(2).sub(1).double()
    image *= 0.2
    where = torch.rand(1, 14, 22, generator=torch.Generator().manual_seed(2)).double()
    expected = by_hand(painted[0], image[0], where[0])
    assert expected > 0.01 and streaks(painted, image, where).item() == pytest.approx(expected, rel=1e-6)


def test_a_line_is_a_streak_only_where_it_counts_and_the_image_has_none_nearby():
    everywhere, line = torch.ones(1, 40, 60), with_line(18)
    assert streaks(line, torch.zeros_like(line), everywhere) > 0.02
    assert streaks(line, with_line(18 + NEARBY_PX // 2), everywhere) == 0
    assert streaks(line, with_line(4), everywhere) > 0.02
    below = everywhere.clone()
    below[:, :28] = 0
    assert streaks(line, torch.zeros_like(line), below) == 0
    assert streaks(line, torch.zeros_like(line), 0 * below) == 0


def test_texture_is_no_streak():
    noise = 0.08 * (2 * torch.rand(1, 3, 80, 80, generator=torch.Generator().manual_seed(0)) - 1)
    assert streaks(noise, torch.zeros_like(noise), torch.ones(1, 80, 80)) < 1e-4
    along = with_line(18).transpose(2, 3)
    assert streaks(along[:, :, 14:46], torch.zeros(1, 3, 32, 40), torch.ones(1, 32, 40)) == 0, "a line down the road"


def test_following_the_gradient_removes_a_streak():
    painted = with_line(18).requires_grad_()
    optimizer = torch.optim.Adam([painted], 0.01)
    for _ in range(100):
        optimizer.zero_grad()
        streaks(painted, torch.zeros(1, 3, 40, 60), torch.ones(1, 40, 60)).backward()
        optimizer.step()
    assert streaks(painted, torch.zeros(1, 3, 40, 60), torch.ones(1, 40, 60)) < 2e-3


def test_what_is_inside_is_far_from_other_pixels():
    share = torch.zeros(1, 12, 20)
    share[:, 3:, 4:16] = 0.6
    expected = torch.zeros(1, 12, 20)
    expected[:, 5:, 6:14] = 1  # at the foot of the picture it goes on
    assert torch.equal(inside(share, 2), expected)
