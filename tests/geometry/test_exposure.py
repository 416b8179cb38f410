"""Exposure of a camera without an image."""

from __future__ import annotations

import numpy as np
import pytest

from lidar2pano.geometry.exposure import metered_gain
from lidar2pano.geometry.stitching import Camera
from miniature_surround import camera


def with_gains(*gains: float) -> list[Camera]:
    image = np.full((300, 480, 3), 100, dtype=np.uint8)
    return [Camera(image, camera(0.0, (0.0, 0.0, 0.0)), gain=(gain, gain, gain)) for gain in gains]


def test_cameras_that_meter_tell_the_level():
    assert metered_gain(50.0, with_gains(0.5, 1.0, 2.0), [100.0] * 3) == pytest.approx(2.0)


def test_cameras_of_one_exposure_leave_the_level():
    assert metered_gain(50.0, with_gains(1.0, 1.0, 1.0), [60.0, 100.0, 140.0]) == 1.0
    assert metered_gain(50.0, with_gains(0.99, 1.0, 1.01), [60.0, 100.0, 140.0]) == pytest.approx(1.0, abs=0.01)


def test_both_guesses_are_averaged_by_their_inverse_variances():
    spread = np.log(2)
    levels = np.exp(np.log(100) + spread * np.array([-1, 0, 1]))
    gains = np.exp(2 * spread * np.array([1, -1, 0]))  # four times the variance
    assert metered_gain(50.0, with_gains(*gains), list(levels)) == pytest.approx(2 ** (4 / 5))
    brighter = metered_gain(50.0, with_gains(*(3 * gains)), list(levels))
    assert brighter == pytest.approx(2 ** (4 / 5) * 3 ** (-1 / 5)), "the panorama is three times as bright as they are"


def test_too_little_tells_nothing():
    assert metered_gain(50.0, with_gains(2.0), [100.0]) == 1.0
    assert metered_gain(50.0, [], []) == 1.0
    assert metered_gain(0.0, with_gains(0.5, 2.0), [100.0] * 2) == 1.0
    assert metered_gain(50.0, with_gains(0.5, 2.0), [0.0, 100.0]) == 1.0
