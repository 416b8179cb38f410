"""The reliability diagram and its summary, by hand and against a second implementation."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torchmetrics.functional.classification import binary_calibration_error

from lidar2pano.metrics.reliability import BINS, Reliability


def test_by_hand():
    metric = Reliability()
    assert np.isnan(metric.ece)
    metric.update(np.array([0.9, 0.9, 0.9, 0.9, 0.5]), np.array([True, True, False, False, False]))
    assert metric.table[13].tolist() == pytest.approx([0.8, 0.9, 0.5])
    assert metric.table[7].tolist() == pytest.approx([0.2, 0.5, 0.0])
    assert metric.ece == pytest.approx(0.8 * 0.4 + 0.2 * 0.5)


def test_halves_make_the_whole_and_agree_with_torchmetrics():
    generator = np.random.default_rng(2)
    p = generator.random(3000).astype(np.float32)
    correct = generator.random(3000) < p**2
    metric = Reliability()
    metric.update(p[:1000].reshape(10, 100), correct[:1000].reshape(10, 100))
    metric.update(p[1000:], correct[1000:])
    theirs = binary_calibration_error(torch.from_numpy(p), torch.from_numpy(correct).long(), n_bins=BINS)
    assert metric.ece == pytest.approx(theirs.item(), abs=1e-4)
    assert metric.table[:, 0].sum() == pytest.approx(1)
