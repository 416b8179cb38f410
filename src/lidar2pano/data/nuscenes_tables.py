"""The tables of nuScenes (ROOT/v1.0-*/*.json) as an index of its samples, built once and kept on disk.

The tables of v1.0-trainval have 2.6 million rows of sensor data in 1.9 GB, sweeps between the samples included. The
index holds the 34,149 samples: 1.2 kB of each, 40 MB. It lies in ROOT/.lidar2pano/ or, if it may not be written, in the
user's cache.
Format: nuScenes' schema (docs/schema_nuscenes.md of nutonomy/nuscenes-devkit).
"""

from __future__ import annotations

import hashlib
import os
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano.bounded_files import open_regular
from lidar2pano.data.cache import kept_at, write_first
from lidar2pano.data.camera_files import camera_matrix
from lidar2pano.errors import InputError
from lidar2pano.formats.json_files import read_json, table_rows
from lidar2pano.geometry.motion import rotation_matrices

LIDAR = "LIDAR_TOP"
CAMERAS = ("CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT")
CHANNELS = (LIDAR, *CAMERAS)
TABLES = ("scene", "sample", "sensor", "calibrated_sensor", "sample_data", "ego_pose")
FORM = 1  # raised when the index of the same tables holds something else
KEY_FRAME = re.compile(rb'"is_key_frame"\s*:\s*true')
TOKEN = re.compile(rb'"token"\s*:\s*"([^"]*)"')
MEND = "take the file from the data set"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NuscenesIndex:
    """The samples of one version, scene by scene in the order of their names, within a scene in time.

    root, version  the data set's folder; the name of the version, "v1.0-mini".
    scenes   (S,) names, sorted;  first: (S + 1,) int64, samples first[s] to first[s + 1] are those of scene s.
    tokens   (N,) bytes: of the LiDAR's sweep;  files: (N, 7) bytes, by CHANNELS, relative to `root`.
    poses    (N, 7, 7) float64: translation in metres and unit quaternion w x y z, ego vehicle -> world, when the sensor
             measured;  sensors: (N, 7) int64, rows of `mounts` and `K`.
    mounts   (M, 7) float64: likewise, sensor -> ego vehicle;  K: (M, 3, 3) float64, 0 for the LiDAR.
    """

    root: Path
    version: str
    scenes: np.ndarray
    first: np.ndarray
    tokens: np.ndarray
    files: np.ndarray
    poses: np.ndarray
    sensors: np.ndarray
    mounts: np.ndarray
    K: np.ndarray

    def samples(self, scene: str) -> range:
        """Return the rows of a scene's samples; none if the version has no such scene."""
        number = int(np.searchsorted(self.scenes, scene))
        if number == len(self.scenes) or self.scenes[number] != scene:
            return range(0)
        return range(int(self.first[number]), int(self.first[number + 1]))

    def T_world_sensor(self, sample: int, channel: int) -> np.ndarray:
        """Return (4, 4) float64: a sensor's own axes -> the world, when it measured."""
        return motion(self.poses[sample, channel]) @ motion(self.mounts[self.sensors[sample, channel]])


def motion(pose: np.ndarray) -> np.ndarray:
    """Return (4, 4) float64 of translation and unit quaternion w x y z (7,)."""
    T = np.eye(4)
    T[:3, :3] = rotation_matrices(pose[None, [4, 5, 6, 3]])[0]
    T[:3, 3] = pose[:3]
    return T


def versions(root: Path) -> list[str]:
    """Return the versions whose tables lie in a folder, sorted; none if it is no nuScenes in its official layout."""
    return sorted(path.name for path in root.glob("v1.0-*") if path.is_dir())


