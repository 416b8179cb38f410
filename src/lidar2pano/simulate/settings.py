"""Settings of a simulated data set: everything its content depends on."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano.calibration import Calibration
from lidar2pano.errors import InputError, closest
from lidar2pano.formats.image_files import write_text
from lidar2pano.formats.json_files import read_json
from lidar2pano.simulate.layout.town import PLACES
from lidar2pano.simulate.layout.traffic import SENSOR_HEIGHT
from lidar2pano.simulate.render.looks import LOOKS
from lidar2pano.simulate.sensor_models import SENSOR_MODELS
from lidar2pano.views import KITTI_CAMERA, VIEWS, View

SAVES = ("camera", "panorama")
FORMAT = 2  # raised when the same settings give another world
IMAGE = (1242, 375)
LOWEST, HIGHEST = 0.3, 4.0  # metres above the road: delivery robots, lorries
MOST_FRAMES = 1_000_000  # of a world: some terabytes
# KITTI's colour camera: focal length and principal point in pixels, tilt as on its car.
K = np.array([[721.5377, 0.0, 609.5593], [0.0, 721.5377, 172.854], [0.0, 0.0, 1.0]])
PITCH, ROLL = 0.0104, 0.0104  # radians: upwards, and to the side


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldSettings:
    """Options of `lidar2pano world`.

    frames  per sequence, `hz` a second;  sensor in SENSOR_MODELS;  look in LOOKS;  place in PLACES, "" = random.
    sensor_height  metres above the road; the camera is mounted on the sensor.
    save    names in SAVES, besides scans and labels;  views: rasters of the panorama, "panorama" or "panorama/2".
    """

    seed: int = 0
    frames: int = 20
    hz: float = 10.0
    sensor: str = "hdl64e"
    look: str = "day"
    place: str = ""
    sensor_height: float = SENSOR_HEIGHT
    save: tuple[str, ...] = SAVES
    views: tuple[str, ...] = ("panorama",)

    def __post_init__(self) -> None:
        """Raise InputError for values out of range and unknown names."""
        if not 1 <= self.frames <= MOST_FRAMES:
            raise InputError(f"--frames must be at least 1 and at most {MOST_FRAMES}")
        if not 0 <= self.seed < 2**63:
            raise InputError(f"--seed must be at least 0 and at most {2**63 - 1}")
        if not 0.1 <= self.hz <= 100:
            raise InputError("--hz must lie between 0.1 and 100 frames a second")
        if not LOWEST <= self.sensor_height <= HIGHEST:
            raise InputError(f"--sensor-height must lie between {LOWEST} and {HIGHEST} metres")
        for value, table, option in (
            (self.sensor, SENSOR_MODELS, "--sensor"),
            (self.look, LOOKS, "--look"),
            (self.place or "residential", PLACES, "--place"),
        ):
            if value not in table:
                raise InputError(f"{option} {value!r} is not known" + closest(value, table))
        if unknown := sorted(set(self.save) - set(SAVES)):
            raise InputError(f"--save {unknown[0]!r} is not known; there is scans, {', '.join(SAVES)} and all")
        for name in self.views:
            panorama_view(name)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {"form": FORMAT} | {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(self).items()}


def panorama_view(name: str) -> View:
    """The view of a name such as "panorama" or "panorama/2" (half the resolution); InputError for other names."""
    base, _, part = name.partition("/")
    cylinders = [key for key, view in VIEWS.items() if view.kind == "cylinder"]
    if base not in cylinders or (part and part not in ("2", "4", "8")):
        raise InputError(f"--view {name!r} is not known; there is {', '.join(cylinders)}, and each /2, /4 or /8")
    return VIEWS[base].scaled(1 / int(part or 1))


def recording_camera() -> Calibration:
    """The camera of the recording car: KITTI's colour camera, at the origin of the panorama."""
    axes = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # x right, y down, z ahead
    c, s = np.cos(PITCH), np.sin(PITCH)
    pitch = np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    c, s = np.cos(ROLL), np.sin(ROLL)
    roll = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    T = np.eye(4)
    T[:3, :3] = roll @ pitch @ axes
    T[:3, 3] = -T[:3, :3] @ np.array(KITTI_CAMERA)
    return Calibration(K=K, T_camera_lidar=T, size=IMAGE)


def claim_folder(out: Path, settings: WorldSettings) -> None:
    """Write world.json into the folder; InputError where it holds a world of other settings or other data."""
    card, expected = out / "world.json", settings.as_dict()
    if card.is_file():
        stored = read_json(card, "remove it, or choose another folder")
        if not isinstance(stored, dict):
            raise InputError(f"{card}: holds no settings of a world; remove it, or choose another folder")
        stored = {"sensor_height": SENSOR_HEIGHT} | stored  # worlds were made before it could be set
        if changed := [key for key in expected if stored.get(key) != expected[key]]:
            was = ", ".join(f"{key}={stored.get(key)!r}" for key in changed)
            raise InputError(f"{out}: holds another world ({was}); repeat its settings, or choose another folder")
        return
    if (out / "sequences").exists():
        raise InputError(f"{out}: holds a data set that is no simulated world; choose another folder")
    write_text(card, json.dumps(expected, indent=2) + "\n")
