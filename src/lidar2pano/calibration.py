"""Calibration: a camera, with or without a distorting lens, and its pose in the LiDAR frame; KITTI's files."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from lidar2pano.bounded_files import MOST_CALIBRATION_BYTES, read_text
from lidar2pano.errors import InputError

ROTATION_TOLERANCE = 1e-3  # of R R^T from 1; KITTI writes 7 to 13 digits
FARTHEST_CAMERA_M = 1000.0  # from the LiDAR
LARGEST_PX = 1e7  # of a focal length or a principal point
# KITTI's forms: rows of the camera's projection; of the rotation that rectifies camera 0; of LiDAR -> camera 0.
# In turn: odometry's calib.txt, the object and tracking benchmarks', a raw drive's, KITTI-360's.
PROJECTIONS = ("P{0}", "P_rect_0{0}", "P_rect_00")
RECTIFICATIONS = ("R0_rect", "R_rect", "R_rect_00")
RIGIDS = ("Tr_velo_to_cam", "Tr_velo_cam")
# Calibrations in two files: the camera's, and the LiDAR's.
PAIRS = (("calib_cam_to_cam.txt", "calib_velo_to_cam.txt"), ("perspective.txt", "calib_cam_to_velo.txt"))
WHOLE = ("calib.txt", PAIRS[0][0], PAIRS[1][0])  # looked for in a folder, and in the one above
ROW = re.compile(r"(?:([A-Za-z]\w*)\s*:?\s)?\s*(.*)")  # the tracking benchmark leaves out colons
NEWTON_STEPS, NEWTON_TOLERANCE = 12, 1e-9  # of a lens's inverse; the tolerance is in focal lengths


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibration:
    """A rectified pinhole camera. pixel (u, v, 1) ~ K (R x + t), with u to the right and v down, centres at integers.

    K                (3, 3) float64, pixels.
    T_camera_lidar   (4, 4) float64: LiDAR coordinates -> camera (x right, y down, z ahead), metres.
    size             (width, height) of the image in pixels.
    """

    K: np.ndarray
    T_camera_lidar: np.ndarray
    size: tuple[int, int]

    def __post_init__(self) -> None:
        """Refuse matrices of another shape, and images without pixels (ValueError)."""
        if self.K.shape != (3, 3) or self.T_camera_lidar.shape != (4, 4):
            raise ValueError(f"Calibration: K (3, 3), T (4, 4), got {self.K.shape}, {self.T_camera_lidar.shape}")
        if min(self.size) < 1:
            raise ValueError(f"Calibration.size must be positive, got {self.size}")

    @property
    def centre(self) -> tuple[float, float, float]:
        """The optical centre in the LiDAR frame, metres."""
        return _optical_centre(self.T_camera_lidar)

    def scaled(self, factor: float) -> Calibration:
        """Return the same camera with an image `factor` times as wide and high (pixel centres kept at integers)."""
        K = self.K.copy()
        K[:2, 2] += 0.5
        K[:2] *= factor
        K[:2, 2] -= 0.5
        width, height = round(self.size[0] * factor), round(self.size[1] * factor)
        return Calibration(K=K, T_camera_lidar=self.T_camera_lidar, size=(width, height))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LensCalibration:
    """A camera with a distorting lens. K, T_camera_lidar and size are as in Calibration.

    model        "brown": pinhole with radial and tangential distortion (cv2.calibrateCamera).
                 "fisheye": Kannala and Brandt 2006 (cv2.fisheye.calibrate); may look farther than 90 degrees aside.
                 "mei": unified projection, Mei and Rives 2007 (cv2.omnidir.calibrate, CamOdoCal); likewise. A unit
                 vector (x, y, z) goes to (x, y) / (z + xi), distorted as by "brown" and multiplied by K.
    distortion   "brown": (k1, k2, p1, p2[, k3[, k4, k5, k6]]), the last three of a denominator;  "fisheye":
                 (k1, k2, k3, k4);  "mei": (xi, k1, k2, p1, p2), xi >= 0.
    reach_deg    the image circle: the largest angle from the optical axis, degrees, within the lens's image.
    """

    K: np.ndarray
    T_camera_lidar: np.ndarray
    size: tuple[int, int]
    model: Literal["brown", "fisheye", "mei"]
    distortion: tuple[float, ...]
    reach_deg: float = 180.0

    def __post_init__(self) -> None:
        """Refuse wrong matrices and sizes, other models, wrong coefficients and an impossible reach (ValueError)."""
        Calibration(K=self.K, T_camera_lidar=self.T_camera_lidar, size=self.size)
        counts = {"brown": (4, 5, 8), "fisheye": (4,), "mei": (5,)}.get(self.model)
        if counts is None or len(self.distortion) not in counts:
            raise ValueError(
                "LensCalibration: model 'brown' has 4, 5 or 8 coefficients, 'fisheye' 4, 'mei' 5;"
                f" got {self.model!r} with {len(self.distortion)}"
            )
        if self.model == "mei" and self.distortion[0] < 0:
            raise ValueError(f"LensCalibration: xi, the first of 'mei', must be >= 0, got {self.distortion[0]}")
        if not 0 < self.reach_deg <= 180:
            raise ValueError(f"LensCalibration.reach_deg must be above 0 and up to 180, got {self.reach_deg}")

    @property
    def centre(self) -> tuple[float, float, float]:
        """The optical centre in the LiDAR frame, metres."""
        return _optical_centre(self.T_camera_lidar)

    @property
    def focal_px(self) -> float:
        """Pixels (of u) per radian on the optical axis."""
        return float(self.K[0, 0]) / (1 + self.distortion[0] if self.model == "mei" else 1)

    def rays(self) -> np.ndarray:
        """Unit vectors (height, width, 3) float64 of the pixel centres, camera axes; NaN if nothing is projected."""
        width, height = self.size
        v, u = np.mgrid[0:height, 0:width].astype(np.float64)
        x, y, _ = np.moveaxis(np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(self.K).T, -1, 0)
        undistort = {"brown": _undistorted_brown, "fisheye": _undistorted_fisheye, "mei": _undistorted_mei}[self.model]
        rays = undistort(x, y, np.array(self.distortion, dtype=np.float64))
        rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return np.where(self._reached(rays)[..., None], rays, np.nan)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return pixels (u, v), (..., 2) float64, of points or directions (..., 3), camera axes: the inverse of `rays`.

        NaN if the lens projects nothing; a pixel may lie outside the image.
        """
        points = points.astype(np.float64)
        with np.errstate(all="ignore"):  # NaN if not projected
            unit = points / np.linalg.norm(points, axis=-1, keepdims=True)
            x, y, z = np.moveaxis(unit, -1, 0)
            distort = {"brown": _projected_brown, "fisheye": _projected_fisheye, "mei": _projected_mei}[self.model]
            places = distort(x, y, z, np.array(self.distortion, dtype=np.float64))
        places = np.where(self._reached(unit)[..., None], places, np.nan)
        return (places @ self.K[:2, :2].T + self.K[:2, 2]) / self.K[2, 2]

    def _reached(self, rays: np.ndarray) -> np.ndarray:
        """Return whether unit vectors (..., 3) lie in the image circle, (...) bool."""
        return rays[..., 2] >= (np.cos(np.radians(self.reach_deg)) if self.reach_deg < 180 else -np.inf)


