"""Metrics of an image against another, or against itself: by hand, by slow definitions, by other libraries."""

from __future__ import annotations

from math import isnan

import numpy as np
import pytest
import torch
from PIL import Image

from lidar2pano.labels import COMMON14
from lidar2pano.metrics.confusion import MeanIoU
from lidar2pano.metrics.frame_metrics import (
    SSIM,
    DepthError,
    FeatureDistance,
    RollError,
    SeamRatio,
    WarpingError,
    ssim_map,
)
from metric_definitions import depth_slowly, scikit_ssim, seam_slowly, torchmetrics_ssim, warping_slowly


def smooth(seed: int, rows: int = 60, columns: int = 90) -> np.ndarray:
    """A made-up picture with large and small shapes, up to black and white."""
    generator = np.random.default_rng(seed)
    layers = [
        np.asarray(
            Image.fromarray(generator.integers(0, 256, (size, size, 3), dtype=np.uint8)).resize((columns, rows)), float
        )
        for size in (3, 9, 40)
    ]
    return np.clip(1.6 * np.mean(layers, axis=0) - 60, 0, 255).astype(np.uint8)


def of(metric, *inputs, **settings):
    metric.update(*inputs, "frame", **settings)
    return metric


# --- SSIM -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(60, 90), (11, 11), (139, 12), (75, 64)])  # 139 - 10: more than two strips
@pytest.mark.parametrize("change", ["another", "noisy", "bright", "saturated"])
def test_ssim_agrees_with_scikit_image_and_torchmetrics(size, change):
    target = smooth(1, *size)
    noise = np.random.default_rng(2).normal(0, 20, target.shape)
    predicted = {
        "another": smooth(3, *size),
        "noisy": np.clip(target + noise, 0, 255).astype(np.uint8),
        "bright": np.clip(target // 16 + 235, 0, 255).astype(np.uint8),  # nearly flat: where float32 is weakest
        "saturated": np.full_like(target, 255),
    }[change]
    ours = of(SSIM(), predicted, target).compute()
    assert ours == pytest.approx(scikit_ssim(predicted, target), abs=2e-6)
    assert ours == pytest.approx(torchmetrics_ssim(predicted, target)[0], abs=2e-6)


@pytest.mark.parametrize("size", [(60, 90), (58, 87)])  # the second is no multiple of a place's four pixels
def test_feature_distance_is_that_of_unit_vectors_at_known_places(size):
    """Place by place: only features all of whose pixels are known; a frame without any does not count."""
    predicted, target = smooth(1, *size), smooth(2, *size)
    valid = np.ones(size, bool)
    valid[10, 20], valid[-1, -1] = False, False
    rows, columns = (-(-length // 4) for length in size)
    expected = []
    for row in range(rows):
        for column in range(columns):
            if valid[4 * row : 4 * row + 4, 4 * column : 4 * column + 4].all():
                first, second = (image[4 * row, 4 * column].astype(float) + 1 for image in (predicted, target))
                cosine = first @ second / np.sqrt((first @ first) * (second @ second))
                expected.append(2 - 2 * cosine)
    assert len(expected) == rows * columns - 2
    metric = FeatureDistance(lambda images: images[:, :, ::4, ::4].float() + 1, 4)
    metric.update(predicted, target, "frame", valid=valid)
    assert metric.compute() == pytest.approx(np.mean(expected), abs=1e-6)
    metric.update(predicted, target, "hidden", valid=np.zeros(size, bool))
    assert metric.compute() == pytest.approx(np.mean(expected), abs=1e-6)
    assert of(FeatureDistance(metric.extract, 4), target, target).compute() < 1e-12


def test_ssim_map_is_the_inner_part_of_scikit_images():
    first, second = smooth(1), smooth(2)
    theirs = scikit_ssim(first, second, full=True)[5:-5, 5:-5].mean(2)
    assert ssim_map(first, second).shape == theirs.shape
    assert np.abs(ssim_map(first, second).numpy() - theirs).max() < 1e-5


def test_ssim_of_equals_is_one_and_of_flat_images_worked_by_hand():
    assert of(SSIM(), smooth(1), smooth(1)).compute() == pytest.approx(1, abs=1e-6)
    dark, light = (np.full((20, 20, 3), value, dtype=np.uint8) for value in (50, 200))
    by_hand = (2 * 50 * 200 + 2.55**2) / (50**2 + 200**2 + 2.55**2)
    assert of(SSIM(), dark, light).compute() == pytest.approx(by_hand, abs=1e-6)


def test_ssim_is_the_mean_over_frames():
    metric = SSIM()
    metric.update(smooth(1), smooth(1), "a")
    metric.update(smooth(1, 20, 30), smooth(2, 20, 30), "b")  # a smaller one counts as much
    assert metric.compute() == pytest.approx((1 + scikit_ssim(smooth(1, 20, 30), smooth(2, 20, 30))) / 2, abs=1e-6)
    assert metric.value_of_frame("a", "SSIM") == pytest.approx(1, abs=1e-6)


def test_ssim_counts_windows_that_are_wholly_valid():
    first, second = smooth(1), smooth(2)
    valid = np.ones((60, 90), dtype=bool)
    valid[:, 70:] = False
    spoiled = second.copy()
    spoiled[:, 70:] = 0
    masked = of(SSIM(), first, spoiled, valid=valid).compute()
    assert masked == pytest.approx(scikit_ssim(first[:, :70], second[:, :70]), abs=2e-6)
    assert isnan(of(SSIM(), first, second, valid=np.zeros((60, 90), dtype=bool)).compute())


def test_ssim_takes_tensors_and_arrays_that_may_not_be_written_to():
    first, second = smooth(1), smooth(2)
    frozen = np.asarray(Image.fromarray(first))
    frozen.setflags(write=False)
    assert of(SSIM(), frozen, torch.from_numpy(second)).compute() == of(SSIM(), first, second).compute()
    turned = of(SSIM(), first[::-1], second[::-1]).compute()
    assert turned == pytest.approx(of(SSIM(), first, second).compute(), abs=1e-6)


@pytest.mark.parametrize(
    ("predicted", "target", "complaint"),
    [
        (np.zeros((20, 20, 3)), np.zeros((20, 20, 3), np.uint8), "uint8"),
        (np.zeros((20, 20), np.uint8), np.zeros((20, 20), np.uint8), r"\(H, W, 3\)"),
        (np.zeros((20, 20, 3), np.uint8), np.zeros((20, 21, 3), np.uint8), "differ in shape"),
        (np.zeros((20, 10, 3), np.uint8), np.zeros((20, 10, 3), np.uint8), "smaller than the window"),
        (np.zeros((0, 10, 3), np.uint8), np.zeros((0, 10, 3), np.uint8), r"\(H, W, 3\)"),
    ],
)
def test_ssim_refuses_what_is_no_pair_of_images(predicted, target, complaint):
    with pytest.raises(ValueError, match=complaint):
        SSIM().update(predicted, target, "frame")


@pytest.mark.parametrize("valid", [np.ones((20, 20)), np.ones((20, 19), bool)])
def test_masks_of_another_type_are_refused(valid):
    pair = smooth(1, 20, 20), smooth(2, 20, 20)
    with pytest.raises(ValueError, match="valid must be"):
        SSIM().update(*pair, "frame", valid=valid)


# --- classes --------------------------------------------------------------------------------------------------------


def test_class_counts_are_those_of_all_frames_in_one():
    whole, frames = MeanIoU(COMMON14, unscored=(0,)), MeanIoU(COMMON14, unscored=(0,))
    predicted, target = torch.randint(15, (4, 20, 30)), torch.randint(14, (4, 20, 30))
    target = torch.where(torch.rand(4, 20, 30) < 0.5, predicted, target)
    whole.update(predicted, target, "all")
    for number in range(4):
        frames.update(predicted[number], target[number], str(number))
    assert np.array_equal(frames.counts(), whole.counts())
    assert frames.table() == whole.table()
    assert frames.values() == whole.values()
    assert frames.averaged_over((1, 2, 7)).compute() == pytest.approx(whole.ious()[[1, 2, 7]].mean(), abs=1e-12)


def test_class_counts_of_a_frame_are_over_the_classes_it_has():
    counts = MeanIoU(3)
    counts.update(np.array([0, 0, 1, 1]), np.array([0, 0, 1, 1]), "a")
    counts.update(np.array([2, 1]), np.array([2, 2]), "b")
    assert [counts.value_of_frame(name, "mIoU") for name in "ab"] == [1.0, pytest.approx(1 / 4)]
    assert isnan(counts.value_of_frame("c", "mIoU"))
    assert counts.compute() == pytest.approx((1 + 2 / 3 + 1 / 2) / 3)


# --- depth ----------------------------------------------------------------------------------------------------------


def depths(seed: int) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    target = generator.uniform(1, 80, (9, 14)).astype(np.float32)
    predicted = (target * generator.uniform(0.6, 1.5, target.shape)).astype(np.float32)
    target[generator.random(target.shape) < 0.3] = 0
    predicted[generator.random(target.shape) < 0.1] = 0
    return predicted, target


def test_depth_errors_agree_with_their_definition():
    metric, pairs = DepthError(), [depths(seed) for seed in range(3)]
    for number, pair in enumerate(pairs):
        metric.update(*pair, str(number))
    assert metric.values() == pytest.approx(depth_slowly(*zip(*pairs, strict=True)), rel=1e-12)


def test_depth_errors_worked_by_hand():
    metric = of(DepthError(), np.array([[8.0, 10.0, 13.0, 5.0]]), np.array([[10.0, 10.0, 10.0, 0.0]]))
    squares = (4 + 0 + 9) / 3
    assert metric.values() == pytest.approx({"AbsRel": 0.5 / 3, "RMSE": squares**0.5, "delta1": 1 / 3})  # 8 is 1.25
    exact = of(DepthError(), np.full((2, 2), 7.0), np.full((2, 2), 7.0))
    assert exact.values() == {"AbsRel": 0, "RMSE": 0, "delta1": 1}


def test_depth_is_scored_where_it_is_measured():
    predicted, target = depths(1)
    predicted[target == 0] = np.nan  # what is not scored may be anything
    slow = depth_slowly([predicted[target > 0]], [target[target > 0]])
    assert of(DepthError(), predicted, target).values() == pytest.approx(slow, rel=1e-12)
    assert all(isnan(value) for value in of(DepthError(), predicted, 0 * target).values().values())


def test_depths_that_are_no_numbers_or_of_another_shape_are_refused():
    flat = np.ones((2, 3))
    for predicted, target, complaint in (
        (np.where(flat > 0, np.nan, 0), flat, "is not finite"),
        (flat, flat * np.nan, "target depth"),
        (flat * np.inf, flat, "is not finite"),
        (flat, flat[:1], "differ in shape"),
    ):
        with pytest.raises(ValueError, match=complaint):
            DepthError().update(predicted, target, "frame")


# --- time -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("circular", [False, True])
def test_warping_error_agrees_with_its_definition(circular):
    before, now = smooth(1, 12, 17), smooth(2, 12, 17)
    generator = np.random.default_rng(0)
    flow = generator.normal(0, 5, (2, 12, 17))
    valid = generator.random((12, 17)) < 0.7
    flow[:, ~valid] = np.nan
    metric = of(WarpingError(circular=circular), before, now, flow, valid=valid)
    slow = warping_slowly(before, now, flow, valid, circular)
    assert metric.compute() == pytest.approx(slow, rel=1e-12)


def test_a_moved_image_has_no_warping_error():
    before = smooth(1, 12, 40)
    now = np.roll(before, 3, axis=1)  # what was at column j is now at j + 3
    back = np.zeros((2, 12, 40))
    back[0] = -3
    assert of(WarpingError(circular=True), before, now, back).compute() == pytest.approx(0, abs=1e-12)
    assert of(WarpingError(circular=True), before, now, -back).compute() > 1e-3
    open_ended = of(WarpingError(), before, now, back)
    assert open_ended.compute() == pytest.approx(0, abs=1e-12)
    assert open_ended.sums()[0, 1] == 12 * 37  # the rest came in from outside


def test_warping_error_worked_by_hand():
    before, now = np.zeros((1, 2, 3), np.uint8), np.zeros((1, 2, 3), np.uint8)
    now[0, 1] = 51, 0, 102  # a fifth and two fifths of 255
    still = np.zeros((2, 1, 2))
    assert of(WarpingError(), before, now, still).compute() == pytest.approx((0.2**2 + 0.4**2) / 2)
    assert isnan(of(WarpingError(), before, now, still + 9).compute())  # none of it was visible


@pytest.mark.parametrize(
    ("flow", "complaint"),
    [
        (np.zeros((2, 5, 6)), "flow must be"),
        (np.zeros((12, 17, 2)), "flow must be"),
        (np.zeros((2, 12, 17), int), "flow must be"),
        (np.full((2, 12, 17), np.nan), "NaN or infinite"),
    ],
)
def test_flows_that_cannot_be_are_refused(flow, complaint):
    with pytest.raises(ValueError, match=complaint):
        WarpingError().update(smooth(1, 12, 17), smooth(2, 12, 17), flow, "frame")


# --- seams and turns ------------------------------------------------------------------------------------------------


def test_seam_ratio_agrees_with_its_definition():
    panorama = smooth(1, 8, 25)
    values = of(SeamRatio(), panorama).values()
    assert values["seam ratio"] == pytest.approx(seam_slowly(panorama), rel=1e-12)
    assert values["seam ratio nearby"] == pytest.approx(seam_slowly(panorama, near=8), rel=1e-12)
    assert values["seam ratio"] != values["seam ratio nearby"]


@pytest.mark.parametrize("columns", [2, 3, 9, 10, 16, 17, 18])
def test_steps_near_the_seam_count_once_in_narrow_images(columns: int):
    panorama = smooth(1, 8, columns)
    expected = seam_slowly(panorama, near=8)
    assert of(SeamRatio(), panorama).values()["seam ratio nearby"] == pytest.approx(expected, rel=1e-12)


def test_only_the_seam_itself_moves_the_ratio_to_what_is_nearby():
    busy = np.random.default_rng(0).integers(0, 256, (2000, 40, 3)).astype(np.uint8)  # stands behind a still place
    still = np.random.default_rng(1).integers(0, 9, (2000, 200, 3)).astype(np.uint8)
    values = of(SeamRatio(), np.roll(np.concatenate([still, busy], 1), 20, axis=1)).values()
    assert values["seam ratio"] > 3 and values["seam ratio nearby"] == pytest.approx(1, abs=0.05)


def test_a_circular_image_has_a_seam_ratio_of_one():
    around = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    wave = np.rint(127 + 120 * np.sin(around[None, :, None] + np.arange(3))).astype(np.uint8).repeat(4, axis=0)
    ratios = [of(SeamRatio(), np.roll(wave, turn, axis=1)).compute() for turn in range(0, 720, 9)]
    assert np.mean(ratios) == pytest.approx(1, abs=0.05)
    cut = wave[:, :360]
    assert of(SeamRatio(), cut).compute() > 50
    assert isnan(of(SeamRatio(), np.zeros((2, 5, 3), np.uint8)).compute())
    with pytest.raises(ValueError, match="one column"):
        SeamRatio().update(np.zeros((2, 1, 3), np.uint8), "frame")


def test_roll_error_of_what_knows_no_direction_and_of_what_does():
    x = torch.rand(3, 6, 20)
    metric = RollError()
    metric.update(2 * x, 2 * x.roll(7, -1), 7, "even")
    assert metric.compute() == 0
    tilt = torch.linspace(0, 1, 20)
    metric.update(x + tilt, x.roll(7, -1) + tilt, 7, "tilted")
    assert metric.value_of_frame("tilted", "roll error") == pytest.approx(
        float((tilt - tilt.roll(7)).abs().mean()), rel=1e-5
    )
    ids = RollError(ids=True)
    ids.update(np.array([[0, 5, 2, 3]]), np.array([[3, 0, 9, 2]]), 1, "one of four")
    assert ids.compute() == 1 / 4


@pytest.mark.parametrize(
    ("answer", "turned", "complaint"),
    [
        (torch.zeros(2, 3), torch.zeros(2, 4), "differ in shape"),
        (torch.zeros(3), torch.full((3,), torch.nan), "not finite"),
    ],
)
def test_answers_that_cannot_be_compared_are_refused(answer, turned, complaint):
    with pytest.raises(ValueError, match=complaint):
        RollError().update(answer, turned, 1, "frame")
