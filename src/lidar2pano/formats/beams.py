"""The beams of a spinning LiDAR, found from one scan, and the sensor that has such beams."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidar2pano.formats.viewpoint import sharpness

NEAR_M = 2.0  # nearer points blur: a beam begins some centimetres from the sensor's origin
BIN_DEG = 0.02  # of the histogram in which beams are peaks
GATHERED = 1.6  # of elevations that gather at beams
LEAST_SHARE = 0.1  # of the median peak's points: smaller peaks are chance
FEWEST, MOST = 4, 300  # beams of a sensor
FEWEST_POINTS = 20  # of a beam
ORDERED = 0.97  # share of steps below ORDERED_DEG along a file that holds one beam after the other
ORDERED_DEG = 3.0
WRAP_DEG = 180.0
WIDEST_DEG = 0.5  # between the quartiles of a beam's elevations
NEAR_DEG = 2.0  # elevations of a sensor's outermost beams agree so well
SKY_DEG = 6.0  # or the highest that returns lies so far below, where a beam above it saw the sky only
# name -> beams, elevation of the highest and the lowest in degrees, by the data sheets
SENSORS: dict[str, tuple[int, float, float]] = {
    "Velodyne HDL-64E": (64, 2.0, -24.8),
    "Velodyne HDL-32E": (32, 10.67, -30.67),
    "Velodyne VLP-16": (16, 15.0, -15.0),
    "Velodyne VLP-32C": (32, 15.0, -25.0),
    "Velodyne VLS-128": (128, 15.0, -25.0),
    "Hesai Pandar40": (40, 7.0, -16.0),
    "Hesai Pandar64": (64, 15.0, -25.0),
    "Hesai PandarXT-32": (32, 15.0, -16.0),
    "Hesai PandarQT-64": (64, 52.1, -52.1),
    "Hesai Pandar128": (128, 14.4, -25.1),
    "Ouster OS0-32": (32, 45.0, -45.0),
    "Ouster OS0-128": (128, 45.0, -45.0),
    "Ouster OS1-16": (16, 22.5, -22.5),
    "Ouster OS1-32": (32, 22.5, -22.5),
    "Ouster OS1-64": (64, 22.5, -22.5),
    "Ouster OS1-128": (128, 22.5, -22.5),
    "Ouster OS2-128": (128, 11.25, -11.25),
    "RoboSense RS-LiDAR-16": (16, 15.0, -15.0),
    "RoboSense Ruby": (128, 15.0, -25.0),
    "Livox Mid-360": (4, 52.0, -7.0),
}


@dataclass(frozen=True, kw_only=True)
class Beams:
    """Elevations in degrees of a sensor's beams, from the highest down; `found_by`: "ring", "file order" or "peaks"."""

    elevations_deg: tuple[float, ...]
    found_by: str

    def sensor(self) -> str:
        """Names of the sensors of SENSORS that have such beams, "" where none has."""
        if not self.elevations_deg:
            return ""
        up, down = self.elevations_deg[0], self.elevations_deg[-1]
        return " or ".join(
            name
            for name, (count, highest, lowest) in SENSORS.items()
            if abs(count - len(self.elevations_deg)) <= 0.04 * count
            and -NEAR_DEG < highest - up < (NEAR_DEG if len(self.elevations_deg) >= count else SKY_DEG)
            and abs(lowest - down) < NEAR_DEG
        )


def find_beams(xyz: np.ndarray, ring: np.ndarray | None = None) -> Beams | None:
    """The beams of a scan (N, 3) in metres, from the sensor's origin; None where it does not show any.

    ring  (N,) integer number of each point's beam, where it is known.
    """
    with np.errstate(invalid="ignore"):
        near = np.linalg.norm(xyz, axis=1) > NEAR_M
    x, y, z = xyz[near].T.astype(np.float64)
    if len(x) < FEWEST_POINTS * FEWEST:
        return None
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    if ring is not None:
        return _of_rings(elevation, ring[near], "ring")
    azimuth = np.degrees(np.arctan2(y, x))
    turn = np.diff((azimuth - azimuth[0]) % 360)
    wraps = np.abs(turn) > WRAP_DEG
    wraps &= np.diff(np.flatnonzero(wraps), prepend=-len(wraps)).min(initial=len(wraps)) >= FEWEST_POINTS
    if FEWEST <= wraps.sum() < MOST and (np.abs(turn[~wraps]) < ORDERED_DEG).mean() > ORDERED:
        number = np.concatenate([[0], np.cumsum(wraps)])
        width = [np.ptp(np.percentile(elevation[number == one], (25, 75))) for one in np.unique(number)]
        if np.median(width) < WIDEST_DEG:
            return _of_rings(elevation, number, "file order")
    if sharpness(xyz[near], np.zeros(3)) < GATHERED:
        return None
    return _of_peaks(elevation)


def _of_rings(elevation: np.ndarray, ring: np.ndarray, found_by: str) -> Beams | None:
    values, counts = np.unique(ring, return_counts=True)
    medians = [float(np.median(elevation[ring == value])) for value in values[counts >= FEWEST_POINTS][:MOST]]
    return Beams(elevations_deg=tuple(sorted(medians, reverse=True)), found_by=found_by) if medians else None


def _of_peaks(elevation: np.ndarray) -> Beams | None:
    low, high = np.percentile(elevation, (0.05, 99.95))
    counts, edges = np.histogram(elevation, np.arange(low - 1, high + 1, BIN_DEG))
    smooth = np.convolve(counts, (0.25, 0.5, 0.25), "same")
    peak = (smooth[1:-1] >= smooth[:-2]) & (smooth[1:-1] > smooth[2:])
    place = np.flatnonzero(peak) + 1
    most = np.array([smooth[max(0, at - 4) : at + 5].max() for at in place])
    place = place[(smooth[place] == most) & (smooth[place] > LEAST_SHARE * np.percentile(smooth[place], 90))]
    if not FEWEST <= len(place) < MOST:
        return None
    centres = (edges[place] + edges[place + 1]) / 2
    return Beams(elevations_deg=tuple(float(value) for value in centres[::-1]), found_by="peaks")
