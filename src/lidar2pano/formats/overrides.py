"""Overrides: the user's knowledge of a cloud, in place of findings from the scan itself."""

from __future__ import annotations

from dataclasses import dataclass

from lidar2pano.errors import InputError

FORWARD = {"x": (1, 0), "y": (0, 1), "-x": (-1, 0), "-y": (0, -1)}  # (cos, sin) of the forward axis


@dataclass(frozen=True, kw_only=True)
class Overrides:
    """The user's knowledge, in place of findings from the scan itself.

    sensor_height_m  height of the viewpoint above the ground: the cloud is lowered or lifted so; None: found out.
    forward          the forward axis: "x", "y", "-x", "-y"; "": found out.
    remission        value of full remission: "1", "255", "65535", or "none"; "": found out.
    invent           whether the panorama also claims the sectors outside the field of view.
    """

    sensor_height_m: float | None = None
    forward: str = ""
    remission: str = ""
    invent: bool = False

    def __post_init__(self) -> None:
        """Refuse invalid values (InputError)."""
        if self.forward not in ("", *FORWARD):
            raise InputError(f"--forward {self.forward!r} is no axis; there is {', '.join(FORWARD)}")
        if self.remission not in ("", "1", "255", "65535", "none"):
            raise InputError(f"--remission {self.remission!r} is no scale; there is 1, 255, 65535 and none")
        if self.sensor_height_m is not None and not 0 <= self.sensor_height_m <= 100:
            raise InputError(f"--sensor-height {self.sensor_height_m} is no height above the ground in metres")
