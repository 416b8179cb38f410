from __future__ import annotations

import math

import numpy as np
import torch

from lidar2pano.appearance.cars import ANGLES, HOLE, PARKED_M, THICK_M, _closed, _cut, _numbers, _over, _rectangles


def test_numbers_count_on_around_the_seam():
    first = torch.tensor([False, True, False, False, True, True, False])
    assert _numbers(first).tolist() == [2, 0, 0, 0, 1, 2, 2]
    assert _numbers(torch.zeros(5, dtype=torch.bool)).tolist() == [0] * 5


def test_rectangles_agree_with_their_slow_definition():
    generator = np.random.default_rng(3)
    number = torch.from_numpy(generator.integers(0, 4, 40))
    point = torch.from_numpy(generator.normal(size=(2, 40)) * [[3.0], [1.0]])
    middle, axis, length, width = _rectangles(point, number)
    for one in range(4):
        own = number == one
        found = []
        for step in range(ANGLES):
            angle = step * math.pi / 2 / ANGLES
            axes = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
            turned = axes @ point[:, own].numpy()
            size = np.ptp(turned, axis=1) + THICK_M
            centre = axes.T @ (turned.min(1) + turned.max(1)) / 2
            found.append((size.prod(), size.max(), size.min(), axes[size.argmax()], centre))
        _, longest, shortest, direction, centre = min(found, key=lambda each: each[0])
        assert np.allclose(middle[:, own].T, centre) and np.allclose(axis[:, own].T, direction)
        assert np.allclose(length[own], longest) and np.allclose(width[own], shortest)


def test_sums_over_cars_agree_with_their_slow_definition():
    number, values = torch.tensor([0, 1, 0, 2, 1]), torch.tensor([[1.0, 5, 3, 7, -1]])
    assert _over(number, values, "amax").tolist() == [[3, 5, 3, 7, 5]]
    assert _over(number, values, "mean").tolist() == [[2, 2, 2, 7, 2]]


def test_small_gaps_in_a_car_are_closed_and_large_ones_are_not():
    here = torch.ones(60, dtype=torch.bool)
    here[10 : 10 + 2 * HOLE] = False
    here[30 : 31 + 2 * HOLE] = False
    expected = torch.ones(60, dtype=torch.bool)
    expected[30 : 31 + 2 * HOLE] = False
    assert torch.equal(_closed(here), expected)


def test_a_row_of_cars_is_cut_into_cars():
    along = torch.linspace(-1.5 * PARKED_M, 1.5 * PARKED_M, 61)
    point = torch.stack([along * 0.8, along * 0.6 + 3])
    number = _cut(point, torch.zeros(61, dtype=torch.int64))
    assert sorted(torch.bincount(number).tolist()) == [20, 20, 21]
    assert (_cut(point / 2.2, torch.zeros(61, dtype=torch.int64)) == 0).all()