def nuscenes_index(root: Path, version: str) -> NuscenesIndex:
    """Return the index of a version: read from the disk if built of the tables as they are now, else built.

    Raises InputError if a table is missing or damaged.
    """
    stamps = [f"{FORM} {version}"]
    for table in TABLES:
        path = root / version / f"{table}.json"
        if not path.is_file():
            raise InputError(f"{path}: is missing; complete the data set")
        stamps.append(f"{path.stat().st_size} {path.stat().st_mtime_ns}")
    return _index(root, version, hashlib.sha256(os.fsencode("\n".join(stamps))).hexdigest()[:32])


@lru_cache(maxsize=2)
def _index(root: Path, version: str, key: str) -> NuscenesIndex:
    paths = kept_at(root, f"nuscenes/{version}-{key}.npz")
    for path in paths:
        if (arrays := _read(path)) is not None:
            return NuscenesIndex(root=root, version=version, **arrays)
    arrays = _build(root / version)

    def write(path: Path) -> None:
        with path.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)

    write_first(paths, write)
    return NuscenesIndex(root=root, version=version, **arrays)


def _read(path: Path) -> dict[str, np.ndarray] | None:
    """Return the arrays of an index; None if the file is missing or damaged."""
    try:
        with open_regular(path) as file, np.load(file, allow_pickle=False) as kept:
            return {
                name: kept[name] for name in ("scenes", "first", "tokens", "files", "poses", "sensors", "mounts", "K")
            }
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
        return None


# --- building -------------------------------------------------------------------------------------------------------


def _build(folder: Path) -> dict[str, np.ndarray]:
    """Return the arrays of the index of the tables in a folder."""
    scenes = {row["token"]: row["name"] for row in _small_table(folder / "scene.json", token=str, name=str)}
    order = sorted(
        (scenes[_known(folder, row, "sample", "scene", scenes)], row["timestamp"], row["token"])
        for row in _small_table(folder / "sample.json", token=str, scene_token=str, timestamp=int)
    )
    rows = {token: number for number, (_, _, token) in enumerate(order)}
    calibrated, channels, mounts, K = _mounts(folder)
    shape = (len(order), len(CHANNELS))
    files, ego_poses = np.full(shape, "", dtype=object), np.full(shape, "", dtype=object)
    sensors, tokens = np.full(shape, -1), np.full(len(order), "", dtype=object)
    for row in _key_frames(folder / "sample_data.json"):
        sensor = calibrated[_known(folder, row, "sample_data", "calibrated_sensor", calibrated)]
        if (channel := channels[sensor]) < 0:
            continue
        sample = rows[_known(folder, row, "sample_data", "sample", rows)]
        files[sample, channel], ego_poses[sample, channel] = row["filename"], row["ego_pose_token"]
        sensors[sample, channel] = sensor
        if CHANNELS[channel] == LIDAR:
            tokens[sample] = row["token"]
    if (sensors < 0).any():
        sample, channel = np.argwhere(sensors < 0)[0]
        raise InputError(
            f"{folder / 'sample_data.json'}: has no {CHANNELS[channel]} of sample {order[sample][2]}; {MEND}"
        )
    names, first = np.unique([scene for scene, _, _ in order], return_index=True)
    return {
        "scenes": names,
        "first": np.append(first, len(order)),
        "tokens": tokens.astype(bytes),
        "files": _ascii(folder, files),
        "poses": _ego_poses(folder / "ego_pose.json", ego_poses),
        "sensors": sensors,
        "mounts": mounts,
        "K": K,
    }


