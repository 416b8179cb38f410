"""Colours of an invention brought to those of cameras, class by class."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lidar2pano.metrics.frame_metrics import linear_light
from lidar2pano.pipeline.composition import CODES, LEVELS, LIGHT, brightened, class_gains, light_gains


def normal(seed: int, count: int, mean, scale: float = 0.05) -> np.ndarray:
    generator = np.random.default_rng(seed)
    return generator.normal(size=(count, 3)) @ generator.uniform(-scale, scale, (3, 3)) + mean


def test_codes_and_light_are_srgb():
    codes = np.arange(256)
    np.testing.assert_allclose(LIGHT.numpy(), linear_light(codes), atol=1e-6)
    back = CODES[(LIGHT * LEVELS).round().long()].numpy()
    assert np.abs(back - codes)[13:].max() < 0.5 and np.abs(back - codes).max() < 2


def test_a_dark_class_is_not_blown_up():
    dark, cells = np.zeros((100, 3)), np.arange(100)
    gains = class_gains(dark, dark, np.ones(100, dtype=int), cells)
    assert (gains[1] == 0).all() and np.isfinite(gains[-1]).all()


@pytest.mark.parametrize("cells", [400, 1])
def test_a_class_that_is_seen_rarely_has_the_gain_of_all(cells):
    often = [normal(seed, 4000, mean, 0.02) for seed, mean in ((1, (0.2, 0.2, 0.2)), (2, (0.6, 0.5, 0.4)))]
    rare = normal(3, 400, (0.4, 0.4, 0.4), 0.02)
    painted = np.concatenate([*often, rare])
    target = np.concatenate([*(part * 0.7 for part in often), rare * 0.7 + (0.15, 0.0, 0.0)])
    classes = np.repeat([1, 2, 3], [4000, 4000, 400])
    number = np.concatenate([np.arange(8000) // 10, 9000 + np.arange(400) * cells // 400])
    noise = normal(4, 10000, 0.0, 0.15)[number]  # one for a cell
    gains = class_gains(painted, target + noise, classes, number)
    off = ((gains[3] - gains[-1]) * rare).mean(0)
    true = (target[classes == 3] - gains[-1] * rare).mean(0)
    share = off @ true / (true @ true)
    assert share > 0.9 if cells == 400 else share < 0.8
    np.testing.assert_allclose((gains[1] * often[0]).mean(0), target[classes == 1].mean(0), atol=0.02)


def test_what_cameras_see_gives_its_colours_to_what_they_do_not():
    generator = np.random.default_rng(5)
    classes = torch.zeros(64, 128, dtype=torch.uint8)
    classes[:32] = 9
    colour = generator.integers(60, 100, (64, 128, 3), dtype=np.uint8)
    gain = np.ones((64, 128, 3))
    gain[:32], gain[32:] = (2.0, 1.0, 0.6), 0.5
    light = linear_light(colour) * gain
    real = CODES[torch.from_numpy(light * LEVELS).round().long()].movedim(2, 0)
    source = torch.zeros(64, 128, dtype=torch.uint8)
    source[:, :64] = 1
    colour = torch.from_numpy(colour)
    codes = brightened(light_gains(colour, classes, real, source), colour.flatten(0, 1), classes.flatten())
    assert float((codes.T.view_as(real) - real)[:, :, 64:].abs().mean()) < 1
    gains = light_gains(colour, classes, real, torch.zeros_like(source))
    assert (brightened(gains, colour.flatten(0, 1), classes.flatten()) == colour.flatten(0, 1)).all()
