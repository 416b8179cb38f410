"""The painted place of `miniature_surround` as nuScenes and KITTI-360 are downloaded.

In nuScenes every camera took its image a little before or after the scan, from where the vehicle was then.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from lidar2pano.calibration import Calibration, LensCalibration
from lidar2pano.data.nuscenes import CLASSES
from miniature_surround import HEIGHT, OURS, camera, camera_view, distances, painting, six, sweep
from poses import fields_of

SCENES = {"scene-0061": 2, "scene-0103": 2}  # of mini_train and mini_val: numbers of samples
ROAD, MANMADE, NOISE = 24, 28, 0  # lidarseg's ids
FRONT = (0.047, 0.0, -0.053)
CAMERA_OF = {  # nuScenes' name of a camera -> that of `six`
    "CAM_FRONT": "front_camera", "CAM_FRONT_LEFT": "front_left_camera", "CAM_BACK_LEFT": "left_camera",
    "CAM_BACK": "back_camera", "CAM_BACK_RIGHT": "right_camera", "CAM_FRONT_RIGHT": "front_right_camera",
}  # fmt: skip
SEQUENCE = "2013_05_28_drive_0003_sync"
# KITTI-360's fisheye cameras at a quarter of their 1400 x 1400 pixels, and how they are mounted, seen from image_00: a
# little behind it, left and right of it, each turned a little backwards.
LENSES = {
    "image_02": ((334.08, 333.95, 179.2, 176.4), (2.2134, 0.0168, 1.6549, 0.00042, 0.00042), 91.8, (-0.7, 0.4, 0.1)),
    "image_03": ((371.36, 371.24, 174.7, 174.5), (2.5535, 0.0494, 4.5068, 0.00135, -0.00070), -91.4, (-0.7, -0.5, 0.1)),
}
CIRCLE_DEG = 92.5  # of a fisheye's image: beyond, images are of the colour OUTSIDE
OUTSIDE = (255, 0, 255)
LABELLED = {7: "road", 11: "building", 34: "garage", 37: "smallpole", 38: "lamp"}


def rigid(x: float, y: float, z: float, turn_deg: float = 0.0) -> np.ndarray:
    """(4, 4): turned to the left, then moved."""
    c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    return np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]])


def nuscenes_pose(scene: int, sample: int) -> np.ndarray:
    """(4, 4) T_world_sensor, our axes, of a sample of `write_nuscenes_layout`."""
    return rigid(400 + 100 * scene + 4 * sample, 1100.0, 1.84, 30.0 * scene)


def as_row(T: np.ndarray) -> dict[str, list[float]]:
    """A motion as nuScenes writes it: translation, and quaternion w x y z."""
    *place, x, y, z, w = fields_of(T)
    return {"translation": place, "rotation": [w, x, y, z]}


class NuscenesTables:
    """The rows of nuScenes' tables, filled sample by sample."""

    def __init__(self) -> None:
        self.rows: dict[str, list[dict[str, Any]]] = {
            name: [] for name in ("scene", "sample", "sensor", "calibrated_sensor", "sample_data", "ego_pose")
        }

    def token(self, table: str) -> str:
        """A new token for a row of the table."""
        return f"{sorted(self.rows).index(table):x}{len(self.rows[table]):031x}"

    def add(self, table: str, **row: Any) -> str:
        """Add a row; returns its token."""
        token = self.token(table)
        self.rows[table].append({"token": token, **row})
        return token

    def add_sensor(self, channel: str, T_ego_sensor: np.ndarray, K: Sequence[Sequence[float]] = ()) -> str:
        """Add a sensor and how it is mounted; returns the token of the latter."""
        sensor = self.add("sensor", channel=channel, modality="camera" if len(K) else "lidar")
        return self.add("calibrated_sensor", sensor_token=sensor, **as_row(T_ego_sensor), camera_intrinsic=list(K))

    def add_data(self, sample: str, sensor: str, T_world_ego: np.ndarray, file: str, key_frame: bool = True) -> str:
        """Add what a sensor measured, and where the vehicle was then; returns its token."""
        ego = self.add("ego_pose", timestamp=0, **as_row(T_world_ego))
        return self.add(
            "sample_data", sample_token=sample, ego_pose_token=ego, calibrated_sensor_token=sensor, filename=file,
            fileformat=file.rpartition(".")[2], is_key_frame=key_frame, timestamp=0, prev="", next="",
        )  # fmt: skip

    def write(self, folder: Path) -> None:
        """Write the tables, and category.json."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, rows in self.rows.items():
            (folder / f"{name}.json").write_text(json.dumps(rows, indent=0))
        (folder / "category.json").write_text(json.dumps(categories(), indent=0))


def categories() -> list[dict[str, Any]]:
    """The rows of lidarseg's category.json: noise is 0, what lidarseg added 24 to 31, things are between."""
    added = ["flat.driveable_surface", "flat.sidewalk", "flat.terrain", "flat.other"]
    added += ["static.manmade", "static.vegetation", "static.other", "vehicle.ego"]
    names = ["noise", *sorted(set(CLASSES) - {"noise", *added}), *added]
    return [{"token": f"{n:032x}", "name": name, "description": "", "index": n} for n, name in enumerate(names)]


