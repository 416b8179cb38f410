"""Times of points: their unit, their clock, and the points without a believable one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

NANOSECONDS = ("offset_ns", "offset_time", "t", "time_stamp")  # if stored as integers, by convention
EPOCH_S = 1e8  # times beyond this, in seconds, count from an epoch and not from the start of the sweep
UNITS = (1.0, 1e-3, 1e-6, 1e-9)  # seconds
LONGEST_S = 3.2  # of a sweep: 0.1 s times the root of 1000, half-way to the next unit
SHORTEST_S = 1e-3  # of a sweep in a unit by convention
TURN_S = 0.2  # of the slowest LiDARs, 5 Hz
HALVES = 3.0  # times the shortest half of the times, from its middle, is more than a turn: uniform times reach 1.5
STAMP_S = 60.0  # farther from the scan's stamp, times are of another clock
MOST_ODD = 0.01  # of the points may have no believable time without a word


def plain_name(name: str) -> str:
    """Return a field's name in lower case, without CloudCompare's "scalar_"."""
    return name.strip().lower().removeprefix("scalar_").strip()


def point_times(
    fields: Sequence[tuple[str, np.ndarray]], stamp_s: float | None, valid: np.ndarray
) -> tuple[np.ndarray | None, float | None, list[str]]:
    """Return times by the first usable one of the fields (name, values), the stamp, and doubts; see `seconds`."""
    doubts: list[str] = []
    for name, values in fields:
        time_s, start_s, odd = seconds(name, values, stamp_s, valid)
        if time_s is not None:
            share = odd / max(int(np.count_nonzero(valid)), 1)
            few = f"{odd} of its points have times more than a turn from the others; they are taken at mid-sweep"
            return time_s, start_s, [few] if share > MOST_ODD else []
        if odd:
            doubts = [f"field {name!r} is no time of a sweep in any unit; it is not used"]
    return None, stamp_s, doubts


def seconds(
    name: str, values: np.ndarray, stamp_s: float | None, valid: np.ndarray | None = None
) -> tuple[np.ndarray | None, float | None, int]:
    """Return times of points in seconds relative to a stamp, the stamp, and the number of points left out.

    valid  (N,) bool: points with coordinates; others have no say. None: all.
    A sweep in the unit lasts nearest to 0.1 s, or nanoseconds for integer fields of NANOSECONDS. A point more than a
    turn from the others gets the middle of the others. Times since an epoch become relative to `stamp_s`, or to the
    first one if there is none; those of another clock to the first one. The times are None if they are constant (0 are
    left out) or of no sweep (all are).
    """
    values = values.astype(values.dtype.newbyteorder("="), copy=False)
    usable = np.isfinite(values) if values.dtype.kind == "f" else np.ones(len(values), bool)
    valid = usable & valid if valid is not None and (usable & valid).any() else usable
    if not usable.any():
        return None, stamp_s, 0
    middle, spread = _shortest_half(np.sort(values[valid]))
    if not spread:
        return None, stamp_s, 0
    unit = _unit(name, values.dtype, spread)
    if unit is None:
        return None, stamp_s, len(values)
    near = usable & (np.abs(_differences(values, middle)) * unit <= max(HALVES * spread * unit, TURN_S))
    odd = int(np.count_nonzero(valid & ~near))
    values = np.where(near, values, middle)
    low = values[near & valid].min()
    low_s = float(low) * unit
    if abs(low_s) < LONGEST_S:
        return values.astype(np.float64) * unit, stamp_s, odd
    time_s = _differences(values, low) * unit
    if low_s >= EPOCH_S:
        if stamp_s is None or abs(low_s - stamp_s) > STAMP_S:
            return time_s, low_s, odd
        time_s += low_s - stamp_s
    return time_s, stamp_s, odd


def _differences(values: np.ndarray, origins: np.ndarray | np.generic) -> np.ndarray:
    """Return values minus origins, float64: exact for large integers, without overflow."""
    if values.dtype.kind == "f":
        with np.errstate(invalid="ignore", over="ignore"):
            return (values - origins).astype(np.float64)
    return np.where(values >= origins, (values - origins).astype(np.uint64), 0).astype(np.float64) - np.where(
        values < origins, (origins - values).astype(np.uint64), 0
    ).astype(np.float64)


def _shortest_half(values: np.ndarray) -> tuple[np.generic, float]:
    """Return the middle and the width of the shortest interval with most of the sorted values; 0 wide if all agree.

    Fewer than half of the values can be anything. A value of more than half of the points is no time, and left out.
    """
    half = len(values) // 2 + 1
    widths = _differences(values[half - 1 :], values[: len(values) - half + 1])
    start = int(np.argmin(widths))
    middle = values[start + half // 2]
    if not widths[start] and (remainder := values[values != middle]).size > 1:
        return _shortest_half(remainder)
    return middle, float(widths[start])


def _unit(name: str, dtype: np.dtype, spread: float) -> float | None:
    """Return the unit in seconds in which a sweep lasts nearest to 0.1 s; None if there is none."""
    if dtype.kind in "iu" and plain_name(name) in NANOSECONDS and SHORTEST_S <= 2 * spread * 1e-9 < LONGEST_S:
        return 1e-9
    return next((unit for unit in UNITS if 2 * spread * unit < LONGEST_S), None)
