"""The confusion matrix: tables worked by hand, the recorded one, and a slow count."""

from __future__ import annotations

import json
from math import isnan, nan

import numpy as np
import pytest
import torch

from golden_vectors import facts
from golden_vectors import recorded as recorded_tensors
from lidar2pano.labels import COMMON14, COMMON15
from lidar2pano.metrics.confusion import MeanIoU
from slow_definitions import confusion_slowly


def counted(predicted, target, classes=3, **settings) -> MeanIoU:
    metric = MeanIoU(classes, **settings)
    metric.update(torch.as_tensor(predicted), torch.as_tensor(target), "frame")
    return metric


@pytest.mark.parametrize(
    ("predicted", "target", "unscored", "iou", "accuracy"),
    [
        ([0, 0, 1, 1], [0, 0, 1, 1], (), [1.0, 1.0, nan], 1.0),
        ([0, 1, 1, 1], [0, 0, 1, 1], (), [1 / 2, 2 / 3, nan], 3 / 4),
        ([2, 2], [0, 255], (), [0.0, nan, 0.0], 0.0),
        ([2, 2, 1], [0, -1, 1], (), [0.0, 1.0, 0.0], 1 / 2),
        # class 0 of the target is not scored (first pixel), a prediction of 0 is a miss (second)
        ([1, 0, 1, 2], [0, 1, 1, 2], (0,), [nan, 1 / 2, 1.0], 2 / 3),
        ([1, 0, 1, 2], [0, 1, 1, 2], (), [0.0, 1 / 3, 1.0], 1 / 2),
        ([0, 0, 0, 0], [0, 0, 1, 2], (0, 2), [nan, 0.0, nan], 0.0),
        # where nothing is scored any prediction will do
        ([99, -1, 1], [255, 0, 1], (0,), [nan, 1.0, nan], 1.0),
    ],
)
def test_confusion_worked_by_hand(predicted, target, unscored, iou, accuracy):
    confusion = counted(predicted, target, unscored=unscored)
    assert confusion.ious().tolist() == pytest.approx(iou, nan_ok=True)
    assert confusion.values()["accuracy"] == pytest.approx(accuracy)
    assert confusion.compute() == pytest.approx(float(np.nanmean(iou)))


def test_miou_says_over_which_classes():
    confusion = counted([0, 1, 1, 1], [0, 0, 1, 1])  # 1/2, 2/3, neither side named it
    assert confusion.compute() == pytest.approx((1 / 2 + 2 / 3) / 2)
    assert confusion.averaged_over([1]).compute() == pytest.approx(2 / 3)
    assert confusion.averaged_over((1, 2)).compute() == pytest.approx(2 / 3)
    assert isnan(confusion.averaged_over([2]).compute())


def test_nothing_scored_is_not_a_number():
    confusion = counted([1, 2], [255, 0], unscored=(0,))
    assert all(isnan(value) for value in confusion.values().values())
    assert np.isnan(confusion.ious()).all()


def test_rows_are_targets():
    assert counted([1, 1, 2], [0, 0, 2]).counts().tolist() == [[0, 2, 0], [0, 0, 0], [0, 0, 1]]


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.int32, torch.int64])
@pytest.mark.parametrize("unscored", [(), (0, 15)])
def test_confusion_agrees_with_a_slow_count(dtype, unscored):
    predicted = torch.randint(16, (2, 25, 40)).to(dtype)
    target = torch.randint(20, (2, 25, 40)).to(dtype)  # 16 .. 19 are no classes
    confusion = MeanIoU(COMMON15, unscored=unscored)
    confusion.update(predicted[0], target[0], "a")
    confusion.update(predicted[1].numpy(), target[1].numpy(), "b")
    assert confusion.counts().tolist() == confusion_slowly(predicted, target, 16, unscored)


def test_table_names_every_scored_class():
    confusion = counted([1, 0, 1, 2, 1], [0, 1, 1, 1, 2], COMMON14, unscored=(0,))
    rows = json.loads(json.dumps(confusion.table(), allow_nan=False))
    assert [row["class"] for row in rows] == list(COMMON14.classes[1:])
    assert rows[0] == {"class": "car", "iou": 1 / 4, "precision": 1 / 2, "recall": 1 / 3, "pixels": 3}
    assert rows[1] == {"class": "bicycle", "iou": 0.0, "precision": 0.0, "recall": 0.0, "pixels": 1}
    assert rows[2] == {"class": "motorcycle", "iou": None, "precision": None, "recall": None, "pixels": 0}


