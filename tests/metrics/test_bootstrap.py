"""Confidence intervals: against all resamples that there are, against scipy, and frames drawn again by hand."""

from __future__ import annotations

import itertools
from math import isnan

import numpy as np
import pytest
import scipy.stats

from lidar2pano.metrics import accumulation
from lidar2pano.metrics.accumulation import interval, multiplicities
from lidar2pano.metrics.confusion import MeanIoU
from lidar2pano.metrics.frame_metrics import RollError


def means(values, weights=None) -> RollError:
    """A metric that is the mean of values, one per frame, weighted."""
    metric = RollError()
    for place, value in enumerate(values):
        length = 1 if weights is None else weights[place]
        metric.update(np.zeros(length), np.full(length, float(value)), 0, f"{place:03d}")
    return metric


def frames(number: int, seed: int = 0) -> MeanIoU:
    """A network that gets some frames right and others wrong."""
    generator, metric = np.random.default_rng(seed), MeanIoU(4)
    for place in range(number):
        target = generator.integers(0, 1 + place % 4, 200)  # not every frame has every class
        wrong = generator.random(200) < generator.random()
        metric.update(np.where(wrong, generator.integers(0, 4, 200), target), target, f"{place:03d}")
    return metric


def test_every_resample_is_as_long_as_the_set_and_evenly_drawn():
    times = multiplicities(5, 20_000, np.random.default_rng(3))
    assert times.shape == (20_000, 5)
    assert (times.sum(1) == 5).all()
    assert times.mean(0) == pytest.approx([1] * 5, abs=0.03)
    assert (times == 5).any(1).mean() == pytest.approx(5 / 5**5, abs=1e-3)  # all five the same
    assert np.array_equal(times, multiplicities(5, 20_000, np.random.default_rng(3)))
    assert not np.array_equal(times, multiplicities(5, 20_000, np.random.default_rng(4)))


def test_interval_agrees_with_all_resamples_that_there_are():
    metric = frames(5)
    names = sorted(metric.rows)
    values = []
    for draw in itertools.product(names, repeat=5):
        again = MeanIoU(4)
        for place, name in enumerate(draw):
            again.rows[str(place)] = metric.rows[name]
        values.append(again.compute())
    for level in (0.5, 0.8):
        found = interval(metric, level=level, resamples=50_000)
        exact = np.quantile(values, [(1 - level) / 2, (1 + level) / 2], method="inverted_cdf")
        around = np.ptp(values) * 0.02
        assert (found.low, found.high) == pytest.approx(exact, abs=around)
        assert found[0] == metric.compute()
        assert found.frames == 5


def test_interval_agrees_with_scipy():
    values = np.random.default_rng(1).exponential(size=40)
    theirs = scipy.stats.bootstrap((values,), np.mean, method="percentile", n_resamples=20_000, rng=0)
    ours = interval(means(values), resamples=20_000)
    assert (ours.low, ours.high) == pytest.approx(tuple(theirs.confidence_interval), abs=0.01)
    assert ours.value == pytest.approx(values.mean())
    narrow = interval(means(values), level=0.5, resamples=20_000)
    assert ours.low < narrow.low < narrow.value < narrow.high < ours.high


def test_a_value_is_chosen_by_name():
    metric = frames(12)
    found = interval(metric, "accuracy", resamples=200)
    assert found.value == metric.values()["accuracy"] != metric.compute()
    assert found.low < found.value < found.high


def test_frames_with_more_to_count_weigh_more():
    metric = means([0, 0, 0, 0, 1], weights=[30, 30, 30, 30, 10])
    assert interval(metric).value == 1 / 13
    assert interval(metric, level=0.98).low == 0


def test_blocks_of_resamples_give_the_same_interval(monkeypatch):
    metric, whole = frames(12), interval(frames(12))
    monkeypatch.setattr(accumulation, "BLOCK", 12 * 7)  # seven resamples at a time
    assert interval(metric) == whole


def test_few_frames_and_none():
    few = interval(means([3.0, 4.0, 5.0, 6.0]))
    assert (few.value, few.frames) == (4.5, 4) and isnan(few.low) and isnan(few.high)
    assert interval(means([3.0] * 5)) == (3, 3, 3, 5)
    nothing = interval(means([]))
    assert all(isnan(value) for value in nothing[:3]) and nothing.frames == 0
    unscored = MeanIoU(2, unscored=(0, 1))
    unscored.update(np.array([0]), np.array([1]), "a")
    assert all(isnan(value) for value in interval(unscored)[:3])


def test_resamples_without_a_value_are_left_out():
    metric = means([2.0] + 4 * [4.0])
    metric.rows["000"] = np.zeros(2)  # a frame of which nothing is scored
    assert interval(metric)[:3] == (4, 4, 4)
