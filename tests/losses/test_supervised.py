"""Parts of supervised losses, each against its definition in numbers worked by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lidar2pano.losses.painting import POOL, pooled
from lidar2pano.losses.supervised import class_weights


def test_class_weights_are_a_power_of_the_shares():
    weights = class_weights(np.array([50.0, 40.0, 10.0]), 0.5, least=1e-4, most=9.0)
    rare, common = 0.1**-0.5, 0.4**-0.5
    mean = (rare + common) / 2  # class 0 does not count in the mean
    assert weights.tolist() == pytest.approx([0.5**-0.5 / mean, common / mean, rare / mean])
    assert class_weights(np.array([1.0, 1.0, 2.0]), 0.0, least=1e-4, most=9.0).tolist() == [1, 1, 1]


def test_class_weights_are_bounded():
    weights = class_weights(np.array([0.0, 999.0, 1.0, 0.0]), 1.0, least=1e-2, most=1.25)
    shares = np.array([1e-2, 0.999, 1e-2, 1e-2])  # 0.001 and 0 count as 0.01
    expected = 1 / shares
    assert weights.tolist() == pytest.approx(np.minimum(expected / expected[1:].mean(), 1.25).tolist())
    assert weights.max() == 1.25


def test_pooling_takes_means_over_squares():
    image = torch.rand(3, 2 * POOL, 3 * POOL)
    found = pooled(image)
    assert found.shape == (3, 2, 3)
    assert found[1, 1, 2] == pytest.approx(image[1, POOL:, 2 * POOL :].mean().item(), rel=1e-5)
