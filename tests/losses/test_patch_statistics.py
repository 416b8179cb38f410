"""The Frechet distance of patches as a loss."""

from __future__ import annotations

import pytest
import torch

from lidar2pano.losses.painting import EVERY, FIRST, MOST_STRETCH, Patches, PatchStatistics, transport
from lidar2pano.metrics.frechet import frechet_distance, normal_of

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
    first, second = (normal_of(patches.detach().numpy()) for patches in (painted, real))
    return frechet_distance(first, second)


def patches_of(values: torch.Tensor, group: int = 0, *, groups: int = 2, counted: int | None = None) -> Patches:
    """Return one depth of such features; the first `counted` values count, None: all."""
    columns = 32 * len(values)
    mask = (torch.arange(columns) < 32 * (len(values) if counted is None else counted)).float()
    shares = torch.zeros(1, groups, 32, columns)
    shares[:, group] = 1
    return Patches([features_of(values)], mask.expand(1, 1, 32, columns), shares)


def test_descent_along_it_shortens_the_frechet_distance():
    torch.manual_seed(0)
    real = torch.randn(64, SIZE) @ torch.randn(SIZE, SIZE) + 3
    painted = torch.nn.Parameter(torch.randn(64, SIZE))
    before, optimizer = distance(painted, real), torch.optim.Adam([painted], 0.03)
    loss = PatchStatistics((SIZE,), 2)
    assert loss(patches_of(real), patches_of(painted)) == 0, "nothing is known yet"
    for _ in range(FIRST + 700):
        optimizer.zero_grad()
        step = loss(patches_of(real), patches_of(painted))
        if step.requires_grad:
            step.backward()
            optimizer.step()
    assert distance(painted, real) < 0.1 * before


def test_a_group_is_compared_with_itself_alone():
    """Patches that change their groups are far from their goals; without groups nothing would have changed."""
    torch.manual_seed(0)
    low, high = torch.randn(16, SIZE), torch.randn(16, SIZE) + 9
    apart, pooled = PatchStatistics((SIZE,), 2), PatchStatistics((SIZE,), 2)
    for _ in range(FIRST + 1):
        for group, (real, painted) in enumerate(((low, high), (high, low))):
            changed = apart(patches_of(real, group), patches_of(painted, group))
            same = pooled(patches_of(real), patches_of(painted))
    assert same < 0.05 and changed > 1


def test_painted_patches_of_other_pictures_learn_from_the_real_ones():
    """A group that is real in one picture and painted in another has a distance, though nothing is beside it."""
    torch.manual_seed(0)
    real, painted, loss = torch.randn(16, SIZE), torch.randn(16, SIZE) + 3, PatchStatistics((SIZE,), 2)
    for _ in range(FIRST + 1):
        loss(patches_of(real, 1, counted=16), patches_of(painted, 0))
        step = loss(patches_of(real, 0), patches_of(painted, 1))
    assert step > 1


def test_statistics_that_are_put_away_go_on_as_if_nothing_had_happened():
    torch.manual_seed(0)
    whole, parts = PatchStatistics((SIZE,), 2), PatchStatistics((SIZE,), 2)
    for step in range(FIRST + EVERY + 3):
        real, painted = patches_of(torch.randn(16, SIZE), step % 2), patches_of(torch.randn(16, SIZE) + 3, 1)
        expected = whole(real, painted)
        assert torch.equal(parts(real, painted), expected), step
        state = {name: value.clone() for name, value in parts.state_dict().items()}
        parts = PatchStatistics((SIZE,), 2)
        parts.load_state_dict(state)
    assert expected > 0 and state.keys() == whole.state_dict().keys()
    with pytest.raises(RuntimeError, match="size mismatch"):
        PatchStatistics((SIZE + 1,), 2).load_state_dict(state)


def test_patches_that_are_not_known_as_a_whole_do_not_count():
    values, loss = torch.randn(16, SIZE), PatchStatistics((SIZE,), 2)
    loss(patches_of(values, counted=8), patches_of(values))
    pair = loss.depths[0][0]
    kept = features_of(values)[0, :, 0, :64].unfold(1, 8, 4).mean(2).mean(1).double()
    assert torch.allclose(pair.real.first, kept, atol=1e-6)
    assert not torch.allclose(pair.painted.first, kept, atol=1e-3)
    nothing = loss(patches_of(values), patches_of(values, counted=0))
    assert nothing == 0 and pair.step == 1
