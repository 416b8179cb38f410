"""Models of spinning LiDAR sensors: beams, rotation, range and remission."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

FULL_TURN = 360.0  # degrees


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorModel:
    """One spinning LiDAR; per-beam values are tuples of B numbers, the top beam first. Degrees, metres.

    elevation        (B) angle above the horizon;  azimuth: (B) angle to the left of the head's direction.
    origin_up        (B) height of the beam's origin above the sensor's;  origin_left: (B) its offset to the left.
    firings          a turn;  hz: turns a second;  rotation: 1 counter-clockwise seen from above, -1 clockwise.
    encoder_step     resolution of the head's angle; 0 = exact.
    min_range, max_range  of reported returns;  range_step: resolution of the range.
    range_noise      standard deviation from shot to shot at short range;  range_bias: (B) constant error of a beam.
    half_loss_range  at which half of the returns of a matt surface of reflectance 0.1 are lost at normal incidence.
    dropout          (B) share of returns lost at random.
    remission_scale  reported remission over `Material.remission`;  remission_noise: its standard deviation.
    remission_fade   (range, rate): where remission begins to fall, and its loss for each factor e of received power.
    remission_floor  on the scale of `Material.remission`: less is reported as 0.
    dark_offset, bright_offset  (B) deviation from the mean beam on a dark (0.22) and a bright (0.36) surface.
    blind_sectors    (beam, ((from, to), ...)): azimuths behind the recording car.
    point_order      beam by beam, each from straight ahead to the left, or firing by firing.
    """

    elevation: tuple[float, ...]
    azimuth: tuple[float, ...] = ()
    origin_up: tuple[float, ...] = ()
    origin_left: tuple[float, ...] = ()
    firings: int
    hz: float = 10.0
    rotation: Literal[1, -1] = -1
    encoder_step: float = 0.0
    min_range: float = 0.5
    max_range: float = 100.0
    range_step: float = 0.002
    range_noise: float = 0.015
    range_bias: tuple[float, ...] = ()
    half_loss_range: float = 60.0
    dropout: tuple[float, ...] = ()
    remission_scale: float = 1.0
    remission_noise: float = 0.03
    remission_fade: tuple[float, float] = (np.inf, 0.0)
    remission_floor: float = 0.0
    dark_offset: tuple[float, ...] = ()
    bright_offset: tuple[float, ...] = ()
    blind_sectors: tuple[tuple[int, tuple[tuple[float, float], ...]], ...] = ()
    point_order: Literal["rings", "columns"] = "columns"

    def __len__(self) -> int:
        """Number of beams."""
        return len(self.elevation)

    def per_beam(self, name: str) -> np.ndarray:
        """A per-beam field as (B,) float64; zeros where the table has none."""
        values = getattr(self, name)
        return np.array(values) if values else np.zeros(len(self))


BLIND_CELL = 0.5  # degrees: cells of the table of occluded directions


@cache
def blind_table(sensor: SensorModel) -> np.ndarray:
    """Directions occluded by the recording car: (B, 720) bool; cells of BLIND_CELL degrees to the left."""
    azimuth = (np.arange(round(FULL_TURN / BLIND_CELL)) + 0.5) * BLIND_CELL
    table = np.zeros((len(sensor), len(azimuth)), dtype=bool)
    for beam, spans in sensor.blind_sectors:
        for start, stop in spans:
            table[beam] |= (azimuth >= start) & (azimuth < stop)
    return table


def _spread(first: float, last: float, count: int) -> tuple[float, ...]:
    return tuple(np.linspace(first, last, count).tolist())


def _scaled(values: Sequence[float], unit: float) -> tuple[float, ...]:
    return tuple(value * unit for value in values)


def _ouster(beams: int) -> SensorModel:
    """Ouster OS1 data sheet (rev. 6): 45 degrees, four staggered columns of beams, 1 mm steps."""
    return SensorModel(
        elevation=_spread(22.5, -22.5, beams), azimuth=(4.2, 1.4, -1.4, -4.2) * (beams // 4), firings=1024,
        range_step=0.001, range_noise=0.01, remission_scale=0.3,
    )  # fmt: skip


# HDL-64E S2 of KITTI's car. Everything below was estimated from 95 raw scans of its recordings (2011-09-26 to 29).
# In a file, z = origin_up + distance on the plane x tan(elevation) holds per beam to 0.25 mm, the rounding to a
# millimetre; elevations agree from scan to scan within 0.002 degrees (0.015 at most). Origins are alternately 2.6 cm to
# the left and right; azimuths without their parallax are multiples of 0.09 degrees plus a constant of the beam.
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
_BIAS = (  # mm: mean residual to planes fitted to walls and cars within 14 m (30-550 a beam, spread 2-4 cm)
    -2, -15, 23, -9, 2, -59, 44, -20, -35, 6, 13, -9, 30, 12, -15, -18, 17, -10, 48, 1, 1, -15, -29, -20, 22, -4, 29,
    -29, 46, 11, 27, 18, 6, -3, 15, -23, -6, -4, 49, 46, -3, 43, -36, -9, 12, -36, -32, -28, -7, 27, -7, 2, -8, 51, -13,
    -6, -1, 8, -13, -13, 2, 3, 51, 18,
)  # fmt: skip
# Hundredths: deviation of a beam from its neighbours where they report 0.22 and 0.36 (quantiles within 25 m).
_DARK = (
    6, 1, 0, -11, 1, -3, 5, -1, 5, -4, 1, 4, 5, 1, 0, -1, 1, 1, 3, -3, 3, -17, 1, 5, -3, 0, 4, 3, 3, -6, 3, 5, 1, 0, 2,
    -14, -24, 4, 9, 8, -1, 3, -17, 3, 2, 3, 4, 0, -4, 7, 8, -34, 2, -5, -5, 3, 5, 10, -6, -7, -12, 6, 9, 7,
)  # fmt: skip
_BRIGHT = (
    5, 0, -2, -5, 1, -3, 4, -1, 5, -3, 1, 3, 6, 2, 0, 0, 1, 0, 3, -1, 2, -7, 1, 3, -2, 0, 1, 2, 1, -5, 3, 2, 2, 1, 2,
    -3, -8, 2, 7, 5, 0, 1, -6, 1, 0, 0, 2, -1, -3, 4, 5, -8, 1, -3, -4, 0, 1, 6, -3, -5, -5, 2, 5, 3,
)  # fmt: skip
# Ten thousandths: single returns missing on smooth surfaces within 25 m.
_DROP = (
    89, 89, 107, 89, 90, 99, 95, 91, 78, 103, 75, 78, 71, 70, 86, 68, 60, 57, 53, 62, 47, 63, 36, 33, 47, 39, 35, 23,
    24, 35, 19, 27, 14, 13, 10, 9, 8, 9, 7, 8, 7, 7, 6, 7, 9, 11, 8, 7, 12, 7, 4, 13, 10, 3, 4, 10, 10, 7, 12, 19, 17,
    16, 8, 4,
)  # fmt: skip
# Azimuths at which no scan has a return: roof, antennas and mounts of the car.
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

SENSOR_MODELS: dict[str, SensorModel] = {
    "hdl64e": SensorModel(
        elevation=_ELEVATION,
        azimuth=_scaled(_AZIMUTH, 1e-3),
        origin_up=_spread(0.209, 0.198, 32) + _spread(0.126, 0.116, 32),
        origin_left=(-0.026, 0.026) * 32,
        # 20 833 firings a second (data sheet); the fullest rings hold 2156-2161 points, so KITTI's turns at 9.66 Hz.
        firings=2156,
        hz=9.66,
        rotation=1,  # "rotating ... counter-clockwise", Geiger et al. 2013
        encoder_step=0.09,
        min_range=1.45,  # the nearest points of raw scans: 1.46-1.49 m
        max_range=80.0,  # where KITTI's files end
        range_noise=0.0085,  # second differences along rings: 8.5 mm on roads and walls within 15 m
        range_bias=_scaled(_BIAS, 1e-3),
        half_loss_range=70.0,  # roads come back from beyond 70 m
        dropout=_scaled(_DROP, 1e-4),
        # Median remission of roads, lawns, walls and trees: constant to 20 m, then 0.09 less by 26 m, 0.17 by 34 m.
        remission_fade=(19.5, 0.156),
        remission_floor=0.08,  # hardly any non-zero value of real scans is smaller
        dark_offset=_scaled(_DARK, 0.01),
        bright_offset=_scaled(_BRIGHT, 0.01),
        blind_sectors=_HIDDEN,
        point_order="rings",
    ),
    # Velodyne HDL-32E data sheet: 32 beams 4/3 degrees apart, 46.08 us a firing, +-2 cm. nuScenes reports a median
    # remission of 12 / 255 in streets.
    "hdl32e": SensorModel(
        elevation=_spread(10.67, -30.67, 32), firings=2170, min_range=1.0, remission_scale=0.2, remission_noise=0.01,
        range_noise=0.012,
    ),
    # Velodyne VLP-16 manual: 55.296 us a firing, and the beams' vertical offsets in mm.
    "vlp16": SensorModel(
        elevation=_spread(15.0, -15.0, 16),
        origin_up=_scaled(
            (-11.2, -9.7, -8.1, -6.6, -5.1, -3.7, -2.2, -0.7, 0.7, 2.2, 3.7, 5.1, 6.6, 8.1, 9.7, 11.2), 1e-3
        ),
        firings=1808, remission_scale=0.2, remission_noise=0.01, range_noise=0.012,
    ),
    "os1-64": _ouster(64),
    "os1-128": _ouster(128),
    # Hesai Pandar64 manual: 1/6 degree from +2 to -6, coarser above and below.
    "pandar64": SensorModel(
        elevation=(15, 11, 8, 5, 3, *_spread(2, -6, 49), -7, -8, -9, -10, -11, -12, -13, -14, -19, -25), firings=1800,
        max_range=200.0, range_step=0.004, range_noise=0.012, remission_scale=0.25, remission_noise=0.015,
    ),
}  # fmt: skip
