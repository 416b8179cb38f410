"""Colours of an invention brought to those of cameras, class by class."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lidar2pano.metrics.colour_difference import linear_light
from lidar2pano.pipeline.colour_transfer import (
    CODES,
    LEVELS,
    LIGHT,
    Moments,
    class_maps,
    light_maps,
    mapped,
    monge_kantorovich,
)


def normal(seed: int, count: int, mean, scale: float = 0.05) -> np.ndarray:
    generator = np.random.default_rng(seed)
    return generator.normal(size=(count, 3)) @ generator.uniform(-scale, scale, (3, 3)) + mean


def test_codes_and_light_are_srgb():
    codes = np.arange(256)
    np.testing.assert_allclose(LIGHT.numpy(), linear_light(codes), atol=1e-6)
    back = CODES[(LIGHT * LEVELS).round().long()].numpy()
    assert np.abs(back - codes)[13:].max() < 0.5 and np.abs(back - codes).max() < 2


def test_the_map_takes_one_distribution_to_the_other():
    first, second = normal(1, 20000, (0.2, 0.3, 0.1)), normal(2, 20000, (0.5, 0.4, 0.6), 0.1)
    light = monge_kantorovich(Moments.of(first), Moments.of(second))(first)
    np.testing.assert_allclose(light.mean(0), second.mean(0), atol=1e-9)
    np.testing.assert_allclose(np.cov(light.T), np.cov(second.T), atol=1e-4)
    A = monge_kantorovich(Moments.of(first), Moments.of(second)).A
    np.testing.assert_allclose(A, A.T, atol=1e-9)
    assert (np.linalg.eigvalsh(A) > 0).all(), "the optimal map is a convex function's gradient"
    same = monge_kantorovich(Moments.of(first), Moments.of(first))
    np.testing.assert_allclose(same.A, np.eye(3), atol=1e-6)


def test_a_flat_colour_is_moved_and_not_blown_up():
    flat = np.full((100, 3), 0.25)
    flat_map = monge_kantorovich(Moments.of(flat), Moments.of(flat * 0.5))
    np.testing.assert_allclose(flat_map(flat), flat * 0.5, atol=1e-9)
    assert np.abs(flat_map.A).max() < 1.01


@pytest.mark.parametrize("cells", [400, 1])
def test_a_class_that_is_seen_rarely_has_the_map_of_all(cells):
    often = [normal(seed, 4000, mean, 0.02) for seed, mean in ((1, (0.2, 0.2, 0.2)), (2, (0.6, 0.5, 0.4)))]
    rare = normal(3, 400, (0.4, 0.4, 0.4), 0.02)
    painted = np.concatenate([*often, rare])
    target = np.concatenate([*(part * 0.7 for part in often), rare * 0.7 + (0.15, 0.0, 0.0)])
    classes = np.repeat([1, 2, 3], [4000, 4000, 400])
    number = np.concatenate([np.arange(8000) // 10, 9000 + np.arange(400) * cells // 400])
    noise = normal(4, 10000, 0.0, 0.15)[number]  # one for a cell
    maps = class_maps(painted, target + noise, classes, number)
    off = (maps[3](rare) - maps[-1](rare)).mean(0)
    true = (target[classes == 3] - maps[-1](rare)).mean(0)
    share = off @ true / (true @ true)
    assert share > 0.9 if cells == 400 else share < 0.8
    np.testing.assert_allclose(maps[1](often[0]).mean(0), target[classes == 1].mean(0), atol=0.02)


def test_what_cameras_see_gives_its_colours_to_what_they_do_not():
    generator = np.random.default_rng(5)
    classes = torch.zeros(64, 128, dtype=torch.uint8)
    classes[:32] = 9
    colour = generator.integers(60, 100, (64, 128, 3), dtype=np.uint8)
    real = torch.from_numpy(colour.astype(np.float32)).movedim(2, 0).clone()
    real[:, :32] += torch.tensor([40.0, 0, -20])[:, None, None]
    real[:, 32:] -= 30
    source = torch.zeros(64, 128, dtype=torch.uint8)
    source[:, :64] = 1
    colour = torch.from_numpy(colour)
    codes = mapped(light_maps(colour, classes, real, source), colour.flatten(0, 1), classes.flatten())
    assert float((codes.T.view_as(real) - real)[:, :, 64:].abs().mean()) < 2.5
    maps = light_maps(colour, classes, real, torch.zeros_like(source))
    assert (mapped(maps, colour.flatten(0, 1), classes.flatten()) == colour.flatten(0, 1)).all()
