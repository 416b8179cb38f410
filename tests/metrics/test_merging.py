"""Every metric gives the same answer, to the last bit, however its frames were ordered and shared out."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from math import isnan
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from lidar2pano.metrics.classes import ClassCounts
from lidar2pano.metrics.depth import DepthError
from lidar2pano.metrics.frames import FrameMetric
from lidar2pano.metrics.frechet import FrechetDistance
from lidar2pano.metrics.resegmentation import Resegmentation
from lidar2pano.metrics.seams import RollError, SeamRatio
from lidar2pano.metrics.similarity import SSIM
from lidar2pano.metrics.time import WarpingError
from lidar2pano.metrics.wasserstein import SlicedWasserstein

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


def features(pictures: torch.Tensor) -> torch.Tensor:
    return pictures[:, :, :2, 0].flatten(1).float()


def reds(picture: np.ndarray) -> np.ndarray:
    return picture[..., 0] // 64


class Case(NamedTuple):
    """How to make a metric, one that counts something else, and what one frame gives `update`."""

    make: Callable[[], Any]
    other: Callable[[], Any]
    given: Callable[[str], tuple]


CASES = {
    "ssim": Case(SSIM, SeamRatio, pair),
    "classes": Case(lambda: ClassCounts(5, unscored=(0,)), lambda: ClassCounts(5), ids),
    "resegmentation": Case(
        lambda: Resegmentation(reds, 5, segmenter="reds"),
        lambda: Resegmentation(reds, 5, segmenter="other reds"),
        lambda name: (image(name, 0), ids(name)[1]),
    ),
    "depth": Case(DepthError, SSIM, lambda name: tuple(drawn(name).uniform(1, 50, (2, 16, 24)))),
    "time": Case(
        lambda: WarpingError(circular=True),
        WarpingError,
        lambda name: (*pair(name), drawn(name).normal(size=(2, 16, 24))),
    ),
    "seam": Case(SeamRatio, SSIM, lambda name: (image(name, 0),)),
    "roll": Case(RollError, lambda: RollError(ids=True), lambda name: (*drawn(name).normal(size=(2, 3, 9)), 2)),
    "wasserstein": Case(
        lambda: SlicedWasserstein(seed=1), lambda: SlicedWasserstein(seed=1, same_places=True), pair
    ),
    "frechet": Case(
        lambda: FrechetDistance(features, name="FSD", extractor="one"),
        lambda: FrechetDistance(features, name="FSD", extractor="another"),
        pair,
    ),
}  # fmt: skip


@pytest.fixture(params=CASES, scope="module")
def case(request) -> Case:
    return CASES[request.param]


def counted(case: Case, names: list[str]) -> Any:
    metric = case.make()
    for name in names:
        metric.update(*case.given(name), name)
    return metric


@pytest.fixture(scope="module")
def whole(case) -> Any:
    return counted(case, FRAMES)


def test_shares_in_any_order_make_the_whole(case, whole):
    shares = [counted(case, names) for names in (FRAMES[5:2:-1], [FRAMES[6], FRAMES[0]], [], FRAMES[1:3])]
    first = shares[2]
    for share in (shares[1], shares[3], shares[0]):
        first += share
    assert len(first) == len(whole) == len(FRAMES)
    assert first.figures() == whole.figures()  # equal, not nearly
    assert first.compute() == whole.compute()
    assert not isnan(whole.compute())


def test_every_frame_counts(case, whole):
    assert counted(case, FRAMES[1:]).compute() != whole.compute()


def test_state_goes_through_a_file(case, whole):
    fresh = case.make()
    fresh.load_state(pickle.loads(pickle.dumps(whole.state())))
    assert fresh.figures() == whole.figures()
    fresh += counted(case, [])
    fresh.update(*case.given("new"), "new")
    assert len(fresh) == len(whole) + 1
    with pytest.raises(ValueError, match="a state of"):
        case.other().load_state(whole.state())


def test_a_frame_counts_once(case, whole):
    twice = counted(case, FRAMES[:2])
    with pytest.raises(ValueError, match=f"'{FRAMES[1]}' was (counted|taken in) twice"):
        twice.update(*case.given(FRAMES[1]), FRAMES[1])
    before = whole.figures()
    with pytest.raises(ValueError, match=f"'{FRAMES[0]}' was (counted|taken in) twice"):
        whole.merge(twice)
    assert whole.figures() == before


def test_only_what_counts_the_same_is_merged(case):
    with pytest.raises(ValueError, match="do not count the same"):
        case.make().merge(case.other())


def test_nothing_counted_is_not_a_number(case):
    assert isnan(case.make().compute())
    assert all(isnan(value) for value in case.make().figures().values())


def test_it_says_what_it_has_seen(case, whole):
    assert repr(whole).startswith(type(whole).__name__) and "7 " in repr(whole)


def test_frames_can_be_told_apart():
    metric = counted(CASES["ssim"], FRAMES)
    apart = {name: counted(CASES["ssim"], [name]).compute() for name in FRAMES}
    assert isinstance(metric, FrameMetric)
    assert metric.per_frame() == pytest.approx(apart)
    depth = counted(CASES["depth"], FRAMES[:2])
    assert isinstance(depth, FrameMetric)
    assert depth.per_frame("RMSE")[FRAMES[1]] == counted(CASES["depth"], [FRAMES[1]]).figures()["RMSE"]
