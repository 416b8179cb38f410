"""Times of points are found by most of them; odd ones move no point."""

from __future__ import annotations

import numpy as np
import pytest

from lidar2pano.formats.point_cloud import cloud_of_columns, point_times, seconds

COUNT = 2000
TURN_S = np.linspace(0, 0.1, COUNT)
PLACE = np.arange(COUNT)
EPOCH_S = 1.7e9


@pytest.mark.parametrize("every", [3, 50, COUNT])
@pytest.mark.parametrize("odd", [0.0, -1.0, np.nan, np.inf, 1e30])
@pytest.mark.parametrize("epoch_s", [0.0, EPOCH_S])
def test_an_odd_time_decides_nothing(every, odd, epoch_s):
    values = np.where(PLACE % every == 1, odd, epoch_s + TURN_S)
    time_s, stamp_s, count = seconds("time", values, None)
    assert time_s is not None and np.isfinite(time_s).all() and np.ptp(time_s) <= 0.11
    fine = PLACE % every != 1
    np.testing.assert_allclose(time_s[fine] - time_s[fine].min(), (TURN_S - TURN_S[fine].min())[fine], atol=1e-6)
    assert stamp_s == (pytest.approx(EPOCH_S, abs=1e-3) if epoch_s else None)
    assert count in (0, np.count_nonzero(~fine))


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6, 1e9])
@pytest.mark.parametrize("dtype", [np.float64, np.uint64])
def test_zeros_beside_times_since_1970_in_any_unit(unit, dtype):
    if unit == 1 and dtype is np.uint64:
        return
    values = np.where(PLACE % 50 == 0, 0, (EPOCH_S + TURN_S) * unit).astype(dtype)
    time_s, stamp_s, odd = seconds("timestamp", values, EPOCH_S - 0.05)
    assert time_s is not None and (stamp_s, odd) == (EPOCH_S - 0.05, COUNT // 50)
    np.testing.assert_allclose(time_s[PLACE % 50 > 0], (TURN_S + 0.05)[PLACE % 50 > 0], atol=1.1e-3)


def test_points_without_coordinates_have_no_say():
    valid = PLACE % 5 < 2
    time_s, _, odd = seconds("time", np.where(valid, EPOCH_S + TURN_S, 0.0), None, valid)
    assert time_s is not None and np.ptp(time_s) < 0.11 and odd == 0


def test_another_clock_gives_times_from_the_first():
    time_s, stamp_s, _ = seconds("gps_time", 345_678.0 + TURN_S, 5.0)
    assert time_s is not None and stamp_s == 5.0
    np.testing.assert_allclose(time_s, TURN_S, atol=1e-6)


def test_a_convention_of_nanoseconds_is_not_believed_of_microseconds():
    assert seconds("t", (TURN_S * 1e6).astype(np.uint32), None)[0][-1] == pytest.approx(0.1)
    assert seconds("t", (TURN_S * 1e9).astype(np.uint32), None)[0][-1] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("period", "unit", "dtype"),
    [
        (3600 * 10**6, 1e-6, np.uint32),  # Velodyne: microseconds of the hour
        (10**9, 1e-9, np.uint32),  # nanoseconds of the second
        (2**32, 1e-9, np.uint32),
        (604_800, 1.0, np.float64),  # GPS: seconds of the week
    ],
)
@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_clock_that_begins_again_amid_a_sweep(period, unit, dtype, share):
    values = ((period - share * 0.1 / unit + TURN_S / unit) % period).astype(dtype)
    time_s, _, odd = seconds("time", values, None)
    assert time_s is not None and odd == 0
    np.testing.assert_allclose(time_s - time_s[0], TURN_S, atol=1e-5)


@pytest.mark.parametrize(
    ("whole", "part", "unit"),
    [
        ("sec", "nsec", 1e-9),
        ("secs", "nsecs", 1e-9),
        ("timestamp_sec", "timestamp_nanosec", 1e-9),
        ("stamp.secs", "stamp.nsecs", 1e-9),
        ("tv_sec", "tv_usec", 1e-6),
        ("time_s", "time_us", 1e-6),
    ],
)
def test_seconds_and_the_rest_in_two_columns(whole, part, unit):
    times = EPOCH_S + 0.95 + TURN_S
    seconds_, rest = np.floor(times), (times % 1 / unit).round()
    columns = {axis: np.ones(COUNT) for axis in "xyz"} | {whole: seconds_, part: rest}
    cloud = cloud_of_columns(columns, format="", name="a")
    assert cloud.time_s is not None and cloud.stamp_s == pytest.approx(times[0], abs=1e-5) and not cloud.doubts
    np.testing.assert_allclose(cloud.time_s, TURN_S, atol=2e-6)


def test_two_columns_of_too_few_digits_are_no_time():
    columns = {axis: np.ones(COUNT, np.float32) for axis in "xyz"}
    columns |= {"sec": (EPOCH_S + TURN_S).astype(np.float32), "nsec": (TURN_S * 1e9).astype(np.float32)}
    assert cloud_of_columns(columns, format="", name="a").time_s is None


def test_what_is_no_time_is_passed_over_and_doubted():
    valid = np.ones(COUNT, bool)
    far = PLACE * 1e9
    time_s, _, doubts = point_times([("time", far)], None, valid)
    assert time_s is None and "field 'time' is no time of a sweep" in doubts[0]
    time_s, _, doubts = point_times([("time", far), ("t", TURN_S)], None, valid)
    assert time_s is not None and not doubts
    zeros = np.where(PLACE % 20 == 0, 0.0, EPOCH_S + TURN_S)
    assert "100 of its points have times more than a turn" in point_times([("time", zeros)], None, valid)[2][0]
