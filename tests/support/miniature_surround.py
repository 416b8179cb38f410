"""A painted place whose every look is known, and its files as PandaSet and nuScenes would have them.

The ground is flat, a sphere closes the place; both are painted with slow waves. Cameras and scans of it are worked out
ray by ray.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
from PIL import Image

from lidar2pano.calibration import Calibration

HEIGHT, RADIUS = 2.0, 20.0  # metres: of the sensor above the ground; of the sphere around it
SIZE, FOCAL = (480, 300), 300.0
ROAD, BUILDING = 7, 41  # PandaSet's ids
CLASSES = {"5": "Vegetation", "7": "Road", "13": "Car", "41": "Building"}
# to our axes from theirs, by hand: their y is our x, their x is to the right
OURS = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
SENSOR = np.array([0.3, 0.8, 1.8])  # in PandaSet's frame
FRONT = (0.047, 0.0, -0.053)  # PandaSet's front camera from its sensor, our axes
LEFT = {  # of ahead, degrees; by the names of PandaSet's cameras
    "front_camera": 0.0, "front_left_camera": 60.0, "left_camera": 120.0, "back_camera": 180.0,
    "right_camera": -120.0, "front_right_camera": -60.0,
}  # fmt: skip


def painting(places: np.ndarray) -> np.ndarray:
    """Colours (..., 3) float in [30, 226] of places (..., 3), metres."""
    x, y, z = np.moveaxis(places, -1, 0) * (2 * math.pi / 40)
    return 128 + 98 * np.stack([np.sin(x + 0.5), np.cos(y + z), np.sin(x - y + 2)], axis=-1)


def distances(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Metres (...) from a point inside of the place along unit vectors (..., 3)."""
    along = rays @ origin
    sphere = -along + np.sqrt(along**2 - origin @ origin + RADIUS**2)
    with np.errstate(divide="ignore"):
        ground = np.where(rays[..., 2] < 0, (-HEIGHT - origin[2]) / rays[..., 2], np.inf)
    return np.minimum(sphere, ground)


def camera(left_deg: float, place: tuple[float, float, float], lean: float = 0.0) -> Calibration:
    """A camera at a place that looks `left_deg` to the left of ahead and leans by `lean` radians."""
    c, s = math.cos(math.radians(left_deg)), math.sin(math.radians(left_deg))
    axes = np.array([[s, -c, 0.0], [0.0, 0.0, -1.0], [c, s, 0.0]])  # right, down, ahead
    c, s = math.cos(lean), math.sin(lean)
    axes = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ axes
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = axes, -axes @ np.array(place)
    K = np.array([[FOCAL, 0.0, SIZE[0] / 2], [0.0, FOCAL, SIZE[1] / 2 - 6], [0.0, 0.0, 1.0]])
    return Calibration(K=K, T_camera_lidar=T, size=SIZE)


def six() -> dict[str, Calibration]:
    """Cameras all around, each somewhere else; the first looks ahead."""
    found = {}
    for number, (name, left) in enumerate(LEFT.items()):
        aside = (0.9 * math.cos(math.radians(left)), 0.7 * math.sin(math.radians(left)), 0.05 * number)
        found[name] = camera(left, aside if number else FRONT, lean=0.01 * number)
    return found


def camera_view(calibration: Calibration) -> np.ndarray:
    """(h, w, 3) uint8: the place as a camera sees it."""
    width, height = calibration.size
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    (fx, _, cx), (_, fy, cy), _ = calibration.K.tolist()
    in_camera = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=-1)
    rays = in_camera @ calibration.T_camera_lidar[:3, :3]  # rows times R: the inverse of a rotation
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    centre = np.array(calibration.centre)
    return painting(centre + distances(centre, rays)[..., None] * rays).round().astype(np.uint8)


def sweep(rings: int = 64, columns: int = 1500) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) float32 of a sensor at the origin, and whether each is ground (N,) bool."""
    slope = np.linspace(0.25, -0.42, rings)
    azimuth = (np.arange(columns) + 0.5) * (2 * math.pi / columns)
    rays = np.stack(np.broadcast_arrays(np.cos(azimuth), np.sin(azimuth), slope[:, None]), axis=-1).reshape(-1, 3)
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    points = (distances(np.zeros(3), rays)[:, None] * rays).astype(np.float32)
    return points, np.isclose(points[:, 2], -HEIGHT, atol=1e-4)


def write_pandaset(root: Path, frames: int = 1) -> Path:
    """The place as a PandaSet of `frames` frames, of which each stands 3 m further ahead in the data set's world."""
    folder = root / "sequences" / "002"
    for part in ("velodyne", "labels_pandaset", "calib", *LEFT):
        (folder / part).mkdir(parents=True)
    (root / "classes.json").write_text(json.dumps(CLASSES))
    mounts, (points, ground) = six(), sweep()
    to_theirs = np.eye(4)
    to_theirs[:3, :3], to_theirs[:3, 3] = OURS.T, SENSOR
    calibrations = {}
    for name, calibration in mounts.items():
        (fx, _, cx), (_, fy, cy), _ = calibration.K.tolist()
        mount = calibration.T_camera_lidar @ np.linalg.inv(to_theirs)
        K = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
        calibrations[name] = {"K": K, "cam_from_lidar": mount.tolist(), "size": list(SIZE)}
    theirs = points @ OURS + to_theirs[:3, 3]
    scan = np.column_stack([theirs, np.full(len(points), 0.5)]).astype("<f4")
    for frame in range(frames):
        world = np.eye(4)
        world[1, 3] = 3.0 * frame
        stem = f"{frame:06d}"
        scan.tofile(folder / "velodyne" / f"{stem}.bin")
        np.where(ground, ROAD, BUILDING).astype("<u4").tofile(folder / "labels_pandaset" / f"{stem}.label")
        card = {"world_from_lidar": world.tolist(), "cameras": calibrations}
        (folder / "calib" / f"{stem}.json").write_text(json.dumps(card))
        for name, calibration in mounts.items():
            Image.fromarray(camera_view(calibration)).save(folder / name / f"{stem}.jpg", quality=98, subsampling=0)
    return root


def write_nuscenes(root: Path) -> Path:
    """The place as a sample of nuScenes."""
    root.mkdir(parents=True, exist_ok=True)
    points, _ = sweep(32, 1000)
    theirs = np.column_stack([points @ OURS, np.full(len(points), 51.0), np.zeros(len(points))])
    theirs.astype("<f4").tofile(root / "LIDAR_TOP.pcd.bin")
    turn = np.eye(4)
    turn[:3, :3] = OURS
    images = {}
    for name, calibration in six().items():
        file = f"{name}.jpg"
        Image.fromarray(camera_view(calibration)).save(root / file, quality=98, subsampling=0)
        key = "CAM_FRONT" if name == "front_camera" else "CAM_" + name.removesuffix("_camera").upper()
        mount = (calibration.T_camera_lidar @ turn).tolist()
        images[key] = {"img_path": file, "cam2img": calibration.K.tolist(), "lidar2cam": mount}
    ego = np.eye(4)
    ego[:3, 3] = 100.0, 200.0, 0.5
    sample = {
        "sample_idx": 7,
        "ego2global": ego.tolist(),
        "images": images,
        "lidar_points": {"lidar_path": "LIDAR_TOP.pcd.bin", "lidar2ego": np.eye(4).tolist()},
    }
    (root / "info.json").write_text(json.dumps({"data_list": [sample]}))
    return root