def _optical_centre(T_camera_lidar: np.ndarray) -> tuple[float, float, float]:
    R, t = T_camera_lidar[:3, :3], T_camera_lidar[:3, 3]
    x, y, z = (-np.linalg.inv(R) @ t).tolist()
    return x, y, z


def _undistorted_brown(x_d: np.ndarray, y_d: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Directions (x, y, 1) whose distorted place is (x_d, y_d), by Newton's method; NaN if there is none."""
    x, y = x_d, y_d
    with np.errstate(all="ignore"):  # diverging ones are left out below
        for _ in range(NEWTON_STEPS):
            to_x, to_y, xx, xy, yy = _distorted_brown(x, y, distortion)
            error_x, error_y, determinant = to_x - x_d, to_y - y_d, xx * yy - xy * xy
            x, y = x - (yy * error_x - xy * error_y) / determinant, y - (xx * error_y - xy * error_x) / determinant
        to_x, to_y, xx, xy, yy = _distorted_brown(x, y, distortion)
        converged = (np.hypot(to_x - x_d, to_y - y_d) < NEWTON_TOLERANCE) & _unfolded(x, y, xx, xy, yy, distortion)
    return np.where(converged[..., None], np.stack([x, y, np.ones_like(x)], axis=-1), np.nan)


def _projected_brown(x: np.ndarray, y: np.ndarray, z: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Distorted places (..., 2) of directions; NaN behind the camera and if the polynomial is not unique."""
    x, y = (np.where(z > 0, axis / z, np.nan) for axis in (x, y))
    to_x, to_y, xx, xy, yy = _distorted_brown(x, y, distortion)
    return np.where(_unfolded(x, y, xx, xy, yy, distortion)[..., None], np.stack([to_x, to_y], axis=-1), np.nan)


def _unfolded(
    x: np.ndarray, y: np.ndarray, xx: np.ndarray, xy: np.ndarray, yy: np.ndarray, distortion: np.ndarray
) -> np.ndarray:
    """Return whether (x, y), with the Jacobian xx, xy, yy, is before the first fall, or pole, of the lens's radius."""
    numerator, denominator = (np.poly1d(part[::-1]) for part in _radial(distortion))
    r2 = np.poly1d([1.0, 0.0])
    # the slope of r N(r^2) / D(r^2) over r has the sign of N D + 2 r^2 (N' D - N D')
    slope = numerator * denominator + 2 * r2 * (numerator.deriv() * denominator - numerator * denominator.deriv())
    roots = [*slope.roots, *denominator.roots]
    falls = min((root.real for root in roots if abs(root.imag) < 1e-9 and root.real > 0), default=np.inf)
    return (x * x + y * y < falls) & (xx * yy > xy * xy) & (xx + yy > 0)


def _radial(distortion: np.ndarray) -> tuple[list[float], list[float]]:
    """Return the coefficients of 1, r^2, r^4 and r^6 in the numerator and the denominator of "brown"."""
    k1, k2, _, _, k3, k4, k5, k6 = (*distortion.tolist(), 0.0, 0.0, 0.0, 0.0)[:8]
    return [1.0, k1, k2, k3], [1.0, k4, k5, k6]


def _distorted_brown(x: np.ndarray, y: np.ndarray, distortion: np.ndarray) -> tuple[np.ndarray, ...]:
    """Distorted places (x, y) of directions (x, y, 1), and their symmetric Jacobian: xx, xy, yy."""
    p1, p2 = distortion[2:4].tolist()
    (_, k1, k2, k3), (_, k4, k5, k6) = _radial(distortion)
    r2 = x * x + y * y
    denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / denominator
    slope = (k1 + r2 * (2 * k2 + 3 * r2 * k3) - radial * (k4 + r2 * (2 * k5 + 3 * r2 * k6))) / denominator
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x,
        2 * x * y * slope + 2 * p1 * x + 2 * p2 * y,
        radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x,
    )


# Mei and Rives 2007, "Single View Point Omnidirectional Camera Calibration from Planar Grids", section II.
def _projected_mei(x: np.ndarray, y: np.ndarray, z: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Distorted places (..., 2) of unit vectors; NaN if (x, y) / (z + xi) no longer grows with the angle."""
    xi = float(distortion[0])
    unique = (z + xi > 0) & (1 + xi * z > 0)
    ahead = np.where(unique, z + xi, np.nan)
    return _projected_brown(x / ahead, y / ahead, np.ones_like(z), distortion[1:])


def _undistorted_mei(x_d: np.ndarray, y_d: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Unit vectors whose distorted place is (x_d, y_d); NaN if there is none."""
    xi = float(distortion[0])
    x, y, _ = np.moveaxis(_undistorted_brown(x_d, y_d, distortion[1:]), -1, 0)
    r2 = x * x + y * y
    with np.errstate(invalid="ignore"):  # beyond the widest angle the root is NaN
        ahead = (xi + np.sqrt(1 + (1 - xi * xi) * r2)) / (1 + r2)  # z + xi; equation of the lifting, section II.C
    return np.stack([x * ahead, y * ahead, ahead - xi], axis=-1)


def _rising_fisheye(distortion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angles (n,) in radians and their radii, up to the first fall of the polynomial: beyond, angles are not unique."""
    angles = np.linspace(0, np.pi, 4097)
    coefficients = np.array([1, *distortion])
    radii = angles * (coefficients * angles[:, None] ** (np.arange(len(coefficients)) * 2)).sum(1)
    rising = np.append(np.diff(radii) > 0, False)
    reach = int(rising.argmin()) + 1
    return angles[:reach], radii[:reach]


def _projected_fisheye(x: np.ndarray, y: np.ndarray, z: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Distorted places (..., 2) of directions; NaN at ambiguous angles."""
    aside = np.hypot(x, y)
    theta = np.arctan2(aside, z)
    radius = theta * (1 + (distortion * theta[..., None] ** (2 * np.arange(1, 5))).sum(-1))
    scale = np.where(aside > 0, radius / aside, np.where(z > 0, 1.0, np.nan))
    angles, _ = _rising_fisheye(distortion)
    scale = np.where(theta <= angles[-1], scale, np.nan)
    return np.stack([x * scale, y * scale], axis=-1)


def _undistorted_fisheye(x_d: np.ndarray, y_d: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Directions at the angle theta whose theta (1 + k1 theta^2 + ... + k4 theta^8) is |(x_d, y_d)|; NaN beyond."""
    angles, radii = _rising_fisheye(distortion)
    coefficients = np.array([1, *distortion])
    powers = np.arange(len(coefficients)) * 2
    radius = np.hypot(x_d, y_d)
    theta = np.interp(radius, radii, angles)
    for _ in range(3):
        squares = theta[..., None] ** powers
        theta = theta - (theta * (coefficients * squares).sum(-1) - radius) / (
            (coefficients * (powers + 1) * squares).sum(-1)
        )
    aside = np.sin(theta) / np.where(radius > 0, radius, 1)
    rays = np.stack([x_d * aside, y_d * aside, np.cos(theta)], axis=-1)
    return np.where((radius <= radii[-1])[..., None], rays, np.nan)


def read_calib(path: str | Path, size: tuple[int, int] | None = (1242, 375), camera: int = 2) -> Calibration:
    """Read KITTI's calibration of a camera, 0 to 3: P2 (3x4) and Tr (3x4, LiDAR -> rectified camera 0) of the second.

    pixel ~ P2 [Tr; 0 0 0 1] [x y z 1]^T. P2 = K [I | b]: the colour camera stands b away from camera 0.
    path  of odometry's calib.txt, a calib file of the object or tracking benchmark (Tr = R0_rect Tr_velo_to_cam), one
          of a raw drive's calib_cam_to_cam.txt and calib_velo_to_cam.txt or of KITTI-360's perspective.txt (its camera
          0) and calib_cam_to_velo.txt, beside each other; or of the folder of one of these.
    size  (width, height) of the image; None: by the row S_rect of a raw drive or of KITTI-360.
    Raises InputError if the file, P2 or Tr is missing, not numbers, or no camera matrix and rotation.
    """
    path = Path(path)
    rows = _rows(path)
    names = [name.format(camera) for name in PROJECTIONS]
    P2 = _matrix(path, rows, next((name for name in names if name in rows), names[0]))
    T = _camera0(path, rows)
    K = P2[:, :3]
    if not is_camera_matrix(K):
        raise InputError(
            f"{path}: row {names[0]}: is no camera matrix (fx s cx, 0 fy cy, 0 0 1); take the row from KITTI's file"
        )
    T[:3, 3] += np.linalg.solve(K, P2[:, 3])
    _check_near(path, T)
    return Calibration(K=K / K[2, 2], T_camera_lidar=T, size=size or _size(path, rows, f"S_rect_0{camera}"))


def read_camera0(path: str | Path) -> np.ndarray:
    """T_camera0_lidar (4, 4) float64, metres, of KITTI odometry's calib.txt: its row Tr, whatever else there is.

    Raises InputError if the file or Tr is missing, not numbers, or no rotation.
    """
    path = Path(path)
    T = _camera0(path, _rows(path))
    _check_near(path, T)
    return T


def read_mount(path: Path) -> np.ndarray:
    """Return the rigid (4, 4) of rows R and T, as in calib_imu_to_velo.txt; InputError if they are none."""
    return _unrectified(path, {name: row for name, row in _rows(path).items() if name in ("R", "T")})


def read_rigid(path: Path, name: str = "") -> np.ndarray:
    """Return the rigid (4, 4) of a row, as in KITTI-360's calib_cam_to_pose.txt; "": of the row without a name.

    Raises InputError if the file or the row is missing, not numbers, or no rotation.
    """
    return _rigid(path, name or "1", _matrix(path, _rows(path), name))


def has_camera(path: str | Path) -> bool:
    """Return whether a calib.txt has a camera (P2), not the axes of poses.txt alone; InputError if it is missing."""
    return not _rows(Path(path)).keys().isdisjoint(name.format(2) for name in PROJECTIONS)


def _camera0(path: Path, rows: dict[str, str]) -> np.ndarray:
    """Return T_camera0_lidar (4, 4) of the rectified camera 0, of any of KITTI's forms."""
    rectification = next((name for name in RECTIFICATIONS if name in rows), "")
    if "Tr" in rows or not rectification:
        return _rigid(path, "Tr", _matrix(path, rows, "Tr"))
    rectifying = np.hstack([_matrix(path, rows, rectification, (3, 3)), np.zeros((3, 1))])
    return _rigid(path, rectification, rectifying) @ _unrectified(path, rows)


def _unrectified(path: Path, rows: dict[str, str]) -> np.ndarray:
    """Return LiDAR -> camera 0 before it is rectified, (4, 4)."""
    if "R" in rows and "T" in rows:  # of a raw drive
        return _rigid(path, "R", np.hstack([_matrix(path, rows, "R", (3, 3)), _matrix(path, rows, "T", (3, 1))]))
    if "" in rows:  # of KITTI-360: camera 0 -> LiDAR
        return np.linalg.inv(_rigid(path, "1", _matrix(path, rows, "")))
    rigid = next((name for name in RIGIDS if name in rows), RIGIDS[0])
    return _rigid(path, rigid, _matrix(path, rows, rigid))


def _rigid(path: Path, name: str, matrix: np.ndarray) -> np.ndarray:
    """Return a (3, 4) pose as (4, 4)."""
    if not is_rotation(matrix[:, :3]):
        raise InputError(f"{path}: row {name}: holds no rotation; take the row from KITTI's file")
    return np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])


def _check_near(path: Path, T: np.ndarray) -> None:
    if np.abs(T[:3, 3]).max() > FARTHEST_CAMERA_M:
        raise InputError(f"{path}: the camera stands farther than {FARTHEST_CAMERA_M:g} m away; take KITTI's file")


def is_rotation(R: np.ndarray) -> bool:
    """Return whether R (3, 3) is a rotation, as far as ROTATION_TOLERANCE."""
    return bool(np.linalg.det(R) >= 0 and np.allclose(R @ R.T, np.eye(3), atol=ROTATION_TOLERANCE))


def is_camera_matrix(K: np.ndarray) -> bool:
    """Return whether K (3, 3) is a positive multiple of [fx s cx; 0 fy cy; 0 0 1], whose focal lengths are positive."""
    if not 1e-9 < K[2, 2] < 1e9 or np.abs(K).max() > LARGEST_PX * K[2, 2]:
        return False
    lower = np.abs([K[1, 0], K[2, 0], K[2, 1]]).max()
    return bool(lower <= 1e-9 * K[2, 2] and min(K[0, 0], K[1, 1]) > 1e-6 * K[2, 2])


def _rows(path: Path) -> dict[str, str]:
    """Return the numbers of each row by its name, "" for a row without one; of a pair of files, of both."""
    files = [path]
    if path.is_dir():
        files = [folder / name for folder in (path, path.parent) for name in WHOLE if (folder / name).is_file()][:1]
    if not files:
        raise InputError(f"{path}: holds no {' or '.join(WHOLE)}; name KITTI's calibration")
    for pair in PAIRS:
        if files[0].name in pair:
            files = [files[0].with_name(name) for name in pair]
    rows: dict[str, str] = {}
    for file in files:
        try:
            text = read_text(file, MOST_CALIBRATION_BYTES)
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{file}: cannot be read as calib.txt ({_reason(error)}); name KITTI's file") from error
        lines = [ROW.fullmatch(line.strip()) for line in text.splitlines() if line.strip()]
        rows |= {line[1] or "": line[2] for line in lines if line}
    return rows


def _reason(error: Exception) -> str:
    return error.strerror or "no reason given" if isinstance(error, OSError) else "not text"


def _size(path: Path, rows: dict[str, str], name: str) -> tuple[int, int]:
    """Return a row as (width, height) of an image."""
    width, height = _matrix(path, rows, name, (2, 1))[:, 0].astype(int).tolist()
    if min(width, height) < 1:
        raise InputError(f"{path}: row {name}: is no size of an image; take the row from KITTI's file")
    return width, height


def _matrix(path: Path, rows: dict[str, str], name: str, shape: tuple[int, int] = (3, 4)) -> np.ndarray:
    """Return a row as a matrix of a shape."""
    if name not in rows:
        raise InputError(
            f"{path}: has no row {name}:; KITTI's odometry calib.txt has P2: and Tr:, its object benchmark's P2:,"
            " R0_rect: and Tr_velo_to_cam:, KITTI-360's perspective.txt P_rect_00:, R_rect_00: and S_rect_00:"
        )
    try:
        numbers = np.array([float(word) for word in rows[name].split()])
    except ValueError as error:
        raise InputError(f"{path}: row {name}: holds something that is no number ({error})") from error
    count = math.prod(shape)
    if numbers.size != count or not np.isfinite(numbers).all():
        raise InputError(
            f"{path}: row {name}: must hold {count} finite numbers ({shape[0]}x{shape[1]}), it has {numbers.size}"
        )
    return numbers.reshape(shape)
