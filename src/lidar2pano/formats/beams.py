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
BACK_DEG = 10.0  # steps back beyond parallax, which a vehicle's motion makes in scans that were corrected for it
ROUNDING = 1e-6  # of a turn: equal angles differ by less
WIDEST_DEG = 0.5  # between the quartiles of a beam's elevations
NEAR_DEG = 2.0  # elevations of a sensor's outermost beams agree so well
HIDDEN, HIDDEN_DEG = 4, 6.5  # or so many are missing: they met the sky or the vehicle alone; a Pandar64 has gaps of 6
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
        return self._like(NEAR_DEG) or self._like(HIDDEN_DEG)  # the vehicle hides beams more seldom than the sky

    def _like(self, hidden_below_deg: float) -> str:
        """Return the names for beams with no more than so many degrees missing at the lower end."""
        highest_deg, lowest_deg, beams = self.elevations_deg[0], self.elevations_deg[-1], len(self.elevations_deg)
        return " or ".join(
            name
            for name, (count, highest, lowest) in SENSORS.items()
            if -0.04 * count <= count - beams <= HIDDEN
            and -NEAR_DEG < highest - highest_deg < (NEAR_DEG if beams >= count else HIDDEN_DEG)
            and -NEAR_DEG < lowest_deg - lowest < (NEAR_DEG if beams >= count else hidden_below_deg)
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
    if ring is not None:
        _, elevations_deg = _of_rings(points, ring[near])
        return Beams(elevations_deg=elevations_deg, found_by="ring") if elevations_deg else None
    if beams := _by_turns(points):
        return beams
    if sharpness(points, np.zeros(3)) < GATHERED:
        return None
    return _of_peaks(_elevations(points))


def _elevations(xyz: np.ndarray, height_m: float = 0.0) -> np.ndarray:
    """Return the elevations (N,) of points (N, 3), seen from so high, in degrees, float64; copies one coordinate."""
    elevation = np.hypot(xyz[:, 0], xyz[:, 1], dtype=np.float64)
    np.arctan2(xyz[:, 2] - height_m, elevation, out=elevation)
    return np.degrees(elevation, out=elevation)


def _by_turns(xyz: np.ndarray) -> Beams | None:
    """Return the beams of a file that holds one after the other; None for another order, and points on no cones.

    A beam starts where the first one does, or ends where the last one does: the highest may see the sky alone there.
    """
    if (turned := _turned(xyz)) is None:
        return None
    starts = (turned[0] - ROUNDING, turned[-1] + ROUNDING)
    width_deg, elevations_deg = min(_of_rings(xyz, np.floor(turned - start).astype(np.int16)) for start in starts)
    return Beams(elevations_deg=elevations_deg, found_by="file order") if width_deg < WIDEST_DEG else None


def _turned(xyz: np.ndarray) -> np.ndarray | None:
    """Return how many turns (N,) a head had made at each point; None if a file's order is not that of the beams' turns.

    It turns one way only: a step back of more than BACK_DEG is the rest of a turn, to the next beam's start.
    """
    step = np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0], dtype=np.float64))
    step[1:] = np.diff(step)
    step[0] = 0.0
    if np.count_nonzero(step < 0) > np.count_nonzero(step > 0):  # clockwise
        np.negative(step, out=step)
    step += BACK_DEG
    step %= 360
    step -= BACK_DEG
    small = (np.abs(step) < ORDERED_DEG).mean()
    np.cumsum(step, out=step)
    step /= 360
    return step if FEWEST <= step[-1] + 1 < MOST and small + step[-1] / len(step) > ORDERED else None


def _of_rings(xyz: np.ndarray, ring: np.ndarray) -> tuple[float, tuple[float, ...]]:
    """Return the median of the beams' widths in degrees, and their elevations, if any; `ring`: (N,) their numbers."""
    values, counts = np.unique(ring, return_counts=True)
    sparse = slice(None, None, 1 + len(xyz) // BLOCK)
    elevation = _elevations(xyz, _height_of_cones(xyz[sparse], ring[sparse]))
    chosen = values[counts >= FEWEST_POINTS][:MOST]
    if not len(chosen):
        return np.inf, ()
    low, middle, high = np.array([np.percentile(elevation[ring == beam], (25, 50, 75)) for beam in chosen]).T
    return float(np.median(high - low)), tuple(sorted(middle.tolist(), reverse=True))


def _height_of_cones(xyz: np.ndarray, ring: np.ndarray) -> float:
    """Return the height h in metres of the cones' common apex above the origin: least squares of z = h + slope x range.

    Beams begin at lenses, .12 to .21 m above the origin of KITTI's HDL-64E. The slopes, one a beam, are eliminated.
    """
    number = np.unique(ring, return_inverse=True)[1]
    distance, z = np.hypot(xyz[:, 0], xyz[:, 1], dtype=np.float64), xyz[:, 2].astype(np.float64)
    to_first, height = np.bincount(number, distance), np.bincount(number, z)
    share = to_first / np.maximum(np.bincount(number, distance**2), 1e-9)
    weights = np.bincount(number) - share * to_first
    return float((height - share * np.bincount(number, distance * z)).sum() / max(weights.sum(), 1e-9))


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
