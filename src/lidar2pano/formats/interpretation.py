"""What a cloud's numbers mean: remission, axes, height of the ground, units, points that are none, field of view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.scan import Scan


@dataclass(frozen=True, kw_only=True)
class Overrides:
    """What the user knows better than the scan itself.

    sensor_height_m  height of the sensor above the ground, for clouds in a vehicle's frame; None: found out.
    forward          the axis that points forward: "x", "y", "-x", "-y"; "": found out.
    remission        value that stands for full remission: "1", "255", "65535", or "none"; "": found out.
    invent           whether the panorama shows what lies outside the field of view, too.
    """

    sensor_height_m: float | None = None
    forward: str = ""
    remission: str = ""
    invent: bool = False


@dataclass(frozen=True, kw_only=True)
class Interpretation:
    """How a cloud was read; what --json and `inspect` print."""

    format: str = ""


def interpret(cloud: PointCloud, overrides: Overrides | None = None) -> tuple[Scan, Interpretation]:
    """The scan in the sensor's frame, metres, remission in [0, 1], and how it was found out."""
    xyz = cloud.xyz.astype(np.float32)
    intensity = np.zeros(len(xyz), np.float32) if cloud.intensity is None else cloud.intensity.astype(np.float32)
    return Scan(xyz=xyz, remission=intensity, label=cloud.label, name=cloud.name), Interpretation(format=cloud.format)
