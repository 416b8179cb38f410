"""Remission: the scale of a file's intensities, by percentiles of valid points, and the values in [0, 1]."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

STAND_IN = 0.25  # remission of all points if there is none: costs least, see runs/remission_stand_in.py
SCALES = (1.0, 255.0, 65535.0)
SAMPLE = 40_000  # values to find the scale by
FEWEST = 1000  # valid values; fewer may be constant by chance
FULL_SHARE = 1 / 16  # the 99th percentile of 16 bit remissions is not below this share of the scale
# Tolerated shares of values beyond a scale. Of values up to 255 most are above 1; those of 16 bits have their
# 99th percentile to fall back on.
MOST_ABOVE_ONE, MOST_ABOVE = 0.25, 0.01
TAILS = (0.1, 99.9)  # percentiles; values without a difference between them are constant
EDGES = (0.5, 99.5)  # percentiles; they become 0 and 1 if many values are negative
MARKED = 0.99  # of the negative values are one and the same: it marks missing ones
MOST_FULL = 0.5  # of the remissions are full
LEAST_FILLED = 0.01  # of a scale from another source, by the values' 99th percentile
BELOW_ZERO = "its remissions reach below zero, and are scaled by percentiles; leave them out with --remission none"
NONE, MIN_MAX, PERCENTILE = "none", "min-max", "0-99th percentile"


class Scale(NamedTuple):
    """The scale of remission: its name, the value of full remission (None if there is none), and the value of zero."""

    name: str
    full: float | None = None
    zero: float = 0.0


class Remission(NamedTuple):
    """Remission (N,) float32 in [0, 1]; its scale; how many values were limited or replaced; doubts."""

    values: np.ndarray
    scale: Scale
    odd: int
    doubts: list[str]


def scale_remission(intensity: np.ndarray | None, returns: np.ndarray, named: str, first: Scale | None) -> Remission:
    """Return the remission of points.

    intensity  (N,) as the file holds it;  returns: (N,) bool, points with coordinates: others have no say.
    named      the user's scale ("1", "255", "65535", "none"), "" to find it out.
    first      the scale of the stream's first scan, if there is one: it holds, and what contradicts it is doubted.
    """
    stand_in = np.full(len(returns), STAND_IN, np.float32)
    if intensity is None or named == NONE:
        return Remission(stand_in, Scale(NONE), 0, [])
    missing = _missing(intensity, returns)
    if intensity.dtype == np.int8 and np.mean((intensity < 0) & ~missing) > MOST_ABOVE:
        intensity = intensity.view(np.uint8)  # drivers call an unsigned byte signed
    valid = returns & ~missing
    sample = intensity[valid]
    sample = sample[:: max(1, len(sample) // SAMPLE)].astype(np.float64)
    constant = not len(sample) or (len(sample) >= FEWEST and not np.ptp(np.percentile(sample, TAILS)))
    if first is not None and not named and constant != (first.name == NONE):
        say = "say nothing" if constant else "differ from point to point"
        return Remission(
            stand_in, Scale(NONE), 0, [f"its remissions {say}, unlike the first scan's; they are not used"]
        )
    if constant and not (named and len(sample)):
        return Remission(stand_in, Scale(NONE), 0, [])
    scale = Scale(f"0-{named}", float(named)) if named else first or _scale(sample, intensity.dtype)
    full = scale.full or 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        values = (intensity.astype(np.float64) - scale.zero if scale.zero else intensity).astype(np.float32)
        values = np.clip(values / np.float32(full) if full != 1 else values, 0, 1)
        outside = valid & ((intensity < scale.zero) | (intensity > scale.zero + full))
    values[missing] = STAND_IN
    odd = int(np.count_nonzero(outside | (missing & returns)))
    doubts = _doubts(sample, values[valid], scale, missing[returns], "--remission" if named else "the first scan")
    if not (named or first) and scale.name in (MIN_MAX, PERCENTILE):
        doubts = [BELOW_ZERO] if scale.name == MIN_MAX else []
    return Remission(values, scale, odd, doubts)


def _missing(intensity: np.ndarray, returns: np.ndarray) -> np.ndarray:
    """Return the mask (N,) of values without a remission: NaN, infinite, or a negative mark of missing ones."""
    if intensity.dtype.kind == "u":
        return np.zeros(len(intensity), bool)
    missing = ~np.isfinite(intensity) if intensity.dtype.kind == "f" else np.zeros(len(intensity), bool)
    negative = intensity[~missing & returns & (intensity < 0)]
    if len(negative):
        values, counts = np.unique(negative, return_counts=True)
        if counts.max() >= MARKED * len(negative):
            missing |= intensity == values[counts.argmax()]
    return missing


def _scale(sample: np.ndarray, dtype: np.dtype) -> Scale:
    """Return the scale of valid values."""
    if np.mean(sample < 0) > MOST_ABOVE:
        low, high = (float(edge) for edge in np.percentile(sample, EDGES))
        return Scale(MIN_MAX, high - low, low)
    most = float(np.percentile(sample, 99))
    integers = dtype.kind in "iu"
    if not integers:
        excess = float(np.mean(sample > 1))
        fractions = bool((sample[sample <= 1] % 1).any())
        if not excess or (excess <= MOST_ABOVE_ONE and fractions):
            return Scale("0-1", 1.0)
    for full in SCALES[1:]:
        if np.mean(sample > full) <= MOST_ABOVE:
            if full == SCALES[-1] and most < full * FULL_SHARE:
                return Scale(PERCENTILE, max(most, SCALES[1]))  # photon counts, or 12 bit
            return Scale(f"0-{full:.0f}", full)
    return Scale(PERCENTILE, most)


def _doubts(sample: np.ndarray, values: np.ndarray, scale: Scale, missing: np.ndarray, source: str) -> list[str]:
    """Return doubts about values (V,) in [0, 1], a sample of them as the file holds them, and the mask of missing ones.

    source  of a scale that the values themselves did not give.
    """
    doubts = []
    full = scale.zero + (scale.full or 1.0)
    beyond = float(np.mean(sample > full))
    if float(np.mean(values >= 1)) > MOST_FULL:
        doubts.append("most of its points have full remission; name the scale with --remission")
    elif beyond > MOST_ABOVE:
        doubts.append(
            f"{beyond:.0%} of its remissions are above {full:g}, and limited; name the scale with --remission"
        )
    if float(np.percentile(sample, 99)) - scale.zero < LEAST_FILLED * (scale.full or 1.0):
        doubts.append(f"its remissions do not reach a hundredth of {full:g}, full by {source}; name another scale")
    if float(np.mean(missing)) > MOST_ABOVE:
        doubts.append(f"{np.mean(missing):.0%} of its points have no valid remission; a constant stands in")
    return doubts
