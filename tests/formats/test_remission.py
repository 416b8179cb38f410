"""The scale of remission is that of most valid points; single odd values are limited, replaced and counted."""

from __future__ import annotations

import numpy as np
import pytest

import sample_files as made
from lidar2pano.formats.interpretation import STAND_IN, Scale, scale_remission

COUNT = 12_000
FORMS = made.remission(COUNT)
PLACE = np.arange(COUNT)
ALL = np.ones(COUNT, bool)


def odd(values: np.ndarray, every: int, value: float) -> np.ndarray:
    """The values, each so many replaced by another; `every` of COUNT is a single one."""
    return np.where(PLACE % every == 5, value, values).astype(values.dtype)


ODD = {
    "one 1.2": (odd(FORMS, COUNT, 1.2), "0-1", FORMS),
    "one 300": (odd(FORMS, COUNT, 300), "0-1", FORMS),
    "spikes": (odd(FORMS, 1000, 30_000), "0-1", FORMS),
    "one NaN": (odd(FORMS, COUNT, np.nan), "0-1", FORMS),
    "one infinite": (odd(FORMS, COUNT, np.inf), "0-1", FORMS),
    "one -infinite": (odd(FORMS, COUNT, -np.inf), "0-1", FORMS),
    "one negative": (odd(FORMS, COUNT, -3), "0-1", FORMS),
    "few negative": (np.where(PLACE % 200 == 5, -0.1 * (PLACE % 7 + 1), FORMS), "0-1", FORMS),
    "8 bit, spikes": (odd(np.floor(FORMS * 255), 500, 49_664), "0-255", FORMS),
    "16 bit, spikes": (odd(np.floor(FORMS * 65_000), 500, 1e9), "0-65535", FORMS * 65_000 / 65_535),
    "uint16 of 8 bit": (odd((FORMS * 255).astype(np.uint16), 500, 65_535), "0-255", FORMS),
    "int8 for uint8": ((FORMS * 255).astype(np.uint8).view(np.int8), "0-255", FORMS),
}


@pytest.mark.parametrize("name", ODD)
def test_an_odd_value_decides_nothing(name):
    intensity, scale, expected = ODD[name]
    found = scale_remission(intensity, ALL, "", None)
    assert found.scale.name == scale and not found.doubts
    assert np.isfinite(found.values).all() and found.values.min() >= 0 and found.values.max() <= 1
    near = np.abs(found.values - expected) < 0.005
    assert np.mean(near) > 0.99
    assert found.odd >= np.count_nonzero(~near) and (found.odd == 0) == ("int8" in name)
    assert found.odd == 1 or "one" not in name


def test_points_without_coordinates_have_no_say():
    valid = PLACE % 3 > 0
    found = scale_remission(np.where(valid, FORMS, 255.0), valid, "", None)
    assert found.scale.name == "0-1" and not found.odd and found.values.max() <= 1


def test_a_value_that_marks_missing_remissions_gives_the_stand_in():
    found = scale_remission(odd(FORMS, 10, -1), ALL, "", None)
    assert found.scale.name == "0-1" and (found.values[PLACE % 10 == 5] == np.float32(STAND_IN)).all()
    assert found.odd == COUNT // 10 and "10% of its points have no valid remission" in found.doubts[0]


def test_remissions_below_zero_are_doubted():
    found = scale_remission(40 * FORMS - 40, ALL, "", None)
    assert found.scale.name == "min-max" and "leave them out with --remission none" in found.doubts[0]


def test_many_beyond_the_scale_are_doubted():
    found = scale_remission(odd(FORMS, 20, 3), ALL, "", None)
    assert found.scale.name == "0-1" and "5% of its remissions are above 1" in found.doubts[0]


@pytest.mark.parametrize("values", [np.zeros(COUNT), np.full(COUNT, np.nan), odd(np.zeros(COUNT), COUNT, 255)])
def test_a_constant_but_for_one_is_none(values):
    found = scale_remission(values, ALL, "", None)
    assert found.scale == Scale("none") and (found.values == np.float32(STAND_IN)).all()


@pytest.mark.parametrize("named", ["1", "255", "65535"])
def test_a_named_scale_limits_too(named):
    found = scale_remission(odd(FORMS * float(named), 1000, 1e30), ALL, named, None)
    assert found.values.max() == 1 and not found.doubts and found.odd == COUNT // 1000
    np.testing.assert_allclose(found.values[PLACE % 1000 != 5], FORMS[PLACE % 1000 != 5], rtol=1e-5)


@pytest.mark.parametrize(
    ("intensity", "named", "first", "says"),
    [
        (FORMS, "255", None, "do not reach a hundredth of 255, full by --remission"),
        (FORMS * 255, "1", None, "most of its points have full remission"),
        (FORMS, "", Scale("0-255", 255.0), "do not reach a hundredth of 255, full by the first scan"),
        (FORMS * 255, "", Scale("0-1", 1.0), "most of its points have full remission"),
        (FORMS * 0, "", Scale("0-1", 1.0), "say nothing, unlike the first scan's"),
        (FORMS, "", Scale("none"), "differ from point to point, unlike the first scan's"),
    ],
)
def test_what_contradicts_a_scale_is_doubted(intensity, named, first, says):
    assert says in scale_remission(intensity, ALL, named, first).doubts[0]
