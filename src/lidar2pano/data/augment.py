"""Augmentation of scans (the paper's, and SalsaNext's) before they are projected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidar2pano.formats.interpretation import STAND_IN
from lidar2pano.scan import Scan

# Heights of the bands of elevation left out by two augmentations.
HDL64E_BEAM_DEG = 0.42  # of one beam: between neighbours of an HDL-64E's 64 beams within 26.8 degrees
COARSE_BAND_DEG = 0.8  # of about two beams


def drop_points(scan: Scan, generator: np.random.Generator, share: float) -> Scan:
    """Leave out a share of the points at random."""
    return _subset(scan, generator.random(len(scan)) >= share)


def drop_rings(scan: Scan, generator: np.random.Generator, steps_deg: float, share: float) -> Scan:
    """Leave out bands of elevation of `steps_deg` degrees at random: a sensor of fewer beams."""
    band = bands(scan, steps_deg)
    return _subset(scan, generator.random(band.max(initial=0) + 1)[band] >= share)


def bands(scan: Scan, steps_deg: float) -> np.ndarray:
    """Return the band of elevation of each point, (N,) int64: bands are `steps_deg` degrees high, the nadir's is 0.

    NaN points are in the nadir's.
    """
    elevation = np.degrees(np.arctan2(scan.xyz[:, 2], np.hypot(scan.xyz[:, 0], scan.xyz[:, 1])))
    return np.floor((np.nan_to_num(elevation, nan=-90.0) + 90) / steps_deg).astype(np.int64)


def mirror(scan: Scan) -> Scan:
    """Swap left and right: y -> -y."""
    return replace(scan, xyz=scan.xyz * np.array([1, -1, 1], dtype=np.float32))


def turn(scan: Scan, angle: float) -> Scan:
    """Turn the scan about the vertical axis by `angle` radians, counter-clockwise."""
    cos, sin = np.cos(angle), np.sin(angle)
    R = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], dtype=np.float32)
    return replace(scan, xyz=scan.xyz @ R.T)


def shift(scan: Scan, generator: np.random.Generator, reach_m: tuple[float, float, float]) -> Scan:
    """Move the scan by up to reach_m (x, y, z) either way."""
    return replace(
        scan, xyz=scan.xyz + generator.uniform(-1, 1, 3).astype(np.float32) * np.array(reach_m, dtype=np.float32)
    )


def vary_remission(scan: Scan, generator: np.random.Generator, reach: float) -> Scan:
    """Another sensor's scale of remission: all times 1 +- reach, and up to a fifth of `reach` more or less."""
    factor, offset = generator.uniform(1 - reach, 1 + reach), generator.uniform(-reach, reach) / 5
    changed = np.clip(scan.remission * factor + offset, 0, 1).astype(np.float32)
    return replace(scan, remission=changed)


def drop_remission(scan: Scan) -> Scan:
    """Return a scan of a sensor without remission: all points have the stand-in value."""
    return replace(scan, remission=np.full_like(scan.remission, STAND_IN))


def _subset(scan: Scan, kept: np.ndarray) -> Scan:
    label = None if scan.label is None else scan.label[kept]
    return replace(scan, xyz=scan.xyz[kept], remission=scan.remission[kept], label=label)
