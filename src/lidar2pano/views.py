"""View: the raster of a projection, and the table of views of sensors and published weights."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from lidar2pano.errors import InputError, closest

FULL_TURN = 360.0  # degrees
MOST_PIXELS = 1 << 24  # nine times the panorama's
STEEPEST_DEG = 60.0  # elevation of a panorama's rows: a cylinder's grow without end towards 90
SLACK, DIGITS = 1e-6, 12  # rows, by which a whole number may be exceeded; of borders of elevation


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """A raster of directions around a point.

    kind     "sphere": rows are equal steps of elevation; `up` and `down` are degrees.
             "cylinder": rows are equal steps of tan(elevation); `up` and `down` are tangents.
    left     azimuth in degrees of the left edge, counter-clockwise from x; columns run from `left` down to `right`.
    origin   the viewpoint, in the sensor frame, metres (the panorama: the camera's optical centre).
    """

    rows: int
    columns: int
    up: float
    down: float
    left: float = 180.0
    right: float = -180.0
    kind: Literal["sphere", "cylinder"] = "sphere"
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Refuse a raster without an inside (ValueError); JSON's lists become tuples."""
        if self.kind not in {"sphere", "cylinder"} or len(self.origin) != 3:
            raise ValueError(f"a View is a sphere or a cylinder around a point (x, y, z): {self}")
        turn = self.left - self.right
        if min(self.rows, self.columns) < 1 or not self.up > self.down or not (0 < turn <= FULL_TURN or self.circular):
            raise ValueError(f"a View needs rows, columns >= 1, up > down and 0 < left - right <= 360 degrees: {self}")
        if self.rows * self.columns > MOST_PIXELS or not all(map(math.isfinite, (self.up, self.down, *self.origin))):
            raise ValueError(f"a View has at most {MOST_PIXELS} pixels and finite numbers: {self}")
        object.__setattr__(self, "origin", tuple(float(value) for value in self.origin))

    @property
    def circular(self) -> bool:
        """True if the last column meets the first."""
        return math.isclose(self.left - self.right, FULL_TURN, rel_tol=1e-12)

    @property
    def focal_px(self) -> float:
        """Columns per radian of azimuth."""
        return self.columns / math.radians(self.left - self.right)

    def scaled(self, factor: float) -> View:
        """Return the same directions on a coarser (factor < 1) or finer raster."""
        return replace(self, rows=round(self.rows * factor), columns=round(self.columns * factor))

    def between(self, up: float, down: float, step: int = 1) -> View:
        """Return the raster with rows added or left out, `step` at a time, until it just holds `up` to `down`.

        Rows that stay look into the same directions.
        """
        pitch = (self.up - self.down) / self.rows
        rows_up, rows_down = (
            math.ceil(beyond / (step * pitch) - SLACK) * step for beyond in (up - self.up, self.down - down)
        )
        if not (rows_up or rows_down):
            return self
        ends = (round(end, DIGITS) for end in (self.up + rows_up * pitch, self.down - rows_down * pitch))
        return replace(self, rows=self.rows + rows_up + rows_down, up=next(ends), down=next(ends))

    def window(self, start: int, columns: int) -> View:
        """Return the part of the raster from column `start`, `columns` wide: the same pixels."""
        step = (self.left - self.right) / self.columns
        left = self.left - start * step
        return replace(self, columns=columns, left=left, right=left - columns * step)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON; `View(**view.as_dict())` is the view again."""
        return asdict(self) | {"origin": list(self.origin)}


# The camera of KITTI's recording car stands here, in the frame of its LiDAR (calibration of 2011-09-26, rounded).
KITTI_CAMERA = (0.27, 0.06, -0.07)

# 4608 / 2 pi = 733 columns per radian, as fine as KITTI's camera; rows cover the camera's picture.
PANORAMA = View(rows=384, columns=4608, up=0.24, down=-0.2836, kind="cylinder", origin=KITTI_CAMERA)
TALL = (math.tan(math.radians(24.0)), -math.tan(math.radians(32.0)))  # as hdl64e-tall

VIEWS: dict[str, View] = {
    "hdl64e": View(rows=64, columns=2048, up=3.0, down=-25.0),  # SalsaNext, lidar-bonnetal's darknet53.yaml
    "hdl64e-tall": View(rows=128, columns=2048, up=24.0, down=-32.0),  # rows as high, for larger fields of view
    "titan-front": View(rows=64, columns=2048, up=3.0, down=-15.0, left=45.0, right=-45.0),  # TITAN-Net, laserscan.py
    "titan-front-512": View(rows=64, columns=512, up=3.0, down=-15.0, left=45.0, right=-45.0),  # TITAN-Next's width
    "panorama": PANORAMA,
    "panorama-tall": PANORAMA.between(*TALL, step=32),  # the same rows and more: of translators, 16 at half the raster
    "hdl32e": View(rows=32, columns=1024, up=10.67, down=-30.67),  # Velodyne HDL-32E data sheet
    "vlp16": View(rows=16, columns=1024, up=15.0, down=-15.0),  # Velodyne VLP-16 data sheet
    "os1-64": View(rows=64, columns=1024, up=22.5, down=-22.5),  # Ouster OS1 data sheet (rev. 6: 45 degrees)
    "os1-128": View(rows=128, columns=1024, up=22.5, down=-22.5),  # Ouster OS1 data sheet
    "pandar64": View(rows=64, columns=1800, up=15.0, down=-25.0),  # Hesai Pandar64 data sheet
    "nuscenes": View(rows=32, columns=1024, up=10.67, down=-30.67),  # its LIDAR_TOP is an HDL-32E
    "waymo-top": View(rows=64, columns=2650, up=2.4, down=-17.6),  # Waymo Open Dataset, Sun et al. 2020, table 2
}


def elevation_range(value: str | Iterable[float]) -> tuple[float, float] | None:
    """Return LOW and HIGH, degrees, of "LOW,HIGH" or two numbers; None for "auto"; InputError for anything else."""
    if value == "auto":
        return None
    try:
        low, high = map(float, value.split(",") if isinstance(value, str) else value)
    except (TypeError, ValueError):
        low = high = math.nan
    if not -STEEPEST_DEG <= low < high <= STEEPEST_DEG:
        limits = f"-{STEEPEST_DEG:g} <= LOW < HIGH <= {STEEPEST_DEG:g}"
        raise InputError(f"elevation {value!r}: is neither auto nor LOW,HIGH in degrees; name two numbers, {limits}")
    return low, high


def columns_between(view: View, left: float, right: float) -> list[int]:
    """Columns of a view whose centres lie in a sector of azimuth: degrees, from `left` down to `right`."""
    step = (view.left - view.right) / view.columns
    turns = ((left - view.left + (column + 0.5) * step) % FULL_TURN for column in range(view.columns))
    return [column for column, turn in enumerate(turns) if turn < left - right]


def view_of(name: str) -> View:
    """Return the view of this name in VIEWS; InputError for another name."""
    if name not in VIEWS:
        raise InputError(f"no view {name!r}{closest(name, VIEWS)}")
    return VIEWS[name]


def sensor_view(name: str) -> View:
    """Return the raster of a sensor in VIEWS (spheres only: the panorama is no sensor); InputError for another name."""
    sensors = {sensor: view for sensor, view in VIEWS.items() if view.kind == "sphere"}
    if name not in sensors:
        raise InputError(f"no sensor {name!r}{closest(name, sensors)}")
    return sensors[name]
