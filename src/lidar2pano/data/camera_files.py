"""Calibrations of cameras as other programs write them, by content.

KITTI's (`calibration.read_calib`); YAML or JSON of ROS (camera_calibration's CameraInfo), OpenCV, Kalibr, Autoware's
toolkit, nuScenes' info files and PandaSet's calib/. A pose beside the camera is a matrix under one of the names of
POSES, in the file or in a second one: most of these tools calibrate a camera by itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano.calibration import Calibration, LensCalibration, is_camera_matrix, is_rotation, read_calib
from lidar2pano.errors import InputError
from lidar2pano.formats.yaml_files import read_document

# LiDAR -> camera, and camera -> LiDAR
POSES = ("T_camera_lidar", "T_cam_lidar", "lidar2cam", "cam_from_lidar")
INVERSE_POSES = ("T_lidar_camera", "T_lidar_cam", "cam2lidar", "CameraExtrinsicMat")
MATRICES = ("camera_matrix", "CameraMat", "cam2img", "K", "intrinsics", "camera_intrinsic")
COEFFICIENTS = ("distortion_coefficients", "distortion_coeffs", "DistCoeff", "D")
SIZES = (("image_width", "image_height"), ("width", "height"))
SIZE_PAIRS = ("resolution", "ImageSize", "size")
# names of distortion models in ROS, Kalibr and OpenCV -> of LensCalibration, and its most coefficients
MODELS = {
    "plumb_bob": ("brown", 5),
    "radtan": ("brown", 5),
    "rational_polynomial": ("brown", 8),
    "equidistant": ("fisheye", 4),
    "equi": ("fisheye", 4),
    "fisheye": ("fisheye", 4),
}
Entry = Mapping[str, Any]


def read_camera_calibration(
    path: Path, image: Path, size: tuple[int, int], pose: Path | None = None
) -> Calibration | LensCalibration:
    """Read the calibration of a camera whose image `image` is of `size` (width, height), in the frame of its LiDAR.

    pose  a second file with the pose, if the first has none.
    Of a file of several cameras it is the one with the name of the image's folder, or of the image.
    Raises InputError for an unreadable file, one without a camera, of another size, and for one without a pose.
    """
    if path.is_dir() or path.suffix.lower() == ".txt":
        return _kitti(path, image, size)
    entry = _entry(path, _read_document(path), image)
    T_camera_lidar = _pose(pose, _read_document(pose)) if pose else _pose(path, entry)
    if T_camera_lidar is None:
        raise InputError(
            f"{pose or path}: has no pose of the camera beside the LiDAR; add {POSES[0]}: [16 numbers], row by row, or"
            " name a file with it: IMAGE:CALIB:POSE"
        )
    return calibration_of(path, entry, image, size, T_camera_lidar)


def calibration_of(
    path: Path, entry: Entry, image: Path, size: tuple[int, int] | None, T_camera_lidar: np.ndarray
) -> Calibration | LensCalibration:
    """Return the camera of a calibration's entry for an image of `size` (width, height); path, image: for messages.

    size  None: as the entry says.
    Raises InputError for another size, no camera matrix, and an unknown distortion.
    """
    their_size = _size(path, entry)
    if (size := size or their_size) is None:
        raise InputError(f"{path}: says no size of its image; replace the calibration")
    K, first = camera_matrix(path, entry, short=True)
    if their_size != size:
        K, their_size = _of_part(path, entry, K, their_size)
    if their_size and their_size != size:
        raise _other_size(path, image, size, their_size)
    if not -1 < K[0, 2] < size[0] or not -1 < K[1, 2] < size[1]:
        raise _other_size(path, image, size, None)
    return _camera(path, entry, K, first, T_camera_lidar, size)


def _kitti(path: Path, image: Path, size: tuple[int, int]) -> Calibration:
    """Return KITTI's camera of the number in the image's folder: image_3, image_02/data; else 2."""
    number = next((name[-1] for part in reversed(image.resolve().parts) if (name := part).startswith("image_")), "2")
    calibration = read_calib(path, size, int(number) if number in "0123" else 2)
    (width, height), K = size, calibration.K
    if not 0 < K[0, 2] < width or not 0 < K[1, 2] < height:
        raise _other_size(path, image, size, None)
    return calibration


def _other_size(path: Path, image: Path, size: tuple[int, int], expected: tuple[int, int] | None) -> InputError:
    stated = f"is for {expected[0]}x{expected[1]}" if expected else "has its principal point outside"
    return InputError(f"{image}: is {size[0]}x{size[1]}, but {path} {stated}; name its own image")


def _read_document(path: Path) -> Entry:
    """Read a JSON or YAML file, OpenCV's YAML among them; InputError unless it holds names and values."""
    document = read_document(path, "name another calibration of a camera")
    if not isinstance(document, dict):
        raise InputError(f"{path}: holds no calibration of a camera; name a YAML or JSON file with one")
    return document


