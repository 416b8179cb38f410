"""The Frechet distance of patches as a loss."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lidar2pano.losses.painting import FIRST, MOST_STRETCH, PatchStatistics, transport
from lidar2pano.metrics.frechet import Normal, normal_distance

SIZE = 4


def covariance(seed: int) -> torch.Tensor:
    root = torch.randn(SIZE, 3 * SIZE, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return root @ root.T / SIZE


def test_the_transport_carries_one_covariance_to_the_other():
    one, other = covariance(0), covariance(1) / 2
    T = transport(one, other)
    assert torch.allclose(T, T.T)
    assert torch.allclose(T @ one @ T, other, rtol=0.05, atol=0.05)
    assert torch.allclose(transport(one, one), torch.eye(SIZE, dtype=one.dtype), atol=0.05)
    assert torch.linalg.eigvalsh(transport(one * 1e-6, one)).max() == pytest.approx(MOST_STRETCH)


def features_of(values: torch.Tensor) -> torch.Tensor:
    """Features (1, SIZE, 8, 8 P) whose patches, every second of them, are the values (P, SIZE)."""
    return values.T[None, :, None].repeat_interleave(8, 3).expand(1, SIZE, 8, 8 * len(values))


def distance(painted: torch.Tensor, real: torch.Tensor) -> float:
    normal = [
        Normal(x.mean(0).numpy(), np.cov(x.numpy().T), len(x)) for x in (painted.detach().double(), real.double())
    ]
    return normal_distance(*normal)


def test_descent_along_it_shortens_the_frechet_distance():
    torch.manual_seed(0)
    real = torch.randn(64, SIZE) @ torch.randn(SIZE, SIZE) + 3
    painted = torch.nn.Parameter(torch.randn(64, SIZE))
    before, optimizer = distance(painted, real), torch.optim.Adam([painted], 0.03)
    loss, valid, looks = PatchStatistics(2, (SIZE,)), torch.ones(1, 1, 32, 32 * 64), torch.tensor([1])
    first = loss([(features_of(real), features_of(painted))], valid, looks)
    assert first == 0, "nothing is known yet"
    for _ in range(FIRST + 700):
        optimizer.zero_grad()
        step = loss([(features_of(real), features_of(painted))], valid, looks)
        if step.requires_grad:
            step.backward()
            optimizer.step()
    assert distance(painted, real) < 0.1 * before
    assert all(pair.step == 0 for pair in loss.looks[0]), "looks have their own moments"


def test_patches_that_are_not_known_as_a_whole_do_not_count():
    values, loss = torch.randn(16, SIZE), PatchStatistics(1, (SIZE,))
    valid = torch.ones(1, 1, 32, 32 * 16)
    valid[..., 32 * 8 :] = 0
    loss([(features_of(values), features_of(values))], valid, torch.tensor([0]))
    (pair,) = loss.looks[0]
    assert torch.allclose(
        pair.real.first, features_of(values)[0, :, 0, :64].unfold(1, 8, 4).mean(2).mean(1).double(), atol=1e-6
    )
    nothing = loss([(features_of(values), features_of(values))], valid * 0, torch.tensor([0]))
    assert nothing == 0 and pair.step == 1
