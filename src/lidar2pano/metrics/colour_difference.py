"""Colour differences as people see them: CIE Lab of sRGB, CIEDE2000, and the colours of classes in two images."""

from __future__ import annotations

import numpy as np

from lidar2pano.labels import COMMON15
from lidar2pano.metrics.accumulation import FrameMetric

# IEC 61966-2-1: linear sRGB -> XYZ; the white point is D65
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
WHITE = TO_XYZ.sum(1)
KNEE, SLOPE = (6 / 29) ** 3, (29 / 6) ** 2 / 3  # of Lab's cube root, which is a line below
FAR = 25.0**7  # CIEDE2000's bound of chroma


def linear_light(codes: np.ndarray) -> np.ndarray:
    """Return light in [0, 1], float64, of sRGB's codes in [0, 255] (any shape)."""
    share = np.asarray(codes, dtype=np.float64) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def lab(light: np.ndarray) -> np.ndarray:
    """Return CIE Lab (..., 3) of linear sRGB (..., 3) in [0, 1]."""
    share = np.asarray(light) @ TO_XYZ.T / WHITE
    x, y, z = np.moveaxis(np.where(share > KNEE, np.cbrt(share), SLOPE * share + 4 / 29), -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


# Sharma, Wu, Dalal 2005, "The CIEDE2000 color-difference formula", equations 2 to 22; all weights are 1.
def ciede2000(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the differences (...) of colours in CIE Lab (..., 3) each."""
    (l1, a1, b1), (l2, a2, b2) = (np.moveaxis(np.asarray(part, dtype=np.float64), -1, 0) for part in (first, second))
    chroma7 = ((np.hypot(a1, b1) + np.hypot(a2, b2)) / 2) ** 7
    stretch = 1.5 - 0.5 * np.sqrt(chroma7 / (chroma7 + FAR))
    c1, c2 = np.hypot(stretch * a1, b1), np.hypot(stretch * a2, b2)
    h1, h2 = (np.degrees(np.arctan2(b, stretch * a)) % 360 for a, b in ((a1, b1), (a2, b2)))
    grey = c1 * c2 == 0
    turn = np.where(grey, 0.0, (h2 - h1 + 180) % 360 - 180)
    turn = np.where((turn == -180) & (h2 > h1), 180.0, turn)
    delta_l, delta_c = l2 - l1, c2 - c1
    delta_h = 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn) / 2)
    lightness, c = (l1 + l2) / 2, (c1 + c2) / 2
    apart = np.abs(h1 - h2) > 180
    h = np.where(grey, h1 + h2, (h1 + h2 + np.where(apart, np.where(h1 + h2 < 360, 360, -360), 0)) / 2)
    t = 1 - 0.17 * _cos(h - 30) + 0.24 * _cos(2 * h) + 0.32 * _cos(3 * h + 6) - 0.20 * _cos(4 * h - 63)
    rotation = 60 * np.exp(-(((h - 275) / 25) ** 2))
    s_l = 1 + 0.015 * (lightness - 50) ** 2 / np.sqrt(20 + (lightness - 50) ** 2)
    s_c, s_h = 1 + 0.045 * c, 1 + 0.015 * c * t
    r_t = -np.sin(np.radians(rotation)) * 2 * np.sqrt(c**7 / (c**7 + FAR))
    parts = delta_l / s_l, delta_c / s_c, delta_h / s_h
    return np.sqrt(parts[0] ** 2 + parts[1] ** 2 + parts[2] ** 2 + r_t * parts[1] * parts[2])


def _cos(degrees: np.ndarray) -> np.ndarray:
    return np.cos(np.radians(degrees))


class ClassColourError(FrameMetric):
    """CIEDE2000 between the mean light of each class in two images; the mean over classes, by their pixels."""

    def __init__(self) -> None:
        names = COMMON15.classes
        super().__init__(*(f"{kind} {name}" for name in names for kind in ("difference", "pixels")))

    def update(self, predicted: np.ndarray, target: np.ndarray, classes: np.ndarray, name: str) -> None:
        """Count the image `name`: (H, W, 3) uint8 both, and the classes (H, W) uint8 of COMMON15; 0 does not count."""
        if predicted.shape != target.shape or classes.shape != target.shape[:2]:
            raise ValueError(f"images {predicted.shape}, {target.shape} and classes {classes.shape} differ in size")
        light = [linear_light(image[classes > 0]) for image in (predicted, target)]
        ids, sums = classes[classes > 0], []
        for index in range(len(COMMON15)):
            chosen = ids == index
            pixels = int(chosen.sum())
            difference = float(ciede2000(*(lab(part[chosen].mean(0)) for part in light))) if pixels else 0.0
            sums += [difference * pixels, float(pixels)]
        self._keep(name, *sums)

    def values_of(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """Return the mean, and the means of each class."""
        differences, pixels = sums[..., 0::2], sums[..., 1::2]
        with np.errstate(invalid="ignore", divide="ignore"):
            values = {"class colour error": differences.sum(-1) / pixels.sum(-1)}
            return values | {
                f"class colour error {name}": differences[..., index] / pixels[..., index]
                for index, name in enumerate(COMMON15.classes)
            }
