"""Samples of nuScenes as files: a 32-beam sweep and six cameras (Caesar et al. 2020, CC BY-NC-SA 4.0).

ROOT/info.json lists the samples in the form of mmdetection3d's info files (`data_list`), the pictures and sweeps lie
beside it. Its LiDAR has x to the right and y forward.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano.data.surround import FROM_RIGHT_FORWARD, SurroundFrame, matrix, moved, read_json, read_photo
from lidar2pano.errors import InputError, closest
from lidar2pano.scan import Scan

FRONT = "CAM_FRONT"
VALUES = 5  # float32 a point: x y z intensity ring
BRIGHTEST = 255  # intensity
# The lid of the boot in the backward picture, (u, v) of 1600 x 900.
OWN_CAR = {"CAM_BACK": ((0, 900), (184, 888), (800, 850), (1420, 888), (1599, 900))}


@dataclass(frozen=True, slots=True, kw_only=True)
class NuscenesSample:
    """One entry of `data_list` in the file `info`."""

    info: Path
    entry: Mapping[str, Any]

    @property
    def name(self) -> str:
        """For messages and outputs: "nuscenes/NNNNNN", by the sample's number."""
        return f"nuscenes/{int(self.entry['sample_idx']):06d}"

    def read(self) -> SurroundFrame:
        """Read everything; InputError where a file is missing, damaged or does not fit the others."""
        cameras, lidar = (self._part(name) for name in ("images", "lidar_points"))
        if FRONT not in cameras:
            raise InputError(f"{self.info}: sample {self.name} has no camera {FRONT}; take the file from the data set")
        back = np.linalg.inv(FROM_RIGHT_FORWARD)
        photos = {
            name: read_photo(
                self._file(camera, "img_path"),
                matrix(self.info, camera, "cam2img", (3, 3)),
                matrix(self.info, camera, "lidar2cam", (4, 4)) @ back,
                OWN_CAR.get(name, ()),
            )
            for name, camera in cameras.items()
        }
        pose = matrix(self.info, self.entry, "ego2global", (4, 4)) @ matrix(self.info, lidar, "lidar2ego", (4, 4))
        scan = read_sweep(self._file(lidar, "lidar_path"), self.name)
        return SurroundFrame(name=self.name, scan=scan, photos=photos, front=FRONT, pose=pose @ back)

    def _part(self, name: str) -> Mapping[str, Any]:
        part = self.entry.get(name)
        if not isinstance(part, dict):
            raise InputError(f"{self.info}: sample {self.name} has no {name!r}; take the file from the data set")
        return part

    def _file(self, part: Mapping[str, Any], name: str) -> Path:
        if not isinstance(part.get(name), str):
            raise InputError(f"{self.info}: sample {self.name} has no {name!r}; take the file from the data set")
        return self.info.parent / part[name]


def nuscenes_samples(root: Path, split: str = "all") -> list[NuscenesSample]:
    """Samples of a split, in the file's order: there is only "all". InputError where there is none."""
    info = root / "info.json"
    told = read_json(info)
    entries = told.get("data_list") if isinstance(told, dict) else None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) and "sample_idx" in entry for entry in entries):
        raise InputError(f"{info}: has no list 'data_list' of samples; name a folder with nuScenes' info file")
    if split != "all":
        raise InputError(f"{root}: has no split {split!r}" + closest(split, ("all",)))
    if not entries:
        raise InputError(f"{info}: lists no sample; complete the data set")
    return [NuscenesSample(info=info, entry=entry) for entry in entries]


def read_sweep(path: Path, name: str) -> Scan:
    """Read a .pcd.bin (x y z intensity ring, float32) in our sensor frame, remission in [0, 1].

    InputError where the file is missing, empty or not a whole number of points.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); complete the data set") from error
    if not data or len(data) % (4 * VALUES):
        raise InputError(f"{path}: {len(data)} bytes are no whole number of points ({4 * VALUES} each); replace it")
    points = np.frombuffer(data, dtype="<f4").reshape(-1, VALUES)
    remission = (points[:, 3] / np.float32(BRIGHTEST)).clip(0, 1)
    return Scan(xyz=moved(points[:, :3], FROM_RIGHT_FORWARD), remission=remission, name=name)
