"""Every metric gives the same value, to the last bit, in whatever order its frames were counted."""

from __future__ import annotations

from collections.abc import Callable
from math import isnan
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from lidar2pano.metrics.confusion import MeanIoU
from lidar2pano.metrics.frame_metrics import SSIM, DepthError, FeatureDistance, RollError, SeamRatio, WarpingError
from lidar2pano.metrics.frechet import FrechetDistance
from lidar2pano.metrics.sliced_wasserstein import SlicedWasserstein

FRAMES = [f"08/{number:06d}" for number in range(7)]


def drawn(name: str) -> np.random.Generator:
    return np.random.default_rng(list(name.encode()))


def image(name: str, side: int) -> np.ndarray:
    return (drawn(name).integers(0, 256, (2, 16, 24, 3)) // (1 + side)).astype(np.uint8)[side]


def pair(name: str) -> tuple[np.ndarray, np.ndarray]:
    return image(name, 0), image(name, 1)


def ids(name: str) -> tuple[np.ndarray, np.ndarray]:
    first, second = drawn(name).integers(0, 5, (2, 16, 24))
    return first, np.where(drawn(name).random((16, 24)) < 0.6, first, second)


def features(images: torch.Tensor) -> torch.Tensor:
    return images[:, :, :2, 0].flatten(1).float()


class Case(NamedTuple):
    """How to make a metric, and the arguments of `update` for one frame."""

    make: Callable[[], Any]
    arguments: Callable[[str], tuple]


CASES = {
    "ssim": Case(SSIM, pair),
    "features": Case(lambda: FeatureDistance(lambda images: images[:, :, ::4, ::4].float(), 4), pair),
    "classes": Case(lambda: MeanIoU(5, unscored=(0,)), ids),
    "depth": Case(DepthError, lambda name: tuple(drawn(name).uniform(1, 50, (2, 16, 24)))),
    "time": Case(lambda: WarpingError(circular=True), lambda name: (*pair(name), drawn(name).normal(size=(2, 16, 24)))),
    "seam": Case(SeamRatio, lambda name: (image(name, 0),)),
    "roll": Case(RollError, lambda name: (*drawn(name).normal(size=(2, 3, 9)), 2)),
    "wasserstein": Case(lambda: SlicedWasserstein(seed=1), pair),
    "frechet": Case(lambda: FrechetDistance(features, name="FSD"), pair),
}


@pytest.fixture(params=CASES, scope="module")
def case(request) -> Case:
    return CASES[request.param]


def counted(case: Case, names: list[str]) -> Any:
    metric = case.make()
    for name in names:
        metric.update(*case.arguments(name), name)
    return metric


@pytest.fixture(scope="module")
def whole(case) -> Any:
    return counted(case, FRAMES)


def test_the_order_of_frames_does_not_matter(case, whole):
    other = counted(case, [FRAMES[3], *FRAMES[5:3:-1], FRAMES[6], *FRAMES[:3]])
    assert len(other) == len(whole) == len(FRAMES)
    assert other.values() == whole.values()  # equal, not nearly
    assert other.compute() == whole.compute()
    assert not isnan(whole.compute())


def test_every_frame_counts(case, whole):
    assert counted(case, FRAMES[1:]).compute() != whole.compute()


def test_a_frame_counts_once(case):
    twice = counted(case, FRAMES[:2])
    with pytest.raises(ValueError, match=f"'{FRAMES[1]}' was counted twice"):
        twice.update(*case.arguments(FRAMES[1]), FRAMES[1])


def test_nothing_counted_is_not_a_number(case):
    assert isnan(case.make().compute())
    assert all(isnan(value) for value in case.make().values().values())


@pytest.mark.parametrize("name", ["SSIM", "AbsRel", "RMSE"])
def test_values_of_one_frame(name):
    metric = counted(case := CASES["ssim" if name == "SSIM" else "depth"], FRAMES[:3])
    for frame in FRAMES[:3]:
        assert metric.value_of_frame(frame, name) == pytest.approx(counted(case, [frame]).values()[name])
