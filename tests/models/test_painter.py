"""What the painter reads of a scan: remission spread over the gaps between beams."""

import pytest
import torch

from lidar2pano.models.painter import Painter
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


def test_an_inpainting_painter_does_not_see_which_beam_hit():
    """Of an even surface it sees the same, whether every row or every third was measured."""
    segments = torch.randn(1, 16, 24, 32).softmax(1)
    depth_m = torch.full((1, 24, 32), 10.0)
    every = torch.zeros(1, 5, 24, 32)
    every[:, 0], every[:, 4] = 10.0, 0.4
    third = every * (torch.arange(24) % 3 == 1)[:, None]
    for inpainted, apart in ((True, False), (False, True)):
        painter = Painter(filled=inpainted).eval()
        with torch.inference_mode():
            painted = [painter(segments, depth_m, image) for image in (every, third)]
        assert (not torch.allclose(*painted, atol=1e-5)) == apart


def test_a_sharpening_painter_sees_what_is_likeliest():
    torch.manual_seed(0)
    painter, sharpening = Painter().eval(), Painter(sharp=4.0).eval()
    sharpening.load_state_dict(painter.state_dict())
    segments = torch.randn(1, 16, 8, 16).softmax(1)
    rest = torch.full((1, 8, 16), 10.0), torch.zeros(1, 5, 8, 16)
    raised = segments**4 / (segments**4).sum(1, keepdim=True)
    with torch.inference_mode():
        assert torch.allclose(sharpening(segments, *rest), painter(raised, *rest), atol=1e-6)
        assert not torch.allclose(sharpening(segments, *rest), painter(segments, *rest), atol=1e-3)


def even(count: int = 1) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Segments, depth and image of a place that looks the same in every direction, without a point."""
    segments = torch.linspace(0, 1, 16).softmax(0)[None, :, None, None].expand(count, 16, 24, 32)
    return segments, torch.full((count, 24, 32), 10.0), torch.zeros(count, 5, 24, 32)


def test_noise_makes_a_texture_of_what_is_even():
    torch.manual_seed(0)
    plain, grained = Painter().eval(), Painter(grain=True).eval()
    with torch.inference_mode():
        same_place = slice(None, None, 8)  # of the squares that pixels are shuffled in
        assert plain(*even())[..., same_place].std(3).max() < 1e-5
        assert grained(*even())[..., same_place].std(3).min() > 1e-3


def test_noise_stands_still_but_in_training():
    painter = Painter(grain=True)
    with torch.inference_mode():
        first, second = (painter(*even()) for _ in range(2))
        assert not torch.allclose(first, second, atol=1e-3)
        painter.eval()
        first, second = (painter(*even()) for _ in range(2))
        assert torch.equal(first, second)
        both = painter(*even(2))
    assert torch.allclose(both, first.expand_as(both), atol=1e-6), "the same in every picture of a batch"


@pytest.mark.parametrize("pixels", [2, 4])
def test_noise_is_as_strong_at_every_scale(pixels):
    painter = Painter(grain=True).eval()
    segments, depth_m, image = (part.repeat(1, *[1] * (part.ndim - 3), 8, 8) for part in even())
    inputs = painter._inputs(segments, depth_m, image)
    coarser = painter._coarser(inputs, pixels)
    assert inputs[:, -1].std() == pytest.approx(1, abs=0.02) and coarser[:, -1].std() == pytest.approx(1, abs=0.05)
    assert torch.allclose(coarser[:, :-1], torch.nn.functional.avg_pool2d(inputs[:, :-1], pixels))
    assert abs(float(inputs[:, -1].mean())) < 0.02
