"""The autoencoder: sizes, circularity, and no statistic over the raster."""

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from lidar2pano.errors import InputError
from lidar2pano.models import build
from lidar2pano.models.autoencoder import encode_columns, reach_px

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


@pytest.mark.parametrize(
    "columns", [[], [10], range(20), [0, 63], [5, 6, 40], [5, 25, 45], range(64)],
    ids=["none", "one", "many", "across the seam", "two windows", "three that touch", "all"],
)  # fmt: skip
def test_columns_are_encoded_as_within_the_whole_picture(network, columns):
    picture, wanted = torch.rand(2, 3, 24, 512) * 2 - 1, torch.zeros(64, dtype=torch.bool)
    wanted[list(columns)] = True
    with torch.inference_mode():
        latents, whole = encode_columns(network.encoder, picture, wanted), network.encode(picture)
    torch.testing.assert_close(latents[..., wanted], whole[..., wanted])
    assert latents.shape == whole.shape


def test_an_encoder_sees_as_far_as_its_convolutions_reach(network):
    picture = torch.zeros(1, 3, 24, 512)
    picture.requires_grad_()
    network.encode(picture)[..., 32].sum().backward()
    seen = picture.grad.abs().sum((0, 1, 2)).nonzero()[:, 0]
    assert 32 * 8 - seen[0] <= reach_px(network.encoder) and seen[-1] - 33 * 8 < reach_px(network.encoder) == 67


def test_a_few_columns_take_a_part_of_the_arithmetic(network):
    """A camera of 65 degrees beside the columns that the encoder reads."""
    picture, wanted = torch.rand(1, 3, 24, 4608), torch.arange(576) < 104
    flops = []
    for encode in (lambda: encode_columns(network.encoder, picture, wanted), lambda: network.encode(picture)):
        with torch.inference_mode(), FlopCounterMode(display=False) as counter:
            encode()
        flops.append(counter.get_total_flops())
    assert flops[0] < 0.22 * flops[1]
