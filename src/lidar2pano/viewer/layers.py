"""The layers of a panorama as images for browsers, and its points in a few bytes each."""

from __future__ import annotations

import io
import zlib
from dataclasses import dataclass

import numpy as np
from PIL import Image

NEAREST_M, FARTHEST_M = 1.0, 256.0  # depths of the codes 1 and 255; equal steps of the logarithm, 2.2 % each
STEPS = 254
CONFIDENCE_STEPS = 20  # of 5 %: finer ones would be noise, and large in any coding
CENTIMETRE = 0.01  # of point coordinates: they reach 327 m
FEW_FRAMES = 4  # so many are coded exactly
MOST_FRAMES = 60  # on a page with more, every image is coarser
MANY_POINTS = 3000  # of a scan, on a page with more than MOST_FRAMES
MOST_POINTS = 1_200_000  # of a page with fewer: those of ten scans


@dataclass(frozen=True, slots=True, kw_only=True)
class Coding:
    """Bounds of a frame's bytes.

    quality      of WebP for colours, 0 .. 100; None: PNG, without loss.
    coarser      panorama pixels per pixel of the colours and classes, in either direction.
    depth_coarser  likewise of the depth and the confidence.
    points       of a scan, at most.
    """

    quality: int | None
    coarser: int
    depth_coarser: int
    points: int


def coding_for(frames: int) -> Coding:
    """Return the coding of a page with so many frames: exact for few; about 30 MB for 300 frames."""
    if frames > MOST_FRAMES:
        return Coding(quality=65, coarser=2, depth_coarser=4, points=MANY_POINTS)
    points = MOST_POINTS // max(frames, 1)
    if frames > FEW_FRAMES:
        return Coding(quality=70, coarser=1, depth_coarser=2, points=points)
    return Coding(quality=None, coarser=1, depth_coarser=1, points=points)


def colour_image(colour: np.ndarray, coding: Coding) -> tuple[bytes, str]:
    """Return (bytes, MIME type) of colours (h, w, 3 or 4) uint8; the fourth channel is opacity."""
    image = Image.fromarray(colour)
    if coding.coarser > 1:
        image = image.resize(_coarser(colour, coding.coarser), Image.Resampling.BOX)
    if coding.quality is None:
        return _coded(image, "PNG", compress_level=6), "image/png"
    return _coded(image, "WEBP", quality=coding.quality, method=4), "image/webp"


def class_image(segments: np.ndarray, coding: Coding) -> tuple[bytes, str]:
    """Return (bytes, MIME type) of class ids (h, w) uint8, as grey values, exact."""
    return _codes(segments, coding.coarser)


def depth_image(depth_m: np.ndarray, coding: Coding) -> tuple[bytes, str]:
    """Return (bytes, MIME type) of depths (h, w) in metres, as `depth_codes`."""
    return _codes(depth_codes(depth_m), coding.depth_coarser)


def confidence_image(confidence: np.ndarray, coding: Coding) -> tuple[bytes, str]:
    """Return (bytes, MIME type) of confidences (h, w) in [0, 1], in CONFIDENCE_STEPS."""
    return _codes(np.round(confidence * CONFIDENCE_STEPS).astype(np.uint8), coding.depth_coarser)


def depth_codes(depth_m: np.ndarray) -> np.ndarray:
    """Return codes uint8 of depths in metres: 0 = none, 1 = NEAREST_M, 255 = FARTHEST_M, equal steps of the logarithm.

    Depths out of range take its ends.
    """
    inside = np.clip(depth_m, NEAREST_M, FARTHEST_M, dtype=np.float64)
    steps = np.round(np.log(inside / NEAREST_M) * (STEPS / np.log(FARTHEST_M / NEAREST_M)))
    return np.where(depth_m > 0, steps + 1, 0).astype(np.uint8)


def point_bytes(xyz: np.ndarray, coding: Coding) -> tuple[bytes, int, int]:
    """Return (bytes, points in them, usable points) of points (N, 3) in metres: `coding.points` at most, evenly chosen.

    Usable are finite points within 327 m, but for the sensor's origin, the mark of no echo. They are whole centimetres,
    each the difference from the point before, in six planes (low and high bytes of x, of y, of z), compressed by zlib.
    """
    centimetres = np.round(xyz.astype(np.float64) / CENTIMETRE)
    centimetres = centimetres[(np.abs(centimetres) < 1 << 15).all(axis=1) & centimetres.any(axis=1)]  # NaN is not less
    usable = len(centimetres)
    if usable > coding.points:
        centimetres = centimetres[np.linspace(0, usable - 1, coding.points).astype(np.int64)]
    steps = np.diff(centimetres.astype("<i2"), axis=0, prepend=np.zeros((1, 3), dtype="<i2"))  # wraps, as the sum does
    planes = np.ascontiguousarray(steps.T).view(np.uint8).reshape(3, -1, 2).transpose(0, 2, 1)
    return zlib.compress(planes.tobytes(), 6), len(centimetres), usable


def _codes(codes: np.ndarray, coarser: int) -> tuple[bytes, str]:
    part = np.ascontiguousarray(codes[coarser // 2 :: coarser, coarser // 2 :: coarser])
    return _coded(Image.fromarray(part).convert("RGB"), "WEBP", lossless=True, quality=50, method=2), "image/webp"


def _coarser(values: np.ndarray, factor: int) -> tuple[int, int]:
    return max(values.shape[1] // factor, 1), max(values.shape[0] // factor, 1)


def _coded(image: Image.Image, form: str, **settings: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, form, **settings)
    return buffer.getvalue()
