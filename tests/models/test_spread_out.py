"""What the painter reads of a scan: remission spread over the gaps between beams."""

import pytest
import torch

from lidar2pano.models.scene_painter import MIXED_PX, MOST_UNEVEN, WINDOWS, evened_beams, spread_out


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


def evened_slowly(remission, valid, road, reach):
    """The definition, pixel by pixel, of one image."""
    weight = valid * road
    mean = (remission * weight).sum() / weight.sum()
    found, columns = remission.clone(), remission.shape[1]
    for row in range(len(remission)):
        for column in range(columns):
            around = [(column + shift) % columns for shift in range(-reach, reach + 1)]
            own = (remission[row, around] * weight[row, around]).sum() + MIXED_PX * mean
            own = own / (weight[row, around].sum() + MIXED_PX)
            found[row, column] *= (mean / own).clamp(1 / MOST_UNEVEN, MOST_UNEVEN)
    return found


def test_beams_are_evened_as_defined():
    generator = torch.Generator().manual_seed(3)
    remission, road = torch.rand(2, 2, 30, 24, generator=generator).unbind(0)
    valid = (torch.rand(2, 30, 24, generator=generator) < 0.5).float()
    remission[:, 10:14] *= 6
    for number, found in enumerate(evened_beams(remission, valid, road, 4)):
        assert torch.allclose(found, evened_slowly(remission[number], valid[number], road[number], 4), atol=1e-5)
    whole = evened_beams(remission, valid, road, 11)
    assert torch.equal(evened_beams(remission, valid, road, 99), whole), "never farther than once around"


def test_a_beam_that_measures_more_leaves_no_line_and_lane_marks_stay():
    even = torch.full((1, 40, 400), 0.2)
    even[:, :, 190:200] = 0.6
    gain = torch.where(torch.arange(40) < 20, 1.0, 2.0)[:, None]
    found = evened_beams(even * gain, torch.ones(1, 40, 400), torch.ones(1, 40, 400), 60)
    assert (found[:, :20].mean() / found[:, 20:].mean()).log().abs() < 0.1
    assert 2.5 < found[0, 0, 195] / found[0, 0, 0] < 3, "a mark, ten columns wide, keeps most of its contrast"


def test_a_beam_that_passes_from_row_to_row_leaves_no_line():
    gain = torch.ones(1, 40, 600)
    gain[0, 20, :300], gain[0, 21, 300:] = 0.4, 0.4
    found = evened_beams(0.3 * gain, torch.ones(1, 40, 600), torch.ones(1, 40, 600), 40)
    away = torch.cat([found[..., 50:250], found[..., 350:550]], 2)
    assert away.max() / away.min() < 1.3, "of 2.5"


def test_without_a_road_or_remission_nothing_changes():
    remission, nothing = torch.rand(1, 10, 20, generator=torch.Generator().manual_seed(1)), torch.zeros(1, 10, 20)
    assert torch.allclose(evened_beams(remission, nothing + 1, nothing, 5), remission, atol=1e-5)
    assert torch.equal(evened_beams(nothing, nothing + 1, nothing + 1, 5), nothing)
