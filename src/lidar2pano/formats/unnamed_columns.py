"""Columns without names: how many there are in rows of numbers, and their use: x y z, remission, ring or time."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from lidar2pano.formats.field_names import POSE

MOST_WIDE = 12  # columns of rows without a header
SAMPLE = 4000  # rows to tell columns by
FEWEST = 200  # rows; fewer decide nothing
FEWEST_NUMBERS = 1000  # to tell the width of rows by
# Nats; and of the most information by any width. Multiples of the true width give as much, or more if a column
# alternates (KITTI's raw remissions: it has 0.85 of theirs); half the true width gives 0.66 at most.
LEAST, NEARLY = 0.05, 0.75
BLOCK = 27_720  # numbers amid a file to tell its width by, whole rows of every width
MOST_CODES = 128
MOST_BLOCKS = 6  # columns stored one after the other (Oxford RobotCar has 4)
RANGE_SHARE, RANGE_ERROR = 0.95, 0.002  # of the rows have the range of x y z, so nearly
BEAMS_SHARE = 0.8  # of the elevations' variance is between rings: beams are cones
TURN_SHARE, SECTORS = 0.9, 72  # of the times' variance is between sectors of a turn
SORTED_SHARE, FEWEST_TIMES = 0.99, 100  # of the steps in a file are no step back; different times
SPREAD_M = 2.0  # between the 5th and 95th percentile of coordinates along the ground
MOST_RINGS = 256
SAME_ANGLE, ANGLE_ERROR = 0.999, 0.2  # mean of unit vectors of differences; of the elevations' deviation
LARGEST = 1e30  # numbers beyond are bytes of something else
FEWEST_POSES, ROTATION_ERROR = 10, 1e-3
MATRIX_STARTS = {12: 0, 13: 1, 16: 0, 17: 1}  # by the number of columns
NEAR_M = 2.0  # nearer points blur: a beam begins some centimetres from the sensor's origin


def row_width(values: np.ndarray) -> int:
    """Return how many numbers a row of points has, from the numbers (V,) of rows one after the other; 0 if unsure.

    Numbers of one column are alike. The smallest width whose columns say most about the sizes of their numbers
    (mutual information of the column and a number's sign, exponent and roundness) is that of the rows.
    """
    start = BLOCK * (len(values) // BLOCK // 2)
    sample = values[start : start + BLOCK]
    if len(sample) < FEWEST_NUMBERS:
        return 0
    code = _codes(sample)
    information = {width: _information(code, width) for width in range(1, MOST_WIDE + 1)}
    most = max(information.values())
    return next(width for width, told in information.items() if told >= NEARLY * most) if most > LEAST else 0


def _codes(values: np.ndarray) -> np.ndarray:
    """Return a small code of each number's sign, exponent and roundness."""
    with np.errstate(invalid="ignore", over="ignore"):
        bits = values.astype(np.float32).view(np.uint32)
    exponent = np.clip((bits >> 23 & 0xFF).astype(np.int64) - 112, 0, 31)
    return (exponent * 2 + (bits >> 31)) * 2 + (bits & 0xFFF == 0)


def block_count(values: np.ndarray) -> int:
    """Return how many columns numbers (V,) are that are stored one column after the other; 0 if unsure."""
    told = {}
    for count in range(3, MOST_BLOCKS + 1):
        if len(values) % count == 0 and len(values) >= FEWEST_NUMBERS:
            step = max(1, len(values) // BLOCK)
            sample = values.reshape(count, -1)[:, ::step].T.ravel()
            told[count] = _information(_codes(sample), count)
    most = max(told.values(), default=0.0)
    return min(count for count, nats in told.items() if nats >= NEARLY * most) if most > LEAST else 0


def _information(code: np.ndarray, width: int) -> float:
    """Return the mutual information of the codes of numbers and their columns, in nats, without chance's part.

    Chance gives (codes - 1) (columns - 1) / 2N (Miller 1955).
    """
    code = code[: len(code) // width * width]
    counts = np.bincount(code + MOST_CODES * (np.arange(len(code)) % width), minlength=MOST_CODES * width)
    joint = counts.reshape(width, MOST_CODES) / len(code)
    independent = np.broadcast_to(joint.sum(0) / width, joint.shape)
    held = joint > 0
    chance = (np.count_nonzero(joint.any(0)) - 1) * (width - 1) / (2 * len(code))
    return float((joint[held] * np.log(joint[held] / independent[held])).sum()) - chance


def column_names(table: np.ndarray) -> list[str]:
    """Return names for the columns of a table (N, C), C >= 3: x y z, then "column N" for those of unknown use.

    An intensity, colours, a ring, a time and the range of x y z are told; x y z are the first three columns unless the
    numbers contradict.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        sample = table[:: max(1, len(table) // SAMPLE)].astype(np.float64)
    sample[np.abs(sample) > LARGEST] = np.nan
    if _are_poses(sample):
        return [f"{POSE} {number}" for number in range(1, table.shape[1] + 1)]
    names = [f"column {number}" for number in range(1, table.shape[1] + 1)]
    if _is_spherical(sample):
        names[:3] = "range", "azimuth", "elevation"
        return [*names[:3], *(["intensity", *names[4:]] if len(names) > 3 else [])]
    axes, range_column = _axes(sample)
    for axis, name in zip(axes, "xyz", strict=True):
        names[axis] = name
    if range_column is not None:
        names[range_column] = "range"
    left = [column for column, name in enumerate(names) if name.startswith("column")]
    for column, name in _vectors(sample, left).items():
        names[column] = name
        left.remove(column)
    xyz = sample[:, axes]
    for column in [column for column in left if len(sample) >= FEWEST and _is_angle(sample[:, column], xyz)]:
        names[column] = "angle"
        left.remove(column)
    for name, tells in (("ring", _is_ring), ("time", _is_time)):
        told = next((column for column in left if len(sample) >= FEWEST and tells(sample[:, column], xyz)), None)
        if told is not None:
            names[told] = name
            left.remove(told)
    left = [column for column in left if np.ptp(_finite(np.diff(sample[:, column]))) > 0] or left[
        :1
    ]  # no constant, no index
    if left:
        names[left[0]] = "intensity"
    return names


def _are_poses(sample: np.ndarray) -> bool:
    """Return whether rows hold matrices of three rows and four columns, the first three of which are a rotation.

    KITTI has them alone, others behind a time or with a last row 0 0 0 1.
    """
    rows = sample[np.isfinite(sample).all(1)]
    if len(rows) < FEWEST_POSES or rows.shape[1] not in MATRIX_STARTS:
        return False
    start = MATRIX_STARTS[rows.shape[1]]
    rotation = rows[:, start : start + 12].reshape(-1, 3, 4)[:, :, :3]
    error = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
    return bool(np.mean(error < ROTATION_ERROR) > RANGE_SHARE)


def _axes(sample: np.ndarray) -> tuple[list[int], int | None]:
    """Return the columns of x, y and z, and the one of their range, None if there is none."""
    width = sample.shape[1]
    rows = sample[np.isfinite(sample).all(1)]
    rows = rows[rows.any(1)]
    if width > 3 and len(rows) >= FEWEST:
        squares = rows**2
        for axes in sorted(combinations(range(width), 3), key=lambda axes: axes[2] - axes[0]):
            range_m = np.sqrt(squares[:, axes].sum(1))
            for column in set(range(width)) - set(axes):
                near = np.abs(rows[:, column] - range_m) <= RANGE_ERROR * range_m
                if near.mean() >= RANGE_SHARE and all(np.ptp(rows[:, axis]) > 0 for axis in axes):
                    return list(axes), column
    if len(rows) >= FEWEST and not _is_coordinate(rows[:, 0]):
        for start in range(1, width - 2):
            if _is_coordinate(rows[:, start]) and _is_coordinate(rows[:, start + 1]):
                return [start, start + 1, start + 2], None
    return [0, 1, 2], None


def _is_spherical(sample: np.ndarray) -> bool:
    """Return whether the first columns are ranges, azimuths all around and elevations: x is nowhere behind then."""
    range_m, azimuth, elevation = sample[np.isfinite(sample[:, :3]).all(1), :3].T
    if len(range_m) < FEWEST or range_m.min() < 0 or not np.ptp(range_m) > SPREAD_M:
        return False
    for turn in (2 * np.pi, 360.0):
        counts = np.bincount((azimuth % turn * (SECTORS / turn)).astype(int) % SECTORS, minlength=SECTORS)
        in_turn = -turn / 2 <= azimuth.min() and np.ptp(azimuth) <= turn * 1.001 and azimuth.max() <= turn * 1.001
        if in_turn and np.count_nonzero(counts > len(azimuth) / (10 * SECTORS)) > TURN_SHARE * SECTORS:
            return bool(np.abs(elevation).max() <= turn / 4)
    return False


def _is_coordinate(values: np.ndarray) -> bool:
    """Return whether values can be x or y: widely spread, neither whole numbers nor positive and sorted ones."""
    low, high = np.percentile(values, (5, 95))
    counted = are_integers(values, np.inf) or (values[0] >= 0 and _is_sorted(values))
    return bool(high - low > SPREAD_M and not counted)


def are_integers(values: np.ndarray, end: float) -> bool:
    """Return whether the finite ones of values, at least one, are whole numbers from 0 on and below `end`."""
    values = _finite(values)
    return bool(((values >= 0) & (values < end) & (values == np.floor(values))).all())


def _is_sorted(values: np.ndarray) -> bool:
    return bool(np.mean(np.diff(values) >= 0) >= SORTED_SHARE)


def _is_ring(values: np.ndarray, xyz: np.ndarray) -> bool:
    """Return whether whole numbers are those of beams: points of one have elevations near to each other."""
    with np.errstate(invalid="ignore"):
        usable = np.isfinite(values) & (np.linalg.norm(xyz, axis=1) > NEAR_M)
    values, (x, y, z) = values[usable], xyz[usable].T
    if not len(values) or not are_integers(values, MOST_RINGS) or np.ptp(values) < 3:
        return False
    return share_between(values, np.arctan2(z, np.hypot(x, y))) > BEAMS_SHARE


def _is_angle(values: np.ndarray, xyz: np.ndarray) -> bool:
    """Return whether values are the azimuths, of any zero and direction, or the elevations of points."""
    usable = np.isfinite(values) & (np.linalg.norm(xyz, axis=1) > NEAR_M)
    values, (x, y, z) = values[usable], xyz[usable].T
    if not len(values):
        return False
    azimuth, elevation = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
    for unit in (1.0, np.pi / 180):
        angle = values * unit
        if (
            np.ptp(angle) > np.pi
            and max(abs(np.exp(1j * (angle + sign * azimuth)).mean()) for sign in (1, -1)) > SAME_ANGLE
        ):
            return True
        if np.abs(angle - elevation).mean() < ANGLE_ERROR * np.std(elevation):
            return True
    return False


def _vectors(sample: np.ndarray, columns: list[int]) -> dict[int, str]:
    """Return the names of three columns of colours, or of normals: vectors of length 1, not all the same."""
    if len(columns) == len("rgb") and all(are_integers(sample[:, column], MOST_RINGS) for column in columns):
        return dict(zip(columns, ("red", "green", "blue"), strict=True))
    for start in range(len(columns) - 2 if len(sample) >= FEWEST else 0):
        three = columns[start : start + 3]
        near = np.abs(np.linalg.norm(sample[:, three], axis=1) - 1) <= RANGE_ERROR
        if near.mean() >= RANGE_SHARE and np.ptp(_finite(sample[:, three[2]])) > 0:
            return dict(zip(three, ("nx", "ny", "nz"), strict=True))
    return {}


def _is_time(values: np.ndarray, xyz: np.ndarray) -> bool:
    """Return whether values are times: many different ones, in order in the file or around the sensor."""
    usable = np.isfinite(values) & np.isfinite(xyz).all(1)
    values, (x, y, _) = values[usable], xyz[usable].T
    if len(np.unique(values)) < FEWEST_TIMES or not np.ptp(np.diff(values)):  # an index has equal steps
        return False
    sector = np.floor((np.arctan2(y, x) / np.pi + 1) * (SECTORS / 2))
    return _is_sorted(values) or share_between(sector, values) > TURN_SHARE


def share_between(group: np.ndarray, values: np.ndarray) -> float:
    """Return the share of the variance of values (N,) between groups (N,) of numbers, without chance's part.

    The adjusted coefficient of determination: many groups of few values share much by chance.
    """
    _, number, counts = np.unique(group, return_inverse=True, return_counts=True)
    if len(counts) >= len(values):
        return 0.0
    means = np.bincount(number, values) / counts
    within = float(np.var(values - means[number]) / max(np.var(values), 1e-30))
    return 1 - within * (len(values) - 1) / (len(values) - len(counts))


def _finite(values: np.ndarray) -> np.ndarray:
    values = values[np.isfinite(values)]
    return values if len(values) else np.zeros(1)
