"""Spinning LiDAR sensors: where each beam looks, how it turns and how it measures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

FULL_TURN = 360.0  # degrees


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensor:
    """One spinning LiDAR; per-beam values are tuples of B numbers, the top beam first. Degrees, metres.

    elevation  (B) angle above the horizon.
    azimuth    (B) how far a beam looks to the left of where the head points.
    rise       (B) height of the beam's origin over the sensor's;  aside: how far it stands to the left.
    steps      firings a turn;  hz turns a second;  turn 1: the head turns to the left (seen from above), -1: right.
    encoder    the head's angle is told in whole steps of this; 0 = exactly.
    nearest, farthest  range of what is reported;  grain: its step.
    noise      standard deviation of the range from shot to shot, near by;  bias: (B) a beam's own constant error.
    reach      metres at which a matt surface of reflectance 0.1, seen at right angles, is lost half of the time.
    drop       (B) share of the returns that a beam loses by chance.
    scale      remission as the sensor reports it, over `Material.lidar`;  flicker: its standard deviation.
    fade       (range, rate): where the remission begins to fall, and how much a factor e of received power then costs.
    floor      of `Material.lidar`'s scale: what is less is reported as 0.
    dark, bright  (B) what a beam reports more than the mean beam of a dark (0.22) and a bright (0.36) surface.
    hidden     (beam, ((from, to), ...)): azimuths that the recording car itself hides.
    order      points are written beam by beam from straight ahead to the left, or firing by firing.
    """

    elevation: tuple[float, ...]
    azimuth: tuple[float, ...] = ()
    rise: tuple[float, ...] = ()
    aside: tuple[float, ...] = ()
    steps: int
    hz: float = 10.0
    turn: Literal[1, -1] = -1
    encoder: float = 0.0
    nearest: float = 0.5
    farthest: float = 100.0
    grain: float = 0.002
    noise: float = 0.015
    bias: tuple[float, ...] = ()
    reach: float = 60.0
    drop: tuple[float, ...] = ()
    scale: float = 1.0
    flicker: float = 0.03
    fade: tuple[float, float] = (np.inf, 0.0)
    floor: float = 0.0
    dark: tuple[float, ...] = ()
    bright: tuple[float, ...] = ()
    hidden: tuple[tuple[int, tuple[tuple[float, float], ...]], ...] = ()
    order: Literal["rings", "columns"] = "columns"

    def __post_init__(self) -> None:
        """Refuse tables that do not have one number per beam (ValueError)."""
        for name in PER_BEAM:
            if len(getattr(self, name)) not in {0, len(self.elevation)}:
                raise ValueError(f"Sensor.{name} needs {len(self.elevation)} numbers, one per beam")

    def __len__(self) -> int:
        """Number of beams."""
        return len(self.elevation)

    def per_beam(self, name: str) -> np.ndarray:
        """A per-beam field as (B,) float64; zeros where the table has none."""
        values = getattr(self, name)
        return np.array(values) if values else np.zeros(len(self))


PER_BEAM = ("azimuth", "rise", "aside", "bias", "drop", "dark", "bright")
SHADE = 0.5  # degrees: cells of the table of hidden directions


@cache
def hidden(sensor: Sensor) -> np.ndarray:
    """What the recording car hides: (B, 720) bool; cells of SHADE degrees to the left from straight ahead."""
    azimuth = (np.arange(round(FULL_TURN / SHADE)) + 0.5) * SHADE
    table = np.zeros((len(sensor), len(azimuth)), dtype=bool)
    for beam, spans in sensor.hidden:
        for start, stop in spans:
            table[beam] |= (azimuth >= start) & (azimuth < stop)
    return table


def _spread(first: float, last: float, count: int) -> tuple[float, ...]:
    return tuple(np.linspace(first, last, count).tolist())


def _scaled(values: Sequence[float], unit: float) -> tuple[float, ...]:
    return tuple(value * unit for value in values)


# HDL-64E S2 of KITTI's car. Everything below was estimated from 95 raw scans of its recordings (2011-09-26 to 29).
# In a file, z = rise + distance on the plane x tan(elevation) holds per beam to 0.25 mm (what rounding to a millimetre
# leaves); from scan to scan the elevations agree within 0.002 degrees (0.015 at most). Origins stand 2.6 cm to the
# left or the right in turn; azimuths less their parallax fall on steps of 0.09 degrees plus a beam's own constant.
_ELEVATION = (
    1.937, 1.574, 1.305, 0.872, 0.579, 0.181, -0.089, -0.452, -0.803, -1.201, -1.494, -1.833, -2.208, -2.547, -2.874,
    -3.236, -3.539, -3.936, -4.216, -4.588, -4.914, -5.251, -5.611, -5.958, -6.329, -6.676, -6.999, -7.287, -7.679,
    -8.058, -8.310, -8.711, -9.026, -9.574, -10.062, -10.471, -10.957, -11.599, -12.115, -12.562, -13.041, -13.485,
    -14.048, -14.598, -15.189, -15.657, -16.177, -16.554, -17.187, -17.730, -18.324, -18.797, -19.320, -19.736, -20.223,
    -20.788, -21.318, -21.935, -22.438, -22.857, -23.322, -23.971, -24.507, -24.999,
)  # fmt: skip
_AZIMUTH = (  # thousandths of a degree; modulo the encoder's step
    0, -26, -28, -11, -42, -44, 25, 24, 29, 24, 26, 29, -43, -5, -18, -9, -18, -8, -24, -28, 39, 34, -18, -10, -40, 40,
    42, 3, 37, 43, -6, -17, 20, 23, 5, -21, -16, -23, -10, 16, -38, 45, -31, -3, -36, -31, 18, 6, -25, -9, -33, -4, 18,
    -38, -43, -37, 14, -23, -19, 44, -18, 3, 16, 5,
)  # fmt: skip
_BIAS = (  # mm: mean residual to planes of walls and cars' sides within 14 m (30-550 a beam, spread 2-4 cm)
    -2, -15, 23, -9, 2, -59, 44, -20, -35, 6, 13, -9, 30, 12, -15, -18, 17, -10, 48, 1, 1, -15, -29, -20, 22, -4, 29,
    -29, 46, 11, 27, 18, 6, -3, 15, -23, -6, -4, 49, 46, -3, 43, -36, -9, 12, -36, -32, -28, -7, 27, -7, 2, -8, 51, -13,
    -6, -1, 8, -13, -13, 2, 3, 51, 18,
)  # fmt: skip
# Hundredths: what a beam reports more than its neighbours where they report 0.22 and 0.36 (quantiles of what
# both see, within 25 m).
_DARK = (
    6, 1, 0, -11, 1, -3, 5, -1, 5, -4, 1, 4, 5, 1, 0, -1, 1, 1, 3, -3, 3, -17, 1, 5, -3, 0, 4, 3, 3, -6, 3, 5, 1, 0, 2,
    -14, -24, 4, 9, 8, -1, 3, -17, 3, 2, 3, 4, 0, -4, 7, 8, -34, 2, -5, -5, 3, 5, 10, -6, -7, -12, 6, 9, 7,
)  # fmt: skip
_BRIGHT = (
    5, 0, -2, -5, 1, -3, 4, -1, 5, -3, 1, 3, 6, 2, 0, 0, 1, 0, 3, -1, 2, -7, 1, 3, -2, 0, 1, 2, 1, -5, 3, 2, 2, 1, 2,
    -3, -8, 2, 7, 5, 0, 1, -6, 1, 0, 0, 2, -1, -3, 4, 5, -8, 1, -3, -4, 0, 1, 6, -3, -5, -5, 2, 5, 3,
)  # fmt: skip
# Ten thousandths: single returns missing on even surfaces within 25 m.
_DROP = (
    89, 89, 107, 89, 90, 99, 95, 91, 78, 103, 75, 78, 71, 70, 86, 68, 60, 57, 53, 62, 47, 63, 36, 33, 47, 39, 35, 23,
    24, 35, 19, 27, 14, 13, 10, 9, 8, 9, 7, 8, 7, 7, 6, 7, 9, 11, 8, 7, 12, 7, 4, 13, 10, 3, 4, 10, 10, 7, 12, 19, 17,
    16, 8, 4,
)  # fmt: skip
# Directions from which no scan has a return: roof, antennas and mounts of the car.
_HIDDEN = (
    (42, ((158, 165.5), (199, 206.5))),
    (43, ((155, 163), (195.5, 204))),
    (44, ((156.5, 166), (197.5, 207))),
    (45, ((154.5, 163), (195.5, 203.5))),
    (46, ((157.5, 164.5), (199, 205.5))),
    (47, ((155.5, 161), (197, 202), (287, 294.5))),
    (48, ((160, 165.5), (199, 204), (287.5, 302))),
    (49, ((157.5, 163.5), (196, 201), (279.5, 297))),
    (50, ((160.5, 165), (198, 202.5), (283.5, 303))),
    (51, ((158.5, 163), (196, 199.5), (276.5, 298))),
    (52, ((160.5, 164.5), (170, 192), (198, 202), (281.5, 302.5))),
    (53, ((157, 200.5), (276.5, 298))),
    (54, ((160, 204.5), (282.5, 305))),
    (55, ((127.5, 129), (157, 202), (278.5, 299.5))),
    (56, ((130, 135.5), (158.5, 205), (231, 236), (282.5, 303.5))),
    (57, ((0.5, 10), (125.5, 133), (154.5, 204), (225.5, 233), (278, 297), (349.5, 357.5))),
    (58, ((0, 15), (128.5, 136.5), (155, 207.5), (228.5, 237), (282.5, 303), (346.5, 354), (355.5, 360))),
    (59, ((0, 13), (124.5, 133.5), (152, 205.5), (225, 233.5), (277.5, 293.5), (344.5, 360))),
    (60, ((0, 11.5), (129, 138.5), (154.5, 210), (229, 238), (283.5, 297.5), (324, 326.5), (331.5, 335), (344, 360))),
    (61, ((0, 14), (16.5, 18.5), (26, 29.5), (34, 37), (127.5, 134.5), (137, 140), (150.5, 208), (226, 234),
          (279.5, 289), (320.5, 325), (328, 332), (342, 360))),
    (62, ((0, 20), (28.5, 32.5), (35.5, 40), (130, 137.5), (140, 145), (152.5, 211.5), (221.5, 225.5), (229, 235),
          (284, 292), (323, 328.5), (330.5, 334.5), (341.5, 360))),
    (63, ((0, 20), (25.5, 29.5), (31.5, 37.5), (125, 142), (144.5, 211.5), (216, 222), (224, 234), (278.5, 283.5),
          (320.5, 331.5), (340, 360))),
)  # fmt: skip

SENSORS: dict[str, Sensor] = {
    "hdl64e": Sensor(
        elevation=_ELEVATION,
        azimuth=_scaled(_AZIMUTH, 1e-3),
        rise=_spread(0.209, 0.198, 32) + _spread(0.126, 0.116, 32),
        aside=(-0.026, 0.026) * 32,
        # 20 833 firings a second (data sheet); the fullest rings hold 2156-2161 points, so KITTI's turns at 9.66 Hz.
        steps=2156,
        hz=9.66,
        turn=1,  # "rotating ... counter-clockwise", Geiger et al. 2013
        encoder=0.09,
        nearest=1.45,  # the nearest points of raw scans: 1.46-1.49 m
        farthest=80.0,  # where KITTI's files end
        noise=0.0085,  # second differences along rings: 8.5 mm on roads and walls within 15 m
        bias=_scaled(_BIAS, 1e-3),
        reach=70.0,  # roads come back from beyond 70 m
        drop=_scaled(_DROP, 1e-4),
        # Median remission of roads, lawns, walls and trees: constant to 20 m, then 0.09 less by 26 m, 0.17 by 34 m.
        fade=(19.5, 0.156),
        floor=0.08,  # of the real values that are not 0 hardly any is smaller
        dark=_scaled(_DARK, 0.01),
        bright=_scaled(_BRIGHT, 0.01),
        hidden=_HIDDEN,
        order="rings",
    ),
    # Velodyne HDL-32E data sheet: 32 beams 4/3 degrees apart, 46.08 us a firing, +-2 cm. nuScenes reports a median
    # remission of 12 / 255 in streets.
    "hdl32e": Sensor(
        elevation=_spread(10.67, -30.67, 32), steps=2170, nearest=1.0, scale=0.2, flicker=0.01, noise=0.012
    ),
    # Velodyne VLP-16 manual: 55.296 us a firing, and the beams' vertical offsets in mm.
    "vlp16": Sensor(
        elevation=_spread(15.0, -15.0, 16),
        rise=_scaled((-11.2, -9.7, -8.1, -6.6, -5.1, -3.7, -2.2, -0.7, 0.7, 2.2, 3.7, 5.1, 6.6, 8.1, 9.7, 11.2), 1e-3),
        steps=1808,
        scale=0.2,
        flicker=0.01,
        noise=0.012,
    ),
    # Ouster OS1 data sheet (rev. 6): 45 degrees, four staggered columns of beams, 1 mm steps.
    "os1-64": Sensor(
        elevation=_spread(22.5, -22.5, 64),
        azimuth=(4.2, 1.4, -1.4, -4.2) * 16,
        steps=1024,
        grain=0.001,
        noise=0.01,
        scale=0.3,
    ),
    "os1-128": Sensor(
        elevation=_spread(22.5, -22.5, 128),
        azimuth=(4.2, 1.4, -1.4, -4.2) * 32,
        steps=1024,
        grain=0.001,
        noise=0.01,
        scale=0.3,
    ),
    # Hesai Pandar64 manual: 1/6 degree from +2 to -6, coarser above and below.
    "pandar64": Sensor(
        elevation=(15, 11, 8, 5, 3, *_spread(2, -6, 49), -7, -8, -9, -10, -11, -12, -13, -14, -19, -25),
        steps=1800,
        farthest=200.0,
        grain=0.004,
        noise=0.012,
        scale=0.25,
        flicker=0.015,
    ),
}
