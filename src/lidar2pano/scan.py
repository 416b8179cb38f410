"""Scan: one LiDAR sweep as its file holds it; and changed copies of it, as sensors and streets vary."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np

OWN_VEHICLE_M = 1.0  # echoes from nearer than this are the vehicle itself, or none (nuScenes' devkit drops them too)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scan:
    """One LiDAR sweep, as its file holds it: nothing dropped, file order.

    xyz        (N, 3) float32, metres; sensor frame: x forward, y left, z up.
    remission  (N,)   float32, in [0, 1].
    label      (N,)   int64 ids of SEMANTIC_KITTI, or None when there are no labels.
    name       the source (a file's stem), for messages and output names.
    ring       (N,) int64 numbers of the beams, or None.
    time_s     (N,) float64 seconds of the points from the scan's own stamp, or None.
    gaps_deg   sectors (left, right) of azimuth, degrees, out of the sensor's field of view.
    near_infrared  (N,) float32 daylight at each point as the sensor counts it (Ouster's ambient field), or None.
    """

    xyz: np.ndarray
    remission: np.ndarray
    label: np.ndarray | None = None
    name: str = "scan"
    ring: np.ndarray | None = None
    time_s: np.ndarray | None = None
    gaps_deg: tuple[tuple[float, float], ...] = ()
    near_infrared: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Turn lists into arrays; refuse arrays of another type or length (ValueError)."""
        for name, dtype in (("xyz", np.float32), ("remission", np.float32), ("label", np.int64)):
            if isinstance(values := getattr(self, name), list | tuple):
                object.__setattr__(self, name, np.asarray(values, dtype=dtype))
        if self.xyz.ndim != 2 or self.xyz.shape[1] != 3 or self.xyz.dtype != np.float32:
            raise ValueError(f"Scan.xyz must be (N, 3) float32, got {self.xyz.shape} {self.xyz.dtype}")
        for name, array, dtype in (
            ("remission", self.remission, np.float32),
            ("label", self.label, np.int64),
            ("ring", self.ring, np.int64),
            ("time_s", self.time_s, np.float64),
            ("near_infrared", self.near_infrared, np.float32),
        ):
            if array is not None and (array.shape != self.xyz.shape[:1] or array.dtype != dtype):
                expected = f"({len(self.xyz)},) {np.dtype(dtype)}"
                raise ValueError(f"Scan.{name} must be {expected} like Scan.xyz, got {array.shape} {array.dtype}")

    def __len__(self) -> int:
        """Return the number of points, unusable ones included."""
        return len(self.xyz)

    def beyond(self, nearest_m: float = OWN_VEHICLE_M) -> Self:
        """Return the same points, those nearer to the sensor than so many metres NaN, like missing echoes."""
        near = np.einsum("ij,ij->i", self.xyz, self.xyz) < nearest_m**2
        return replace(self, xyz=np.where(near[:, None], np.float32(np.nan), self.xyz)) if near.any() else self


def drop_points(scan: Scan, generator: np.random.Generator, share: float) -> Scan:
    """Leave out a share of the points at random."""
    return subset(scan, generator.random(len(scan)) >= share)


def drop_rings(scan: Scan, generator: np.random.Generator, steps_deg: float, share: float) -> Scan:
    """Leave out bands of elevation of `steps_deg` degrees at random: a sensor of fewer beams."""
    band = bands(scan, steps_deg)
    kept = generator.random(int(band.max(initial=0)) + 1) >= share
    return subset(scan, kept[band])


def drop_above(scan: Scan, elevation_deg: float) -> Scan:
    """Leave out the points above an elevation, degrees: a sensor whose highest beam is lower."""
    return subset(scan, _elevations_deg(scan) <= elevation_deg)


def bands(scan: Scan, steps_deg: float) -> np.ndarray:
    """Return the band of elevation of each point, (N,) int64: bands are `steps_deg` degrees high, the nadir's is 0.

    NaN points are in the nadir's.
    """
    return np.floor((np.nan_to_num(_elevations_deg(scan), nan=-90.0) + 90) / steps_deg).astype(np.int64)


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


def tilt(scan: Scan, azimuth: float, angle: float) -> Scan:
    """Lean the sensor towards an azimuth by `angle`, both in radians: points there rise in its frame."""
    cos, sin = np.cos(angle), np.sin(angle)
    R = np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]], dtype=np.float32)
    ahead = turn(scan, -azimuth)
    return turn(replace(ahead, xyz=ahead.xyz @ R.T), azimuth)


