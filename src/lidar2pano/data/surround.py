"""Surround frames: one scan and the cameras all around it, whatever data set they come from."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from lidar2pano.calibration import ROTATION_TOLERANCE, Calibration
from lidar2pano.errors import InputError
from lidar2pano.geometry.compose import Photo
from lidar2pano.scan import Scan

# From a frame with x to the right and y forward, as PandaSet and nuScenes have it, to ours: x forward, y left.
FROM_RIGHT_FORWARD = np.array([[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SurroundFrame:
    """One moment: a scan and what the cameras all around saw.

    name    "seq/NNNNNN" or the like, also the scan's.
    scan    in our sensor frame (x forward, y left, z up, the sensor at the origin), with labels where there are any.
    photos  by camera, in the data set's order.
    front   the name of the camera that looks ahead.
    pose    (4, 4) float64: our sensor frame -> the data set's world, metres.
    """

    name: str
    scan: Scan
    photos: Mapping[str, Photo]
    front: str
    pose: np.ndarray

    def __post_init__(self) -> None:
        """Refuse a front camera that is not there (ValueError)."""
        if self.front not in self.photos:
            raise ValueError(f"{self.name}: no camera {self.front!r} among {', '.join(self.photos)}")


def read_json(path: Path) -> Any:
    """The contents of a JSON file; InputError where it is missing or no JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); complete the data set") from error
    except ValueError as error:
        raise InputError(f"{path}: is no JSON ({error}); replace it") from error


def read_photo(
    path: Path, K: np.ndarray, T_camera_lidar: np.ndarray, own_car: Sequence[tuple[float, float]] = ()
) -> Photo:
    """Read a camera's picture; `own_car`: pixels (u, v), u rising, below whose line the picture shows its own car.

    InputError where the picture is missing or damaged, and where the matrices are none of a camera.
    """
    try:
        with Image.open(path) as file:
            picture = np.array(file.convert("RGB"))
    except FileNotFoundError as error:
        raise InputError(f"{path}: is missing; complete the data set") from error
    except (OSError, UnidentifiedImageError) as error:
        raise InputError(f"{path}: is no readable picture; replace it") from error
    height, width = picture.shape[:2]
    calibration = Calibration(K=K, T_camera_lidar=T_camera_lidar, size=(width, height))
    clear = None
    if own_car:
        u, v = np.array(own_car).T
        clear = np.arange(height)[:, None] < np.interp(np.arange(width), u, v)
    return Photo(picture=picture, calibration=calibration, clear=clear)


def matrix(path: Path, entry: Mapping[str, Any], name: str, shape: tuple[int, int]) -> np.ndarray:
    """The matrix `name` of a JSON file's entry, float64; InputError where it is missing or not of this shape.

    A (4, 4) must be a motion: a rotation and a translation.
    """
    try:
        values = np.array(entry[name], dtype=np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: holds no matrix {name!r}; take the file from the data set") from error
    if values.shape != shape or not np.isfinite(values).all():
        raise InputError(f"{path}: {name!r} must be {shape[0]}x{shape[1]} finite numbers, it is {values.shape}")
    if shape == (4, 4):
        R = values[:3, :3]
        if np.linalg.det(R) < 0 or not np.allclose(R @ R.T, np.eye(3), atol=ROTATION_TOLERANCE):
            raise InputError(f"{path}: {name!r} holds no rotation; take the file from the data set")
    return values


def moved(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Points (N, 3) float32 in the frame that T (4, 4) leads to, float32; computed in float64."""
    return (points.astype(np.float64) @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
