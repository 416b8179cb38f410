"""The autoencoder: sizes, circularity, and no statistic over the raster."""

import pytest
import torch

from lidar2pano.errors import InputError
from lidar2pano.models import build

SMALL = {"latents": 6, "encoder": (4, 6, 8), "decoder": (4, 4, 6, 8)}


@pytest.fixture
def network():
    torch.manual_seed(0)
    return build("autoencoder", **SMALL).eval()


def test_latents_are_an_eighth_of_the_picture_and_become_one_again(network):
    picture, latents = network(torch.rand(2, 3, 24, 64) * 2 - 1)
    assert latents.shape == (2, 6, 3, 8)
    assert picture.shape == (2, 3, 24, 64)


def test_a_turn_of_the_picture_is_a_turn_of_its_latents_and_of_the_answer(network):
    picture = torch.rand(1, 3, 24, 64) * 2 - 1
    with torch.inference_mode():
        (straight, latents), (turned, turned_latents) = network(picture), network(picture.roll(16, 3))
    torch.testing.assert_close(turned_latents, latents.roll(2, 3))
    torch.testing.assert_close(turned, straight.roll(16, 3))


def test_a_pixel_far_away_changes_nothing(network):
    picture = torch.rand(1, 3, 24, 512) * 2 - 1
    other = picture.clone()
    other[..., 256:] = 1.0
    with torch.inference_mode():
        (first, _), (second, _) = network(picture), network(other)
    torch.testing.assert_close(second[..., 120:136], first[..., 120:136])


@pytest.mark.parametrize("size", [(20, 64), (24, 60)])
def test_sizes_that_do_not_divide_are_refused(network, size):
    with pytest.raises(InputError, match="must divide by 8"):
        network(torch.zeros(1, 3, *size))
