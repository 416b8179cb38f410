"""Patch Frechet distance against its definition."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from lidar2pano.metrics.frechet import PatchFrechetDistance, patch_features


def frechet_slowly(one: np.ndarray, other: np.ndarray) -> float:
    """With scipy-free matrix root by iteration (Denman and Beavers 1976)."""
    spread = np.cov(one.T) @ np.cov(other.T)
    root, inverse = spread.copy(), np.eye(len(spread))
    for _ in range(60):
        root, inverse = (root + np.linalg.inv(inverse)) / 2, (inverse + np.linalg.inv(root)) / 2
    gap = one.mean(0) - other.mean(0)
    return float(gap @ gap + np.trace(np.cov(one.T)) + np.trace(np.cov(other.T)) - 2 * np.trace(root))


@pytest.fixture
def metric() -> PatchFrechetDistance:
    """Over 3 features of colours: four pictures of 200 x 264 pixels."""

    def extract(images: torch.Tensor) -> torch.Tensor:
        x = torch.nn.functional.avg_pool2d(images.float() / 100, 16, ceil_mode=True)
        return torch.cat([x, x[:, :1] * x[:, 1:2]], 1)

    generator = np.random.default_rng(0)
    metric = PatchFrechetDistance(extract)
    for number in range(4):
        hills = generator.integers(0, 255, (2, 7, 9, 3)).astype(np.uint8)
        one, other = (np.kron(part, np.ones((32, 32, 1), dtype=np.uint8)) for part in hills)
        metric.update(one // 2, other, f"0/{number}")
    return metric


def test_it_agrees_with_its_definition(metric):
    def features(side, names):
        return np.concatenate([rows[side, name] for name in names])

    rows = {}
    metric_of = metric.extract
    generator = np.random.default_rng(0)
    for number in range(4):
        hills = generator.integers(0, 255, (2, 7, 9, 3)).astype(np.uint8)
        one, other = (np.kron(part, np.ones((32, 32, 1), dtype=np.uint8)) for part in hills)
        for side, image in (("mine", one // 2), ("real", other)):
            maps = metric_of(torch.from_numpy(image).movedim(2, 0)[None])[0]
            rows[side, number] = patch_features(maps)
    distance = frechet_slowly(features("mine", range(4)), features("real", range(4)))
    among = frechet_slowly(features("real", (0, 1)), features("real", (2, 3)))
    wanted = {"ratio": distance / among, "distance": distance, "real to real": among}
    assert metric.values() == pytest.approx(wanted, rel=1e-5)


def test_real_images_are_at_no_distance_from_themselves(metric):
    same = PatchFrechetDistance(metric.extract)
    for name, sums in zip(sorted(metric.kept), metric.stacked(1), strict=True):
        same._keep(name, sums, sums)
    assert same.values()["distance"] == pytest.approx(0, abs=1e-9)


def test_too_few_patches_have_no_distance(metric):
    assert math.isnan(PatchFrechetDistance(metric.extract).compute())


@pytest.mark.parametrize("size", [(100, 300), (300, 100), (20, 20)])
def test_an_image_smaller_than_a_patch_has_none(metric, size):
    before, image = metric.values(), np.full((*size, 3), 200, np.uint8)
    metric.update(image, image // 2, "0/9", np.ones(size, dtype=bool))
    assert metric.values() == before and len(metric) == 5


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


def test_halved_images_and_finer_features_are_measured_by_their_own_patches():
    """The picture of means of 2 x 2 pixels, with a mask of pixels all of whose four are valid."""

    def extract(images: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.avg_pool2d(images.float(), 4)

    generator = np.random.default_rng(3)
    halved, plain = PatchFrechetDistance(extract, 4, 2), PatchFrechetDistance(extract, 4)
    for number in range(3):
        small = generator.integers(0, 255, (2, 200, 264, 3)).astype(np.uint8)
        valid = np.ones((200, 264), dtype=bool)
        valid[generator.integers(200), generator.integers(264)] = False
        whole = np.repeat(np.repeat(valid, 2, 0), 2, 1)
        rows, columns = np.argwhere(~whole)[0]
        whole[rows + 1, :] |= True  # one of the four is enough
        whole[rows, columns + 1] = True
        plain.update(small[0], small[1], f"0/{number}", valid)
        one, other = (np.repeat(np.repeat(part, 2, 0), 2, 1) for part in small)
        halved.update(one, other, f"0/{number}", whole)
    assert halved.values() == pytest.approx(plain.values(), rel=1e-5)
    maps = torch.randn(3, 96, 160)
    slow = [maps[:, i : i + 32, j : j + 32].mean((1, 2)).numpy() for i in range(0, 65, 16) for j in range(0, 129, 16)]
    assert np.allclose(patch_features(maps, down=4), slow, atol=1e-6)
