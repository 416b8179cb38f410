"""Clothing: from the road up trousers, top, face, hair; outfits, and colours of signs, go over into each other."""

from __future__ import annotations

import pytest
import torch

from lidar2pano.appearance.invented_textures import (
    HAIR,
    HAIR_M,
    HEAD_M,
    LEGS_M,
    SIGNS,
    SKIN,
    TOPS,
    TROUSERS,
    clothing,
    sign_colours,
)


@pytest.mark.parametrize("outfit", range(len(TOPS)))
def test_each_outfit_is_worn_from_the_road_up(outfit):
    height_m = torch.tensor([0.1, LEGS_M - 0.01, LEGS_M + 0.01, HEAD_M - 0.01, HEAD_M + 0.01, HAIR_M - 0.01, 1.8, 2.5])
    noise = torch.full_like(height_m, outfit / (len(TOPS) - 1) * 2 - 1)
    trousers, top = TROUSERS[outfit], TOPS[outfit]
    expected = torch.tensor([trousers, trousers, top, top, SKIN, SKIN, HAIR, HAIR])
    torch.testing.assert_close(clothing(height_m, noise), expected, atol=1e-6, rtol=0)


def test_between_two_outfits_lies_their_mean():
    height_m, step = torch.tensor([0.4, 1.2]), 2 / (len(TOPS) - 1)
    expected = torch.stack([torch.tensor(each[2:4]).mean(0) for each in (TROUSERS, TOPS)])
    noise = torch.full((2,), -1 + 2.5 * step)
    torch.testing.assert_close(clothing(height_m, noise), expected)


def test_the_mean_of_all_outfits_is_hardly_brighter_than_the_mean_person():
    """By height, over all outfits: painters know the mean colour of people, and tones are what differs from it."""
    height_m, noise = torch.meshgrid(torch.linspace(0, 1.75, 176), torch.linspace(-1, 1, 101), indexing="ij")
    mean = clothing(height_m.flatten(), noise.flatten()).mean(0)
    assert mean.abs().max() < 0.06
    assert mean.max() - mean.min() < 0.06, "nor of a colour"


def test_where_there_are_no_people_nothing_is_worn():
    assert clothing(torch.zeros(0), torch.zeros(0)).shape == (0, 3)


def test_signs_have_one_colour_after_the_other():
    noise = torch.linspace(-1, 1, 2 * len(SIGNS) - 1)
    found = sign_colours(noise)
    torch.testing.assert_close(found[::2], torch.tensor(SIGNS), atol=1e-6, rtol=0)
    torch.testing.assert_close(found[1::2], (found[:-1:2] + found[2::2]) / 2, atol=1e-6, rtol=0)
    assert sign_colours(torch.zeros(0)).shape == (0, 3)
