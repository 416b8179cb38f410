"""The beams of a spinning LiDAR, the sensor with such beams, and the point from where they are sharp cones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

NEAR_M = 2.0  # nearer points blur: a beam begins some centimetres from the sensor's origin
BIN_DEG = 0.02  # of the histogram, whose peaks are beams
GATHERED = 1.6  # sharpness of elevations at beams
LEAST_SHARE = 0.1  # of the median peak's points: smaller peaks are chance
FEWEST, MOST = 4, 300  # beams of a sensor
FEWEST_POINTS = 20  # of a beam
ORDERED = 0.97  # share of steps below ORDERED_DEG along a file of one beam after the other
ORDERED_DEG = 3.0
WRAP_DEG = 180.0
WIDEST_DEG = 0.5  # between the quartiles of a beam's elevations
NEAR_DEG = 2.0  # elevations of a sensor's outermost beams agree so well
SKY_DEG = 6.0  # or the highest with returns lies so far below, if a beam above it saw the sky only
# Of the search for the sensor's place.
CONE_BIN_DEG, SMOOTH = 0.05, 31  # of the histogram of elevations, and of the smoothed one it is compared with
MOST_DEG = 35.0
SAMPLE = 15_000
BLOCK = 1 << 17  # points at a time, so that copies stay small
START_M, LAST_M = 0.5, 0.03  # steps of the search
REACH_M = 3.0  # it goes no farther from the start
CLEARLY = 1.1  # times as sharp as the start
CONE_NEAR_M, CONE_FAR_M = 5.0, 80.0  # of the points used: nearer ones blur with the beam's own offsets
DIRECTIONS = 12  # of halving the points
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
        """Return the names of the sensors of SENSORS with such beams, "" if there is none."""
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
    """Return the beams of a scan (N, 3) in metres, from the sensor's origin; None if it does not show any.

    ring  (N,) integer number of each point's beam, if known.
    """
    with np.errstate(invalid="ignore"):
        near = np.linalg.norm(xyz, axis=1) > NEAR_M
    points = xyz[near]
    if len(points) < FEWEST_POINTS * FEWEST:
        return None
    elevation = _elevations(points)
    if ring is not None:
        return _of_rings(elevation, ring[near], "ring")
    if (number := _numbers_by_turn(points)) is not None:
        width = [np.ptp(np.percentile(elevation[number == turn], (25, 75))) for turn in range(int(number[-1]) + 1)]
        if np.median(width) < WIDEST_DEG:
            return _of_rings(elevation, number, "file order")
    if sharpness(points, np.zeros(3)) < GATHERED:
        return None
    return _of_peaks(elevation)


def _elevations(xyz: np.ndarray) -> np.ndarray:
    """Return the elevations (N,) of points (N, 3) in degrees, float64, in the memory of the result alone."""
    elevation = np.hypot(xyz[:, 0], xyz[:, 1], dtype=np.float64)
    np.arctan2(xyz[:, 2], elevation, out=elevation)
    return np.degrees(elevation, out=elevation)


def _numbers_by_turn(xyz: np.ndarray) -> np.ndarray | None:
    """Return the numbers (N,) of beams of a file that holds one beam after the other; None for another order."""
    turn = np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0], dtype=np.float64))
    turn -= turn[0]
    turn %= 360
    turn = np.diff(turn)
    np.abs(turn, out=turn)
    wraps = turn > WRAP_DEG
    wraps &= np.diff(np.flatnonzero(wraps), prepend=-len(wraps)).min(initial=len(wraps)) >= FEWEST_POINTS
    if not FEWEST <= wraps.sum() < MOST or (turn < ORDERED_DEG)[~wraps].mean() <= ORDERED:
        return None
    return np.cumsum(np.concatenate([[False], wraps]), dtype=np.int16)


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
    most = np.array([smooth[max(0, peak_bin - 4) : peak_bin + 5].max() for peak_bin in place])
    place = place[(smooth[place] == most) & (smooth[place] > LEAST_SHARE * np.percentile(smooth[place], 90))]
    if not FEWEST <= len(place) < MOST:
        return None
    centres = (edges[place] + edges[place + 1]) / 2
    return Beams(elevations_deg=tuple(float(value) for value in centres[::-1]), found_by="peaks")


def sharpness(xyz: np.ndarray, origin: np.ndarray) -> float:
    """Return how much elevations of points (N, 3) from `origin` gather at few values; 1 for not at all."""
    edges = np.arange(-MOST_DEG, MOST_DEG, CONE_BIN_DEG)
    blocks = (xyz[first : first + BLOCK] for first in range(0, len(xyz), BLOCK))
    counts = sum((np.histogram(_elevations(block - origin), edges)[0] for block in blocks), np.zeros(len(edges) - 1))
    smooth = np.convolve(counts, np.ones(SMOOTH) / SMOOTH, "same")
    return float((counts @ counts) / max(counts @ smooth, 1.0))


def sharpest_origin(xyz: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return the sharpest origin (3,) near `start`, by a pattern search; `start` itself if none is clearly sharper."""
    distance = np.linalg.norm(xyz - start, axis=1)
    sample = xyz[(distance > CONE_NEAR_M) & (distance < CONE_FAR_M)]
    sample = sample[:: max(1, len(sample) // SAMPLE)]
    steps = np.arange(-REACH_M / 2, REACH_M / 2 + 0.01, START_M / 2)
    first = sharpness(sample, start)
    best, score = max(
        ((start + (x, 0, z), sharpness(sample, start + (x, 0, z))) for x in steps for z in steps[::2]),
        key=lambda candidate: candidate[1],
    )
    step = START_M / 2
    while step >= LAST_M:
        origins = [best + step * np.eye(3)[axis] * sign for axis in range(3) for sign in (-1, 1)]
        scores = [sharpness(sample, origin) for origin in origins]
        if max(scores) > score:
            best, score = origins[int(np.argmax(scores))], max(scores)
        else:
            step /= 2
    return best if score > CLEARLY * first and np.abs(best - start).max() <= REACH_M else start


def horizontal_centre(xyz: np.ndarray) -> np.ndarray:
    """Return the point (3,) halving the points (N, 3) along every direction, at the height of the lower ones.

    A LiDAR takes as many points on one side of any line through it as on the other: it stands near that point.
    """
    azimuth = np.linspace(0, np.pi, DIRECTIONS, endpoint=False)
    across = np.column_stack([np.cos(azimuth), np.sin(azimuth)])
    middle = np.median(xyz, axis=0)
    local = xyz[:, :2] - middle[:2]
    medians = [np.median(local @ direction) for direction in across]
    centre = np.linalg.lstsq(across, np.array(medians), rcond=None)[0]
    return np.array([*(middle[:2] + centre), np.percentile(xyz[:, 2], 10)])
