"""What the painter reads of a scan: remission evened, spread over the gaps between beams, and quiet on the road."""

import pytest
import torch

from lidar2pano.appearance.painter_inputs import (
    DIM,
    MARK,
    MIXED_PX,
    MOST_UNEVEN,
    NEARER,
    NOISE,
    WINDOWS,
    equalised_beams,
    quiet_road,
    spread_out,
)


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
    found, used, columns = remission.clone(), valid.clone(), remission.shape[1]
    for row in range(len(remission)):
        for column in range(columns):
            own = []
            for wide, mixed in ((reach, MIXED_PX), (reach // NEARER, MIXED_PX // NEARER)):
                around = [(column + shift) % columns for shift in range(-wide, wide + 1)]
                total = (remission[row, around] * weight[row, around]).sum() + mixed * mean
                own.append(total / (weight[row, around].sum() + mixed))
            found[row, column] *= (mean / own[0]).clamp(1 / MOST_UNEVEN, MOST_UNEVEN)
            if min(own) < DIM * mean and road[row, column] > 0.5:
                used[row, column] = 0
    return found, used


def everywhere(*size):
    return torch.ones(1, *size)


def test_beams_are_evened_as_defined():
    generator = torch.Generator().manual_seed(3)
    remission, road = torch.rand(2, 2, 30, 64, generator=generator).unbind(0)
    valid = (torch.rand(2, 30, 64, generator=generator) < 0.5).float()
    road[:, 18:] = 0.6 + 0.4 * road[:, 18:]
    remission[:, 10:14] *= 6
    remission[:, 20:22] = 0
    answers = equalised_beams(remission, valid, road, 24)
    for number, (found, used) in enumerate(zip(*answers, strict=True)):
        expected, expected_used = evened_slowly(remission[number], valid[number], road[number], 24)
        assert torch.allclose(found, expected, atol=1e-5)
        assert torch.equal(used, expected_used) and (used < valid[number]).any()
    whole = equalised_beams(remission, valid, road, 31)
    assert torch.equal(equalised_beams(remission, valid, road, 99)[0], whole[0]), "never farther than once around"


def test_a_beam_that_measures_more_leaves_no_line_and_lane_marks_stay():
    even = torch.full((1, 40, 400), 0.2)
    even[:, :, 190:200] = 0.6
    gain = torch.where(torch.arange(40) < 20, 1.0, 2.0)[:, None]
    found, used = equalised_beams(even * gain, everywhere(40, 400), everywhere(40, 400), 60)
    assert used.all()
    assert (found[:, :20].mean() / found[:, 20:].mean()).log().abs() < 0.1
    assert 2.5 < found[0, 0, 195] / found[0, 0, 0] < 3, "a mark, ten columns wide, keeps most of its contrast"


@pytest.mark.parametrize("gain", [0.3, 0.7])
def test_a_beam_that_passes_from_row_to_row_leaves_no_line(gain):
    gains = torch.ones(1, 40, 600)
    gains[0, 20, :300], gains[0, 21, 300:] = gain, gain
    found, used = equalised_beams(0.3 * gains, everywhere(40, 600), everywhere(40, 600), 40)
    away = torch.cat(
        [torch.where(used > 0, found, torch.nan)[..., part] for part in (slice(50, 250), slice(350, 550))], 2
    )
    kept = away[away.isfinite()]
    assert kept.max() / kept.min() < 1.15
    assert (used == 0).any() == (gain < DIM)


def test_what_is_no_road_keeps_the_remission_of_dim_beams():
    gains = torch.ones(1, 40, 400)
    gains[0, 20] = 0.2
    road = everywhere(40, 400)
    road[..., :100] = 0
    _, used = equalised_beams(0.3 * gains, everywhere(40, 400), road, 60)
    assert used[..., :100].all() and not used[0, 20, 100:].any()


def test_without_a_road_or_remission_nothing_changes():
    remission, nothing = torch.rand(1, 10, 20, generator=torch.Generator().manual_seed(1)), torch.zeros(1, 10, 20)
    found, used = equalised_beams(remission, nothing + 1, nothing, 5)
    assert torch.allclose(found, remission, atol=1e-5) and used.all()
    found, used = equalised_beams(nothing, nothing + 1, nothing + 1, 5)
    assert torch.equal(found, nothing) and used.all()


def quiet_slowly(remission, valid, road):
    """The definition, pixel by pixel, of one image."""
    pixels = [(row, column) for row in range(len(remission)) for column in range(remission.shape[1])]
    weights = [float(valid[at] * road[at]) for at in pixels]
    mean = sum(w * float(remission[at]) for w, at in zip(weights, pixels, strict=True)) / sum(weights)
    deviation = sum(w * abs(float(remission[at]) - mean) for w, at in zip(weights, pixels, strict=True)) / sum(weights)
    found = remission.clone()
    for w, at in zip(weights, pixels, strict=True):
        away = abs(float(remission[at]) - mean) / deviation
        share = 0.0 if away < NOISE else 1.0 if away > MARK else (away - NOISE) / (MARK - NOISE)
        quiet = mean + share * (float(remission[at]) - mean)
        found[at] = w * quiet + (1 - w) * float(remission[at])
    return found


def test_the_road_is_quiet_as_defined():
    generator = torch.Generator().manual_seed(4)
    remission = 0.3 + 0.05 * torch.randn(2, 20, 30, generator=generator)
    remission[:, 5:7, 10:14] += 0.4
    valid = (torch.rand(2, 20, 30, generator=generator) < 0.8).float()
    road = torch.rand(2, 20, 30, generator=generator)
    road[:, 12:] = 0
    found = quiet_road(remission, valid, road)
    for number in range(2):
        assert torch.allclose(found[number], quiet_slowly(remission[number], valid[number], road[number]), atol=1e-5)
    assert torch.equal(found[:, 12:], remission[:, 12:]), "what is no road keeps its remission"


def test_noise_of_a_road_goes_and_its_marks_stay():
    remission = 0.3 + 0.03 * torch.randn(1, 60, 400, generator=torch.Generator().manual_seed(5))
    remission[:, 20:40, 100:104] = 0.6
    found = quiet_road(remission, everywhere(60, 400), everywhere(60, 400))
    assert (found[:, 20:40, 100:104] > 0.59).all()
    others = found[..., 200:]
    assert others.std() < 0.6 * remission[..., 200:].std()
    assert (others == others.median()).float().mean() > 0.8, "most of it is the mean"


def test_where_no_road_was_measured_nothing_is_quiet():
    remission = torch.rand(1, 10, 20, generator=torch.Generator().manual_seed(1))
    for nowhere in ((everywhere(10, 20), 0 * everywhere(10, 20)), (0 * everywhere(10, 20), everywhere(10, 20))):
        assert torch.equal(quiet_road(remission, *nowhere), remission)
