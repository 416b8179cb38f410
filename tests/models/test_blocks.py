"""Circular convolutions: every direction alike, no seam."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

from lidar2pano.geometry.rasters import pad_azimuth, upsample_azimuth
from lidar2pano.models import build
from lidar2pano.models.blocks import CircularConv, SummedConv2d, conv_norm_act, fold_norms


def test_closing_brings_columns_from_the_other_end():
    x = torch.arange(6.0).view(1, 1, 2, 3)
    assert pad_azimuth(x, 1)[0, 0].tolist() == [[2, 0, 1, 2, 0], [5, 3, 4, 5, 3]]


@pytest.mark.parametrize("reach", [1, 3])
def test_closing_has_the_gradients_of_its_definition(reach):
    x = torch.randn(2, 3, 4, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    weight = torch.arange(8 + 2 * reach, dtype=torch.float64) ** 2
    (wanted,) = torch.autograd.grad((torch.cat([x[..., -reach:], x, x[..., :reach]], 3) * weight).sum(), x)
    (found,) = torch.autograd.grad((pad_azimuth(x, reach) * weight).sum(), x)
    torch.testing.assert_close(found, wanted)
    assert torch.autograd.gradgradcheck(lambda part: pad_azimuth(part, reach).square(), x)


@pytest.mark.parametrize("stride", [1, 2])
def test_convolution_of_closed_images_needs_no_copy(stride):
    block = conv_norm_act(5, 3, stride=stride).eval()
    parts = torch.randn(2, 2, 6, 16), torch.randn(2, 3, 6, 16)
    found = block(*(pad_azimuth(part, 1) for part in parts), has_ends=True)
    torch.testing.assert_close(found, block(*parts))
    if stride == 1:
        wide = block(*(pad_azimuth(part, 3) for part in parts), has_ends=True)
        torch.testing.assert_close(wide, pad_azimuth(block(*parts), 2))


@pytest.mark.parametrize("columns", [16, 7, 4])
@pytest.mark.parametrize(
    ("kernel", "stride", "dilation"), [(1, 1, 1), (3, 1, 1), (3, 1, 2), (3, 1, 4), (5, 1, 1), (3, 2, 1)]
)
def test_convolution_agrees_with_its_definition(kernel, stride, dilation, columns):
    conv = CircularConv(2, 3, kernel, stride=stride, dilation=dilation)
    x = torch.randn(2, 2, 6, columns)
    reach = dilation * (kernel // 2)
    around = x[..., torch.arange(-reach, columns + reach) % columns]
    rows = nn.functional.pad(around, (0, 0, reach, reach))
    slow = nn.functional.conv2d(rows, conv.weight, conv.bias, stride, 0, dilation)
    assert torch.allclose(conv(x), slow, atol=1e-5)
    with torch.inference_mode():
        assert torch.allclose(conv(x), slow, atol=1e-5)


@pytest.mark.parametrize(("kernel", "dilation"), [(1, 1), (3, 1), (3, 2), (5, 1)])
def test_a_turned_image_gives_a_turned_answer(kernel, dilation):
    conv = CircularConv(2, 3, kernel, dilation=dilation)
    x = torch.randn(1, 2, 6, 16)
    assert torch.allclose(conv(x).roll(5, -1), conv(x.roll(5, -1)), atol=1e-6)


def test_growing_interpolates_across_the_seam():
    x = torch.tensor([0.0, 0, 0, 4]).view(1, 1, 1, 4)
    assert upsample_azimuth(x, 2)[0, 0].tolist() == [[1, 0, 0, 0, 0, 1, 3, 3]] * 2
    y = torch.randn(1, 2, 3, 8)
    assert torch.allclose(upsample_azimuth(y, 2).roll(6, -1), upsample_azimuth(y.roll(3, -1), 2), atol=1e-6)


@pytest.mark.parametrize("turn", [16, 48])
def test_the_translator_turns_with_its_input(turn):
    image = torch.rand(1, 5, 32, 96) * 20
    segments = torch.rand(1, 20, 32, 96)
    translator = build("titan-pano", widths=(8, 12, 16, 20, 24), pyramid=8).eval()
    with torch.inference_mode():
        logits, depth_m = translator(image, segments)
        turned, turned_m = translator(image.roll(turn, -1), segments.roll(turn, -1))
        assert torch.allclose(logits.roll(turn, -1), turned, atol=1e-4)
        assert torch.allclose(depth_m.roll(turn, -1), turned_m, atol=1e-3)


def test_folding_norms_changes_nothing_but_the_number_of_modules():
    network = nn.Sequential(conv_norm_act(3, 4), conv_norm_act(4, 2))
    for norm in (module for module in network.modules() if isinstance(module, nn.BatchNorm2d)):
        nn.init.normal_(norm.running_mean)
        nn.init.uniform_(norm.running_var, 0.5, 2)
        nn.init.normal_(norm.weight)
        nn.init.normal_(norm.bias)
    network.eval()
    folded = fold_norms(copy.deepcopy(network))
    x = torch.randn(2, 3, 8, 16)
    assert not any(isinstance(module, nn.BatchNorm2d) for module in folded.modules())
    assert torch.allclose(network(x), folded(x), atol=1e-5)


CHANNELS = (3, 1, 2)


def parts() -> list[torch.Tensor]:
    torch.manual_seed(0)
    return [torch.randn(2, channels, 8, 16, dtype=torch.float64, requires_grad=True) for channels in CHANNELS]


@pytest.mark.parametrize("kernel", [1, 2, 3])
@pytest.mark.parametrize("dilation", [1, 2])
@pytest.mark.parametrize("bias", [True, False])
def test_parts_are_convolved_as_their_concatenation(kernel, dilation, bias):
    conv = SummedConv2d(sum(CHANNELS), 5, kernel, padding=1, dilation=dilation, bias=bias).double()
    given = parts()
    wanted = nn.Conv2d.forward(conv, torch.cat(given, 1))
    torch.testing.assert_close(conv(*given), wanted)
    with torch.inference_mode():
        torch.testing.assert_close(conv(*given), wanted)
        torch.testing.assert_close(conv(torch.cat(given, 1)), wanted)


@pytest.mark.parametrize("kernel", [1, 3])
@pytest.mark.parametrize("stride", [1, 2])
def test_circular_convolutions_take_parts(kernel, stride):
    block = conv_norm_act(sum(CHANNELS), 5, kernel, stride=stride).double().eval()
    given = parts()
    wanted = block(torch.cat(given, 1))
    torch.testing.assert_close(block(*given), wanted)
    with torch.inference_mode():
        torch.testing.assert_close(block(*given), wanted)


def test_gradients_of_parts_and_weights_are_those_of_their_concatenation():
    conv, given = CircularConv(sum(CHANNELS), 5).double(), parts()
    found = torch.autograd.grad(conv(*given).square().sum(), [*given, conv.weight])
    wanted = torch.autograd.grad(conv(torch.cat(given, 1)).square().sum(), [*given, conv.weight])
    torch.testing.assert_close(found, wanted)


def test_parts_of_other_channels_are_refused():
    with pytest.raises(RuntimeError, match="split_sizes"):
        SummedConv2d(sum(CHANNELS), 5, 1)(*(part.float() for part in parts()[:2]))
