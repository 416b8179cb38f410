"""Patch Frechet distance against its definition."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lidar2pano.metrics.patch_frechet import frechet, patch_features, patch_frechet


def frechet_slowly(one: np.ndarray, other: np.ndarray) -> float:
    """With scipy-free matrix root by iteration (Denman and Beavers 1976)."""
    spread = np.cov(one.T) @ np.cov(other.T)
    root, inverse = spread.copy(), np.eye(len(spread))
    for _ in range(60):
        root, inverse = (root + np.linalg.inv(inverse)) / 2, (inverse + np.linalg.inv(root)) / 2
    gap = one.mean(0) - other.mean(0)
    return float(gap @ gap + np.trace(np.cov(one.T)) + np.trace(np.cov(other.T)) - 2 * np.trace(root))


@pytest.fixture
def features() -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(0)
    mix = generator.normal(size=(5, 5))
    return generator.normal(size=(200, 5)), generator.normal(size=(300, 5)) @ mix + 0.5


def test_it_agrees_with_its_definition(features):
    assert frechet(*features) == pytest.approx(frechet_slowly(*features), rel=1e-6)
    assert frechet(*features) == pytest.approx(frechet(*features[::-1]), rel=1e-9)
    assert frechet(features[0], features[0]) == pytest.approx(0, abs=1e-9)


def test_real_to_real_compares_the_two_halves(features):
    one, other = features
    distance, among = patch_frechet([one], [other[:100], other[100:200], other[200:]])
    assert distance == pytest.approx(frechet(one, other))
    assert among == pytest.approx(frechet(other[:150], other[150:]))


def test_patches_are_means_of_features():
    maps = torch.randn(3, 24, 40)
    found = patch_features(maps)
    slow = [maps[:, i : i + 8, j : j + 8].mean((1, 2)).numpy() for i in range(0, 17, 4) for j in range(0, 33, 4)]
    assert np.allclose(found, slow, atol=1e-6)


def test_patches_with_an_unknown_pixel_are_left_out():
    maps = torch.randn(3, 24, 40)
    valid = np.ones((376, 633), dtype=bool)  # the features' last row and column reach beyond the picture
    valid[200, 100] = False
    kept = [
        (i, j)
        for i in range(0, 257, 64)
        for j in range(0, 513, 64)
        if i + 128 <= 376 and j + 128 <= 633 and not (i <= 200 < i + 128 and j <= 100 < j + 128)
    ]
    slow = [maps[:, i // 16 : i // 16 + 8, j // 16 : j // 16 + 8].mean((1, 2)).numpy() for i, j in kept]
    assert np.allclose(patch_features(maps, valid), slow, atol=1e-6)
