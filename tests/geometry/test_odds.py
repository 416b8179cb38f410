"""Odds and the likeliest class."""

from __future__ import annotations

import torch

from lidar2pano.geometry.odds import give_away, likeliest, multiply_odds


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


def test_what_is_given_away_is_shared_as_the_others_share_their_own():
    generator = torch.Generator().manual_seed(5)
    before = 5 * torch.randn(2, 5, 6, 8, generator=generator)
    chosen = torch.rand(2, 6, 8, generator=generator) < 0.4
    after = before.clone()
    give_away(after, 2, [0, 4], chosen.nonzero(as_tuple=True))
    expected = before.double().softmax(1)
    expected[:, [0, 4]] += (chosen * expected[:, 2])[:, None] * expected[:, [0, 4]] / expected[:, [0, 4]].sum(1, True)
    expected[:, 2] *= ~chosen
    assert torch.allclose(after.double().softmax(1), expected, atol=1e-5)
    assert torch.equal(after.movedim(1, 3)[~chosen], before.movedim(1, 3)[~chosen])
