"""Odds and the likeliest class."""

from __future__ import annotations

import torch

from lidar2pano.geometry.odds import likeliest, multiply_odds


def test_the_likeliest_class_is_the_first_of_the_highest():
    scores = torch.randint(0, 6, (2, 7, 13, 40), generator=torch.Generator().manual_seed(3)).float()  # many are equal
    for each in (scores, scores.bfloat16(), scores.contiguous(memory_format=torch.channels_last)):
        found = likeliest(each)
        assert found.dtype == torch.uint8 and torch.equal(found.long(), scores.argmax(1))


def test_odds_are_multiplied_and_sums_and_other_shares_stay():
    generator = torch.Generator().manual_seed(4)
    before = 5 * torch.randn(2, 5, 6, 8, generator=generator)
    factor = 3 * torch.randn(2, 6, 8, generator=generator)
    after = before.clone()
    multiply_odds(after, 2, [0, 4], factor)
    p, q = before.double().softmax(1), after.double().softmax(1)
    others = p[:, 0] + p[:, 4]
    assert torch.allclose(q[:, 2] / (q[:, 0] + q[:, 4]), p[:, 2] / others * factor.double().exp(), rtol=1e-4)
    assert torch.allclose(q[:, 0] / q[:, 4], p[:, 0] / p[:, 4], rtol=1e-4)
    assert torch.allclose(q[:, [1, 3]], p[:, [1, 3]], atol=1e-6)
    assert torch.equal(after[:, [1, 3]], before[:, [1, 3]])