def mix(scan: Scan, partner: Scan, generator: np.random.Generator, pasted: Sequence[int]) -> Scan:
    """Swap a half-turn of a labelled scan for its partner's, and paste the partner's points of some classes, turned.

    PolarMix (Xiao et al. 2022), with its three copies, each turned by up to a full turn. Beams and times are left out.
    """
    middle = generator.uniform(-np.pi, np.pi)
    parts = [subset(scan, ~_ahead(scan, middle)), subset(partner, _ahead(partner, middle))]
    things = subset(partner, np.isin(_labels(partner), pasted))
    parts += [turn(things, generator.uniform(-np.pi, np.pi)) for _ in range(3)]
    xyz, remission, label = (
        np.concatenate(values)
        for values in zip(*((part.xyz, part.remission, _labels(part)) for part in parts), strict=True)
    )
    return Scan(xyz=xyz, remission=remission, label=label, name=scan.name, gaps_deg=scan.gaps_deg)


def vary_remission(scan: Scan, generator: np.random.Generator, reach: float) -> Scan:
    """Another sensor's scale of remission: all times 1 +- reach, and up to a fifth of `reach` more or less."""
    factor, offset = generator.uniform(1 - reach, 1 + reach), generator.uniform(-reach, reach) / 5
    changed = np.clip(scan.remission * factor + offset, 0, 1).astype(np.float32)
    return replace(scan, remission=changed)


def change_sensor_remission(scan: Scan, generator: np.random.Generator, octaves: float) -> Scan:
    """Return the scan with the remission of another make of sensor: 2**a remission**(2**b) (10 m / range)**c in [0, 1].

    a is drawn within +-`octaves`, b within +-`octaves` / 3, c (0: calibrated, 2: raw power, by the LiDAR equation of
    Wagner et al. 2006) within [0, 2 `octaves` / 3]; ranges below 1 m count as 1 m. The curve rises in remission.
    """
    curve = remission_curve(generator, octaves)
    fade = generator.uniform(0, 2 * octaves) / 3
    range_m = np.nan_to_num(np.linalg.norm(scan.xyz, axis=1), nan=10.0).clip(1.0, 1e3)
    bright = curve(np.clip(scan.remission, 0, 1)) * (10.0 / range_m) ** fade
    return replace(scan, remission=np.clip(bright, 0, 1).astype(np.float32))


def remission_curve(generator: np.random.Generator, octaves: float) -> Callable[[Any], Any]:
    """Draw the rising curve 2**a remission**(2**b) of `change_sensor_remission`, for arrays or tensors in [0, 1]."""
    level, curve = generator.uniform(-octaves, octaves), generator.uniform(-octaves, octaves) / 3
    return lambda remission: remission**2.0**curve * 2.0**level


def _ahead(scan: Scan, azimuth: float) -> np.ndarray:
    return scan.xyz[:, 0] * np.cos(azimuth) + scan.xyz[:, 1] * np.sin(azimuth) > 0


def _labels(scan: Scan) -> np.ndarray:
    assert scan.label is not None
    return scan.label


def _elevations_deg(scan: Scan) -> np.ndarray:
    return np.degrees(np.arctan2(scan.xyz[:, 2], np.hypot(scan.xyz[:, 0], scan.xyz[:, 1])))


def subset(scan: Scan, kept: np.ndarray) -> Scan:
    """Return the points `kept` of a scan, (N,) bool, with all that is known of each."""
    parts = {part.name: getattr(scan, part.name) for part in fields(scan)}
    return replace(scan, **{name: part[kept] for name, part in parts.items() if isinstance(part, np.ndarray)})
