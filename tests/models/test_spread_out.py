"""What the painter reads of a scan: remission spread over the gaps between beams."""

import pytest
import torch

from lidar2pano.models.scene_painter import WINDOWS, spread_out


def slowly(values, valid):
    """The definition: means over the first window around each pixel that holds anything."""
    rows, columns = values.shape
    mean, found = torch.zeros_like(values), torch.zeros_like(values)
    for row in range(rows):
        for column in range(columns):
            for high, wide in WINDOWS:
                inside = [
                    (r, c % columns)
                    for r in range(max(row - high // 2, 0), min(row + high // 2, rows - 1) + 1)
                    for c in range(column - wide // 2, column + wide // 2 + 1)
                    if valid[r, c % columns]
                ]
                if inside:
                    mean[row, column] = sum(values[at] for at in inside) / len(inside)
                    found[row, column] = 1
                    break
    return mean, found


@pytest.mark.parametrize("share", [0.02, 0.3])
def test_remission_is_spread_as_defined(share):
    generator = torch.Generator().manual_seed(3)
    values = torch.rand(2, 30, 24, generator=generator)
    valid = (torch.rand(2, 30, 24, generator=generator) < share).float()
    valid[:, :10] = 0  # above the beams
    mean, found = spread_out(values, valid)
    for number in range(2):
        slow_mean, slow_found = slowly(values[number], valid[number])
        assert torch.equal(found[number], slow_found)
        assert torch.allclose(mean[number], slow_mean, atol=1e-6)
    assert not found[:, :4].any() and found[:, 20:].any()