@pytest.mark.parametrize(
    ("predicted", "target", "complaint"),
    [
        ([0, 1], [0], "differ in shape"),
        ([0.5, 1.0], [0, 1], "argmax"),
        ([0, 7], [0, 1], r"7 is outside \[0, 3\)"),
        ([0, -1], [0, 1], r"-1 is outside \[0, 3\)"),
    ],
)
def test_what_cannot_be_counted_is_refused(predicted, target, complaint):
    with pytest.raises(ValueError, match=complaint):
        counted(predicted, target)


# --- the published evaluator ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded(golden) -> dict:
    tensors = recorded_tensors(golden, "ioueval")
    return facts(golden, "ioueval") | {name: tensor.values for name, tensor in tensors.items()}


def published_iou(counts: np.ndarray, ignored: list[int]) -> np.ndarray:
    """IoU as the published evaluator has it: rows and columns of ignored classes are emptied."""
    counts = counts.copy()
    counts[ignored] = counts[:, ignored] = 0
    hit = counts.diagonal()
    return hit / (counts.sum(0) + counts.sum(1) - hit + 1e-15)


def test_the_published_miou_is_a_value_of_its_own():
    generator = np.random.default_rng(0)
    metric, everything = MeanIoU(4, unscored=(0,)), MeanIoU(4)
    for name in "ab":
        predicted, target = generator.integers(0, 4, (2, 5, 6))
        metric.update(predicted, target, name)
        everything.update(predicted, target, name)
    values = metric.values()
    assert values["published mIoU"] == pytest.approx(float(published_iou(everything.counts(), [0])[1:].mean()))
    assert values["published mIoU"] > values["mIoU"]


@pytest.mark.parity
def test_counts_equal_the_recorded_ones(recorded):
    confusion = counted(recorded["pred"], recorded["gt"], COMMON14)
    assert np.array_equal(confusion.counts(), recorded["conf"].T.numpy())  # theirs has a row per prediction
    assert confusion.ious().tolist() == pytest.approx(recorded["noignore"]["iou"], abs=1e-12)
    assert confusion.compute() == pytest.approx(recorded["noignore"]["miou"], abs=1e-12)


@pytest.mark.parity
def test_published_miou_follows_from_our_counts_and_is_flattered(recorded):
    everything = counted(recorded["pred"], recorded["gt"], COMMON14)
    theirs = published_iou(everything.counts(), [0])
    assert theirs.tolist() == pytest.approx(recorded["ignore0"]["iou"], abs=1e-12)
    assert float(theirs[1:].mean()) == pytest.approx(recorded["ignore0"]["miou"], abs=1e-12)
    # a pixel that should be something and was called nothing is an error for us, not for them
    ours = counted(recorded["pred"], recorded["gt"], COMMON14, unscored=(0,))
    named_nothing = everything.counts()[1:, 0].sum()
    assert named_nothing > 0
    assert ours.counts().sum() == everything.counts()[1:].sum()
    assert (ours.ious()[1:] < theirs[1:]).all()
    assert ours.compute() < recorded["ignore0"]["miou"] - 0.005
    assert ours.values()["accuracy"] < recorded["ignore0"]["acc"]


@pytest.mark.parity
def test_published_miou_counts_an_absent_class_as_zero(recorded):
    predicted, target = (ids.long().where(ids != 5, 6) for ids in (recorded["pred"], recorded["gt"]))
    everything = counted(predicted, target, COMMON14)
    theirs = published_iou(everything.counts(), [0])
    assert theirs.tolist() == pytest.approx(recorded["absent_class5_counts_as_zero"]["iou"], abs=1e-12)
    assert float(theirs[1:].mean()) == pytest.approx(recorded["absent_class5_counts_as_zero"]["miou"], abs=1e-12)
    assert isnan(everything.ious()[5])
    assert everything.compute() == pytest.approx(float(everything.ious()[everything.ious() > 0].mean()))