def write_nuscenes_layout(root: Path, scenes: dict[str, int] = SCENES, version: str = "v1.0-mini") -> Path:
    """The place as nuScenes with lidarseg: every sample the same, but at another place of the world."""
    points, ground = sweep(32, 500)
    theirs = np.column_stack([points @ OURS, np.full(len(points), 51.0), np.zeros(len(points))]).astype("<f4")
    ids = np.where(ground, ROAD, MANMADE).astype(np.uint8)
    ids[::10] = NOISE
    T_ego_ours, ours = rigid(0.94, 0.0, 1.84), np.eye(4)
    ours[:3, :3] = OURS  # our axes from theirs
    mounts = {channel: six()[name] for channel, name in CAMERA_OF.items()}
    images = {channel: camera_view(mount) for channel, mount in mounts.items()}
    tables = NuscenesTables()
    lidar = tables.add_sensor("LIDAR_TOP", T_ego_ours @ ours)
    radar = tables.add_sensor("RADAR_FRONT", np.eye(4))
    # how far the vehicle had driven and turned when each camera took its image, if not yet where it was at the scan
    drives = {channel: rigid(0.1 * number - 0.4, 0.0, 0.0, 0.3 * number) for number, channel in enumerate(mounts)}
    sensors = {}
    for channel, mount in mounts.items():
        T_ego_camera = np.linalg.inv(drives[channel]) @ T_ego_ours @ np.linalg.inv(mount.T_camera_lidar)
        sensors[channel] = tables.add_sensor(channel, T_ego_camera, mount.K.tolist())
    for scene_number, (scene_name, samples) in enumerate(reversed(scenes.items())):
        scene = tables.add("scene", name=scene_name, description="Rain, a bus", nbr_samples=samples)
        for number in reversed(range(samples)):  # neither scenes nor samples are in order in the files
            stamp = 1532402927000000 + number * 500000
            sample = tables.add("sample", scene_token=scene, timestamp=stamp, prev="", next="")
            pose = nuscenes_pose(len(scenes) - 1 - scene_number, number)
            ego = pose @ np.linalg.inv(T_ego_ours)
            file = f"samples/LIDAR_TOP/{scene_name}__LIDAR_TOP__{stamp}.pcd.bin"
            token = tables.add_data(sample, lidar, ego, file)
            tables.add_data(sample, lidar, np.eye(4), "sweeps/LIDAR_TOP/none.pcd.bin", key_frame=False)
            tables.add_data(sample, radar, ego, "samples/RADAR_FRONT/none.pcd")
            written(root / file).write_bytes(theirs.tobytes())
            written(root / "lidarseg" / version / f"{token}_lidarseg.bin").write_bytes(ids.tobytes())
            for channel, image in images.items():
                file = f"samples/{channel}/{scene_name}__{channel}__{stamp}.jpg"
                tables.add_data(sample, sensors[channel], ego @ drives[channel], file)
                Image.fromarray(image).save(written(root / file), quality=98, subsampling=0)
    tables.write(root / version)
    return root