def _key_frames(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the rows of sample_data.json of samples, not of sweeps between two."""
    for row in table_rows(path, KEY_FRAME.search):
        yield _checked(
            path, row, token=str, sample_token=str, calibrated_sensor_token=str, ego_pose_token=str, filename=str
        )


def _mounts(folder: Path) -> tuple[dict[str, int], list[int], np.ndarray, np.ndarray]:
    """Of calibrated_sensor.json: token -> row; the row's number in CHANNELS or -1; mounts (M, 7) and K (M, 3, 3)."""
    sensors = {row["token"]: row["channel"] for row in _small_table(folder / "sensor.json", token=str, channel=str)}
    path = folder / "calibrated_sensor.json"
    rows = _small_table(path, token=str, sensor_token=str, translation=list, rotation=list, camera_intrinsic=list)
    names = [sensors[_known(folder, row, "calibrated_sensor", "sensor", sensors)] for row in rows]
    channels = [CHANNELS.index(name) if name in CHANNELS else -1 for name in names]
    K = np.zeros((len(rows), 3, 3))
    for number, (row, name) in enumerate(zip(rows, names, strict=True)):
        if name in CAMERAS:
            K[number] = camera_matrix(f"{path}: row {row['token']!r}", row)[0]
    return {row["token"]: n for n, row in enumerate(rows)}, channels, np.array([_pose(path, row) for row in rows]), K


def _ego_poses(path: Path, tokens: np.ndarray) -> np.ndarray:
    """Return (N, 7, 7) float64: the poses of ego_pose.json by their tokens (N, 7)."""
    rows_by_token: dict[bytes, list[int]] = {}
    for number, token in enumerate(tokens.ravel().tolist()):
        rows_by_token.setdefault(token.encode(), []).append(number)

    def is_needed(fields: bytes) -> bool:
        token = TOKEN.search(fields)
        return token is not None and token[1] in rows_by_token

    poses = np.zeros((tokens.size, 7))
    for row in table_rows(path, is_needed):
        _checked(path, row, token=str, translation=list, rotation=list)
        poses[rows_by_token.pop(row["token"].encode(), [])] = _pose(path, row)
    if rows_by_token:
        token = next(iter(rows_by_token)).decode()
        raise InputError(f"{path}: has no pose {token!r}, which sample_data.json names; {MEND}")
    return poses.reshape(*tokens.shape, 7)


def _pose(path: Path, row: Mapping[str, Any]) -> np.ndarray:
    """Return (7,) float64 of a row's translation and rotation, a unit quaternion; InputError if they are none."""
    try:
        pose = np.array([*row["translation"], *row["rotation"]], dtype=np.float64)
        norm = float(np.linalg.norm(pose[3:]))
    except (ValueError, TypeError, OverflowError):
        pose, norm = np.zeros(0), 0.0
    if len(row["translation"]) != 3 or pose.shape != (7,) or not np.isfinite(pose).all() or abs(norm - 1) > 0.01:
        raise InputError(f"{path}: row {row['token']!r} holds no translation and unit quaternion; {MEND}")
    pose[3:] /= norm
    return pose


def _small_table(path: Path, **types: type) -> list[dict[str, Any]]:
    """Return the rows of a small table, whose fields have these types."""
    rows = read_json(path)
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise InputError(f"{path}: is no list of objects; {MEND}")
    return [_checked(path, row, **types) for row in rows]


def _checked(path: Path, row: dict[str, Any], **types: type) -> dict[str, Any]:
    """Return the row; InputError if one of these fields is missing or of another type."""
    for name, field_type in types.items():
        if type(row.get(name)) is not field_type:
            raise InputError(
                f"{path}: row {str(row.get('token'))!r} has no {name!r} as nuScenes' schema has it; {MEND}"
            )
    return row


def _known(folder: Path, row: Mapping[str, Any], table: str, target: str, tokens: Mapping[str, object]) -> str:
    """Return the token of a row of the table `target`, named by a row of `table`; InputError if there is none."""
    if (token := row[f"{target}_token"]) not in tokens:
        raise InputError(
            f"{folder / table}.json: row {row['token']!r} names {token!r}, which {target}.json has not; {MEND}"
        )
    return token


def _ascii(folder: Path, files: np.ndarray) -> np.ndarray:
    """Return names of files as bytes; InputError if one leads out of the data set."""
    for name in files.ravel().tolist():
        if not name.isascii() or name.startswith("/") or ".." in name:
            raise InputError(f"{folder / 'sample_data.json'}: names the file {name!r}, outside of the data set; {MEND}")
    return files.astype(bytes)