def _entry(path: Path, document: Entry, image: Path) -> Entry:
    """Return the part of a document about the camera of an image."""
    folder = image.resolve().parent.name
    cameras = document.get("cameras")
    if isinstance(cameras, dict):  # PandaSet
        return _named(path, cameras, folder)
    if isinstance(document.get("data_list"), list):  # nuScenes
        for sample in document["data_list"]:
            images = sample.get("images") if isinstance(sample, dict) else None
            for camera in images.values() if isinstance(images, dict) else ():
                if isinstance(camera, dict) and Path(str(camera.get("img_path"))).name == image.name:
                    return camera
        raise InputError(f"{path}: names no image {image.name!r}; take both from the data set")
    if any(name in document for name in MATRICES):
        return document
    named = {name: part for name, part in document.items() if isinstance(part, dict)}
    named = {name: part for name, part in named.items() if any(key in part for key in MATRICES)}
    return _named(path, named, folder)


def _named(path: Path, cameras: Entry, folder: str) -> Entry:
    entry = next(iter(cameras.values())) if len(cameras) == 1 else cameras.get(folder)
    if isinstance(entry, dict):
        return entry
    held = ", ".join(map(str, list(cameras)[:8]))
    holds = f"holds the cameras {held}, none is called like the image's folder {folder!r}" if held else "has no camera"
    raise InputError(f"{path}: {holds}; name a calibration of this camera")