def written(path: Path) -> Path:
    """The path, with its folder made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


# --- KITTI-360 ------------------------------------------------------------------------------------------------------


def kitti360_camera() -> Calibration:
    """The left perspective camera, rectified."""
    return camera(0.0, FRONT)


def kitti360_fisheyes() -> dict[str, LensCalibration]:
    """The fisheye cameras, which look to the left (image_02) and to the right (image_03)."""
    found = {}
    for name, ((fx, fy, cx, cy), distortion, left_deg, place) in LENSES.items():
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        T = camera(left_deg, place, lean=0.02).T_camera_lidar
        found[name] = LensCalibration(K=K, T_camera_lidar=T, size=(350, 350), model="mei", distortion=distortion)
    return found


def fisheye_view(lens: LensCalibration) -> np.ndarray:
    """(h, w, 3) uint8: the place as a fisheye camera sees it, and OUTSIDE beyond its image circle."""
    rays = replace(lens, reach_deg=CIRCLE_DEG).rays()
    inside = np.isfinite(rays[..., 0])
    rays, centre = rays[inside] @ lens.T_camera_lidar[:3, :3], np.array(lens.centre)
    image = np.full((*inside.shape, 3), OUTSIDE, dtype=np.uint8)
    image[inside] = painting(centre + distances(centre, rays)[..., None] * rays).round()
    return image


def lens_yaml(name: str, lens: LensCalibration) -> str:
    """A fisheye camera as calibration/image_0N.yaml has it."""
    (fx, _, cx), (_, fy, cy), _ = lens.K.tolist()
    sections = {
        "mirror_parameters": {"xi": lens.distortion[0]},
        "distortion_parameters": dict(zip(("k1", "k2", "p1", "p2"), lens.distortion[1:], strict=True)),
        "projection_parameters": {"gamma1": fx, "gamma2": fy, "u0": cx, "v0": cy},
    }
    lines = ["%YAML:1.0", "---", "model_type: MEI", f"camera_name: {name}"]
    lines += [f"image_width: {lens.size[0]}", f"image_height: {lens.size[1]}"]
    for section, numbers in sections.items():
        lines += [f"{section}:", *(f"   {key}: {number:.16e}" for key, number in numbers.items())]
    return "\n".join(lines) + "\n"


def kitti360_pose(frame: int) -> np.ndarray:
    """(4, 4) T_world_lidar of a frame."""
    return rigid(1000.0 + frame, 3800.0, 115.0, 10.0)


def write_kitti360_layout(root: Path, frames: Sequence[int] = (2, 3, 7, 11), *, fisheyes: bool = False) -> Path:
    """The place as KITTI-360, of one sequence; frame 7 has no pose, frame 11 neither an image nor labels.

    fisheyes  whether the fisheye cameras are there: their images (of all frames but 11) and their calibrations.
    """
    folder, mount = root / "data_3d_raw" / SEQUENCE / "velodyne_points" / "data", kitti360_camera()
    points, ground = sweep(64, 400)
    scan = np.column_stack([points, np.full(len(points), 0.3)]).astype("<f4")
    T_ego_lidar = rigid(0.8, 0.3, 0.7, 1.5)
    rectify = rigid(0, 0, 0, 2.0)
    T_lidar_camera = np.linalg.inv(mount.T_camera_lidar) @ rectify  # of the camera as it is mounted
    cameras = {f"image_{n:02d}": T_ego_lidar @ T_lidar_camera @ rigid(0.6 * n, 0, 0) for n in range(2)}
    lenses = kitti360_fisheyes() if fisheyes else {}
    cameras |= {name: T_ego_lidar @ np.linalg.inv(lens.T_camera_lidar) for name, lens in lenses.items()}
    lines: dict[str, list[str]] = {
        "perspective.txt": [
            "calib_time: 01-Jan-2013", "corner_dist: 0", "S_00: 490 310", f"K_00: {text(np.eye(3))}",
            "S_rect_00: 480 300", f"R_rect_00: {text(rectify[:3, :3])}",
            f"P_rect_00: {text(np.column_stack([mount.K, np.zeros(3)]))}",
        ],
        "calib_cam_to_velo.txt": [text(T_lidar_camera[:3])],
        "calib_cam_to_pose.txt": [f"{name}: {text(T[:3])}" for name, T in cameras.items()],
    }  # fmt: skip
    for name, content in lines.items():
        written(root / "calibration" / name).write_text("\n".join(content) + "\n")
    images = [f"data_2d_raw/{SEQUENCE}/image_00/data_rect/{frame:010d}.png" for frame in frames if frame != 11]
    labels = [
        f"data_2d_semantics/train/{SEQUENCE}/image_00/semantic/{frame:010d}.png" for frame in frames if frame != 11
    ]
    pairs = [f"{image} {ids}" for image, ids in zip(images, labels, strict=True)]
    absent = f"data_2d_raw/{SEQUENCE}/image_00/data_rect/0000000099.png data_2d_semantics/none.png"
    for split, chosen in (("train", [*pairs[:-1], absent]), ("val", pairs[-1:])):
        path = root / "data_2d_semantics" / "train" / f"2013_05_28_drive_{split}_frames.txt"
        written(path).write_text("\n".join(chosen) + "\n")
    colour, ids = Image.fromarray(camera_view(mount)), Image.fromarray(kitti360_labels(mount))
    for frame in frames:
        scan.tofile(written(folder / f"{frame:010d}.bin"))
        if frame != 11:
            colour.save(written(root / images[frames.index(frame)]))
            ids.save(written(root / labels[frames.index(frame)]))
    for name, lens in lenses.items():
        (root / "calibration" / f"{name}.yaml").write_text(lens_yaml(name, lens))
        image = Image.fromarray(fisheye_view(lens))
        for frame in frames:
            if frame != 11:
                image.save(written(root / f"data_2d_raw/{SEQUENCE}/{name}/data_rgb/{frame:010d}.png"))
    poses = [
        f"{frame} {text((kitti360_pose(frame) @ np.linalg.inv(T_ego_lidar))[:3])}" for frame in frames if frame != 7
    ]
    written(root / "data_poses" / SEQUENCE / "poses.txt").write_text("\n".join(poses) + "\n")
    return root


def kitti360_labels(mount: Calibration) -> np.ndarray:
    """(h, w) uint8 label ids of KITTI-360: road below, buildings above, and patches of ids that Cityscapes has not."""
    width, height = mount.size
    v, u = np.mgrid[0:height, 0:width]
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(mount.K).T @ mount.T_camera_lidar[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    centre = np.array(mount.centre)
    places = centre + distances(centre, rays)[..., None] * rays
    ids = np.where(np.isclose(places[..., 2], -HEIGHT, atol=1e-4), 7, 11).astype(np.uint8)
    for patch, number in enumerate((34, 37, 38)):
        ids[:8, 20 * patch : 20 * patch + 8] = number
    return ids


def text(values: np.ndarray) -> str:
    """The numbers of an array, as the data set's files have them."""
    return " ".join(f"{value:.10f}" for value in np.asarray(values).ravel())
