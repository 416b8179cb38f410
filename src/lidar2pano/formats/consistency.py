"""Contradictions between a scan and itself, or the first scan of its stream."""

from __future__ import annotations

import numpy as np

from lidar2pano.formats.forward import evidence_of_x
from lidar2pano.formats.ground_plane import BELOW_M, LEVEL_DEG, SURE_SHARE, Ground
from lidar2pano.formats.sensor_placement import OTHER_AXES, Placement, best_ground, find_unit, stands
from lidar2pano.formats.sweep import is_offset
from lidar2pano.formats.unnamed_columns import share_between

MOST_TILT_DEG = 2 * LEVEL_DEG  # against the first scan's ground: a sensor does not turn, and ramps are no steeper
OPPOSED = 0.7  # evidence against the first scan's forward axis; scans at crossings have 0.1
RING_SHARE = 0.25  # of the elevations' variance is between rings; chance gives none, a tilted sensor's half of it
FEWEST_RINGS = 8  # lines of fewer lasers (Livox) are no elevations


def contradictions(sample: np.ndarray, first: Placement) -> list[str]:
    """Return contradictions of a sample (N, 3) float64 of a scan's points with the placement of its stream's first."""
    if is_offset(sample):
        return []
    if find_unit(sample) != first.unit_m:
        return ["its unit is not the first scan's; it is read by itself"]
    if first.ground_m is None:
        return []
    moved = first.moved(sample, np.ones(len(sample), bool))
    ground = best_ground(moved)
    if ground and ground.share >= SURE_SHARE and ground.height_m < BELOW_M:
        return _of_ground(moved, ground)
    cause = next((cause for cause, turn in OTHER_AXES.items() if stands(best_ground(moved @ turn.T))), "")
    return [f"{cause}, unlike in the first scan; it is read by itself"] if cause else []


def _of_ground(moved: np.ndarray, ground: Ground) -> list[str]:
    if ground.tilt_deg > MOST_TILT_DEG:
        tilt = f"its ground is tilted by {ground.tilt_deg:.0f} degrees against the first scan's"
        return [f"{tilt}; it is read by itself"]
    if (evidence_of_x(moved, ground) or 0.0) < -OPPOSED:
        return ["its forward axis is not the first scan's; it is read by itself"]
    return []


def follows_elevation(ring: np.ndarray, xyz: np.ndarray, placement: Placement) -> bool:
    """Return whether rings (N,) are beams: points (N, 3) of one ring have elevations near to each other.

    xyz  as the file holds them, with coordinates; elevations are about the cloud's own z, and about the scan's.
    """
    local = xyz.astype(np.float64) * placement.unit_m - placement.viewpoint_m
    return any(share_between(ring, _elevation(turned)) > RING_SHARE for turned in (local, local @ placement.rotation.T))


def _elevation(xyz: np.ndarray) -> np.ndarray:
    return np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
