"""Convolutions of an input in parts."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from lidar2pano.models.circular import CircularConv, conv_norm_act
from lidar2pano.models.summed import SummedConv2d

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
