"""Recording: the files of a simulated drive, in SemanticKITTI's layout."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from lidar2pano.formats.output_files import write_depth, write_palette, write_png, write_whole
from lidar2pano.labels import CITYSCAPES
from lidar2pano.simulate.beams import SENSORS
from lidar2pano.simulate.camera import Picture, cylinder, pinhole, render
from lidar2pano.simulate.draws import stream
from lidar2pano.simulate.kinds import CAMERA_IDS, COMMON_IDS
from lidar2pano.simulate.lidar import Sweep, passing, sweep
from lidar2pano.simulate.looks import look
from lidar2pano.simulate.raycast import Scene
from lidar2pano.simulate.settings import Settings, camera, raster
from lidar2pano.simulate.world import World, world

Writer = Callable[[Path], object]


class Recording:
    """One sequence of a world: writes whole files, each a function of settings, sequence and frame alone."""

    def __init__(self, folder: Path, settings: Settings, sequence: int) -> None:
        self.folder, self.settings = folder, settings
        self.seed = int(stream(settings.seed, "sequence", sequence).integers(2**31))
        self.world: World = world(self.seed, settings.frames / settings.hz, settings.place)
        self._window: tuple[int, Scene] | None = None

    def files(self, frame: int) -> list[Path]:
        """The files of a frame, the last one written last."""
        stem, settings = f"{frame:06d}", self.settings
        names = [f"velodyne/{stem}.bin", f"labels/{stem}.label"]
        if "camera" in settings.save:
            names += [f"image_2/{stem}.png", f"camera_labels/{stem}.png"]
        if "panorama" in settings.save:
            for number, view in enumerate(settings.views):
                names += [f"{folder}/{stem}.png" for folder in _panorama_folders(view, first=number == 0)]
        return [self.folder / name for name in names]

    def done(self, frame: int) -> bool:
        """Whether all files of a frame are there."""
        return all(path.is_file() for path in self.files(frame))

    def prepare(self) -> None:
        """Write what is missing of calib.txt, times.txt and poses.txt.

        Poses are KITTI's odometry form: camera 0 relative to the first frame.
        """
        if all((self.folder / name).is_file() for name in ("calib.txt", "times.txt", "poses.txt")):
            return
        calibration = camera()
        T = calibration.T_camera_lidar
        row = " ".join(f"{value:.12e}" for value in T[:3].ravel())
        P = " ".join(f"{value:.12e}" for value in np.column_stack([calibration.K, np.zeros(3)]).ravel())
        calib = "".join(f"P{index}: {P}\n" for index in range(4)) + f"Tr: {row}\n"
        time = np.arange(self.settings.frames) / self.settings.hz
        poses = self.world.drive.poses(time)
        way = T @ np.linalg.inv(poses[0]) @ poses @ np.linalg.inv(T)
        lines = [" ".join(f"{value:.9e}" for value in pose[:3].ravel()) for pose in way]
        self._text("calib.txt", calib)
        self._text("times.txt", "".join(f"{value:.6e}\n" for value in time))
        self._text("poses.txt", "\n".join(lines) + "\n")

    def _text(self, name: str, text: str) -> None:
        write_whole(self.folder / name, lambda path: path.write_text(text, encoding="utf-8"))

    def scene(self, frame: int) -> Scene:
        """The scene at the moment of a frame."""
        number = self.world.window_at(frame / self.settings.hz)
        if self._window is None or self._window[0] != number:
            self._window = None  # the old one's memory goes first
            self._window = number, self.world.window(number)
        return self._window[1]

    def scan(self, frame: int) -> Sweep:
        """What the LiDAR gives."""
        time, sensor = frame / self.settings.hz, SENSORS[self.settings.sensor]
        pose = self.world.drive.poses(np.array([time]))[0]
        # What moves stands where the turn meets it.
        scene = self.world.scene_at(self.scene(frame), time, lambda at: float(passing(sensor, pose, at[None])[0]))
        return sweep(
            scene,
            sensor,
            lambda ahead: self.world.drive.poses(time + ahead),
            stream(self.seed, "sweep", frame),
        )

    def pictures(self, frame: int) -> Iterator[tuple[str, Picture]]:
        """What the cameras see: "camera" and then each of the views, as far as they are wanted."""
        time = frame / self.settings.hz
        scene, pose = self.world.scene_at(self.scene(frame), time), self.world.drive.poses(np.array([time]))[0]
        light = look(self.settings.look, self.seed)
        if "camera" in self.settings.save:
            yield "camera", render(scene, *pinhole(camera(), pose), light, seed=frame)
        if "panorama" in self.settings.save:
            for view in self.settings.views:
                yield view, render(scene, *cylinder(raster(view), pose), light, seed=frame)

    def write(self, frame: int) -> None:
        """Write the files of a frame."""
        scan = self.scan(frame)
        label = (scan.instance.astype(np.uint32) << 16) | scan.raw
        writers: list[Writer] = [
            lambda path: scan.points.astype("<f4").tofile(path),
            lambda path: label.astype("<u4").tofile(path),
        ]
        for name, picture in self.pictures(frame):
            writers += _camera(picture) if name == "camera" else _panorama(picture)
        for path, write in zip(self.files(frame), writers, strict=True):
            write_whole(path, write)


def _camera(picture: Picture) -> list[Writer]:
    ids = CAMERA_IDS[picture.kind]
    return [lambda path: write_png(path, picture.colour), lambda path: write_palette(path, ids, CITYSCAPES)]


def _panorama(picture: Picture) -> list[Writer]:
    ids = COMMON_IDS[picture.kind]
    far = np.where(np.isfinite(picture.distance), picture.distance, 0)
    return [
        lambda path: write_png(path, picture.colour),
        lambda path: write_palette(path, ids),
        lambda path: write_depth(path, far),
    ]


def _panorama_folders(view: str, *, first: bool) -> tuple[str, str, str]:
    """pano, pano_labels, pano_depth for the first raster; the same with "-2" behind for a further "panorama/2"."""
    part = "" if first else "-" + view.removeprefix("panorama/")
    return f"pano{part}", f"pano_labels{part}", f"pano_depth{part}"