def _numbers(path: object, name: str, value: Any) -> np.ndarray:  # noqa: ANN401
    """Return numbers in a row: of a list, of lists in a list, or of the `data` of a matrix."""
    value = value.get("data") if isinstance(value, dict) else value
    try:
        numbers = np.array(value, dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: {name}: holds no numbers; replace the calibration") from error
    if not np.isfinite(numbers).all() or numbers.size > 64:
        raise InputError(f"{path}: {name}: is missing, or holds no finite numbers; replace the calibration")
    return numbers


def _first(entry: Entry, names: Sequence[str]) -> str:
    return next((name for name in names if entry.get(name) is not None), "")


def _size(path: Path, entry: Entry) -> tuple[int, int] | None:
    """Return (width, height) of a calibration, if it states them."""
    values = [entry.get(name) for pair in SIZES if pair[0] in entry for name in pair]
    if not values and (name := _first(entry, SIZE_PAIRS)):
        values = _numbers(path, name, entry[name]).tolist()
    if len(values) != 2:
        return None
    width, height = _numbers(path, "size", values).tolist()
    return round(width), round(height)


def camera_matrix(path: object, entry: Entry, *, short: bool = False) -> tuple[np.ndarray, list[float]]:
    """Return K (3, 3) float64, and Kalibr's xi if it comes before it; InputError, with `path`, if there is none.

    short  whether fx, fy, cx and cy without names may stand for it, as Kalibr writes them.
    """
    name = _first(entry, MATRICES) or MATRICES[0]
    value = entry.get(name)
    if isinstance(value, dict) and "fx" in value:  # PandaSet
        value, short = [value.get(key) for key in ("fx", "fy", "cx", "cy")], True
    numbers = _numbers(path, name, value).tolist()
    first = [numbers.pop(0)] if short and len(numbers) == 5 else []
    if short and len(numbers) == 4:
        fx, fy, cx, cy = numbers
        numbers = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    K = np.array(numbers).reshape(3, 3) if len(numbers) == 9 else np.zeros((3, 3))
    if not is_camera_matrix(K):
        raise InputError(f"{path}: {name}: is no camera matrix (fx s cx, 0 fy cy, 0 0 1); replace the calibration")
    return K / K[2, 2], first


def _of_part(
    path: Path, entry: Entry, K: np.ndarray, size: tuple[int, int] | None
) -> tuple[np.ndarray, tuple[int, int] | None]:
    """Return K and the size of images that show a part of a camera's, their pixels the means of several.

    sensor_msgs/CameraInfo: K is of the full image; `roi` is cut out of it first, then `binning_x` x `binning_y` of its
    pixels become one, whose centre is theirs.
    """
    region = entry.get("roi")
    names = ("x_offset", "y_offset", "width", "height")
    values = [region.get(name) or 0 for name in names] if isinstance(region, dict) else [0, 0, 0, 0]
    left, top, *part = _numbers(path, "roi", values).tolist()
    bins = _numbers(path, "binning", [entry.get("binning_x") or 1, entry.get("binning_y") or 1]).clip(min=1)
    bin_width, bin_height = bins.tolist()
    to_part = [
        [1 / bin_width, 0, (0.5 - left) / bin_width - 0.5],
        [0, 1 / bin_height, (0.5 - top) / bin_height - 0.5],
        [0, 0, 1],
    ]
    part = part if all(part) else size
    return np.array(to_part) @ K, (int(part[0] // bin_width), int(part[1] // bin_height)) if part else None


def _pose(path: Path, entry: Entry) -> np.ndarray | None:
    """Return T_camera_lidar (4, 4), None if there is none."""
    name = _first(entry, (*POSES, *INVERSE_POSES))
    if not name:
        return None
    T = read_motion(path, entry, name, (12, 16))
    return np.linalg.inv(T) if name in INVERSE_POSES else T


def read_motion(path: Path, entry: Any, name: str, sizes: tuple[int, ...] = (16,)) -> np.ndarray:  # noqa: ANN401
    """Return the motion (4, 4) float64 under a name, of so many numbers; InputError if it is missing or none."""
    numbers = _numbers(path, name, entry.get(name) if isinstance(entry, dict) else None)
    if numbers.size not in sizes:
        raise InputError(f"{path}: {name}: must hold 16 numbers (4x4), it has {numbers.size}")
    T = np.vstack([numbers[:12].reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
    if not is_rotation(T[:3, :3]):
        raise InputError(f"{path}: {name}: holds no rotation; replace the calibration")
    return T


def _camera(
    path: Path, entry: Entry, K: np.ndarray, first: list[float], T_camera_lidar: np.ndarray, size: tuple[int, int]
) -> Calibration | LensCalibration:
    """Return the camera with its lens; without distortion it is a pinhole."""
    name = _first(entry, COEFFICIENTS)
    coefficients = _numbers(path, name, entry[name]).tolist() if name else []
    while coefficients and not coefficients[-1]:
        coefficients.pop()
    if not coefficients and not first:
        return Calibration(K=K, T_camera_lidar=T_camera_lidar, size=size)
    called = str(entry.get("distortion_model") or ("fisheye" if entry.get("fisheye_model") else "rational_polynomial"))
    model, most = MODELS.get(called, ("", 0))
    if len(coefficients) > most or (first and model != "brown"):
        raise InputError(
            f"{path}: distortion model {called!r} with {len(coefficients)} coefficients is not known; undistort the"
            f" images, or give one of {', '.join(MODELS)}"
        )
    least = {"fisheye": 4, "brown": 4 if len(coefficients) <= 4 else 5 if len(coefficients) == 5 else 8}[model]
    coefficients += [0.0] * (least - len(coefficients))
    if first:
        model, coefficients = "mei", [*first, *coefficients[:4]]
    try:
        return LensCalibration(
            K=K,
            T_camera_lidar=T_camera_lidar,
            size=size,
            model=model,  # pyright: ignore[reportArgumentType] of MODELS
            distortion=tuple(coefficients),
        )
    except ValueError as error:
        raise InputError(f"{path}: {error}; name another calibration") from None
