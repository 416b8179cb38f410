"""Scan: one LiDAR sweep as its file holds it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

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
    """

    xyz: np.ndarray
    remission: np.ndarray
    label: np.ndarray | None = None
    name: str = "scan"
    ring: np.ndarray | None = None
    time_s: np.ndarray | None = None
    gaps_deg: tuple[tuple[float, float], ...] = ()

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
