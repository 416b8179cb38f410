"""Samples of nuScenes as files: a 32-beam sweep and six cameras (Caesar et al. 2020, CC BY-NC-SA 4.0).

ROOT/info.json lists the samples in the form of mmdetection3d's info files (`data_list`), the images and sweeps lie
beside it. Its LiDAR has x to the right and y forward. For the data set in its official layout: `nuscenes_samples`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano.data.frames import Frame, FrameList
from lidar2pano.data.surround import FROM_RIGHT_FORWARD, SurroundFrame, matrix, moved, read_camera
from lidar2pano.bounded_files import read_bytes
from lidar2pano.errors import InputError, closest
from lidar2pano.formats.json_files import read_json
from lidar2pano.formats.scan_files import MOST_BYTES
from lidar2pano.geometry.stitching import CameraImage
from lidar2pano.scan import Scan
from lidar2pano.views import View

VALUES = 5  # float32 a point: x y z intensity ring
BRIGHTEST = 255  # intensity
# The lid of the boot in the backward image, (u, v) of 1600 x 900.
VEHICLE_LINES = {"CAM_BACK": ((0, 900), (184, 888), (800, 850), (1420, 888), (1599, 900))}
FROM_OURS = np.linalg.inv(FROM_RIGHT_FORWARD)


class NuscenesFrame(SurroundFrame):
    """One entry of `data_list` in the file `info`; its name is "nuscenes/NNNNNN", by the sample's number."""

    front = "CAM_FRONT"

    def __init__(self, info: Path, view: View, entries: Mapping[str, Mapping[str, Any]], name: str) -> None:
        super().__init__(name, view)
        self.info, self.entry, self.root = info, entries[name], info.parent

    @cached_property
    def cameras(self) -> Mapping[str, CameraImage]:
        """See SurroundFrame."""
        cameras = self._part("images")
        if self.front not in cameras:
            raise InputError(
                f"{self.info}: sample {self.name} has no camera {self.front}; take the file from the data set"
            )
        return {
            name: read_camera(
                self._file(camera, "img_path"),
                matrix(self.info, camera, "cam2img", (3, 3)),
                matrix(self.info, camera, "lidar2cam", (4, 4)) @ FROM_OURS,
                VEHICLE_LINES.get(name, ()),
            )
            for name, camera in cameras.items()
        }

    @cached_property
    def whole_scan(self) -> Scan:
        """See SurroundFrame."""
        return read_sweep(self._file(self._part("lidar_points"), "lidar_path"), self.name)

    @cached_property
    def pose(self) -> np.ndarray:
        """See Frame."""
        ego = matrix(self.info, self.entry, "ego2global", (4, 4))
        return ego @ matrix(self.info, self._part("lidar_points"), "lidar2ego", (4, 4)) @ FROM_OURS

    def _part(self, name: str) -> Mapping[str, Any]:
        part = self.entry.get(name)
        if not isinstance(part, dict):
            raise InputError(f"{self.info}: sample {self.name} has no {name!r}; take the file from the data set")
        return part

    def _file(self, part: Any, name: str) -> Path:  # noqa: ANN401 of a JSON file
        if not isinstance(part, dict) or not isinstance(part.get(name), str):
            raise InputError(f"{self.info}: sample {self.name} has no {name!r}; take the file from the data set")
        return self.info.parent / part[name]


def frames(root: Path, split: str, view: View) -> FrameList[Frame]:
    """Samples of a split, in the file's order: there is only "all". InputError where there is none."""
    info = root / "info.json"
    content = read_json(info, nan=True)
    entries = content.get("data_list") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"{info}: has no list 'data_list' of samples; name a folder with nuScenes' info file")
    if split != "all":
        raise InputError(f"{root}: has no split {split!r}" + closest(split, ("all",)))
    if not entries:
        raise InputError(f"{info}: lists no sample; complete the data set")
    try:
        named = {f"nuscenes/{int(entry['sample_idx']):06d}": entry for entry in entries}
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{info}: has a sample without a number 'sample_idx'; take the file from the data set"
        ) from error
    open_frame = partial(NuscenesFrame, info, view, named)
    return FrameList("nuscenes", ((name, open_frame) for name in named))


def read_sweep(path: Path, name: str) -> Scan:
    """Read a .pcd.bin (x y z intensity ring, float32) in our sensor frame, remission in [0, 1].

    InputError where the file is missing, empty or not a whole number of points.
    """
    try:
        data = read_bytes(path, MOST_BYTES)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); complete the data set") from error
    if not data or len(data) % (4 * VALUES):
        raise InputError(f"{path}: {len(data)} bytes are no whole number of points ({4 * VALUES} each); replace it")
    points = np.frombuffer(data, dtype="<f4").reshape(-1, VALUES)
    remission = (points[:, 3] / np.float32(BRIGHTEST)).clip(0, 1)
    return Scan(xyz=moved(points[:, :3], FROM_RIGHT_FORWARD), remission=remission, name=name)
