"""Writer of a simulated sequence, in the layout of SemanticKITTI."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from lidar2pano.formats.image_files import write_depth, write_ids, write_palette, write_png, write_whole
from lidar2pano.labels import CITYSCAPES
from lidar2pano.simulate.dataset.settings import WorldSettings, panorama_view, recording_camera
from lidar2pano.simulate.layout.street_world import World, build_world
from lidar2pano.simulate.lidar.scanner import Sweep, passing_time, sweep
from lidar2pano.simulate.lidar.sensor_models import SENSOR_MODELS
from lidar2pano.simulate.render.looks import look
from lidar2pano.simulate.render.renderer import RenderedImage, cylinder, pinhole, render
from lidar2pano.simulate.scene.random_streams import stream
from lidar2pano.simulate.scene.raycast import Scene
from lidar2pano.simulate.scene.surfaces import CITYSCAPES_IDS, COMMON15_IDS, IN_OPENINGS, OBJECT_TYPE_IDS

Writer = Callable[[Path], object]


class SequenceWriter:
    """One sequence: each of its files is a function of settings, sequence number and frame alone."""

    def __init__(self, folder: Path, settings: WorldSettings, sequence: int) -> None:
        self.folder, self.settings = folder, settings
        self.seed = int(stream(settings.seed, "sequence", sequence).integers(2**31))
        self.world: World = build_world(self.seed, settings.frames / settings.hz, settings.place)
        self._window: tuple[int, Scene] | None = None

    def files(self, frame: int) -> list[Path]:
        """The files of a frame, in the order of writing."""
        stem, settings = f"{frame:06d}", self.settings
        names = [f"velodyne/{stem}.bin", f"labels/{stem}.label"]
        if "camera" in settings.save:
            names += [f"image_2/{stem}.png", f"camera_labels/{stem}.png"]
        if "panorama" in settings.save:
            for number, view in enumerate(settings.views):
                names += [f"{folder}/{stem}.png" for folder in _panorama_folders(view, first=number == 0)]
        return [self.folder / name for name in names]

    def is_complete(self, frame: int) -> bool:
        """Whether all files of a frame exist."""
        return all(path.is_file() for path in self.files(frame))

    def prepare(self) -> None:
        """Write calib.txt, times.txt and poses.txt unless they exist.

        Poses as in KITTI odometry: T_world_camera, where the world is camera 0 of the first frame.
        """
        if all((self.folder / name).is_file() for name in ("calib.txt", "times.txt", "poses.txt")):
            return
        calibration = recording_camera()
        T = calibration.T_camera_lidar
        row = " ".join(f"{value:.12e}" for value in T[:3].ravel())
        P = " ".join(f"{value:.12e}" for value in np.column_stack([calibration.K, np.zeros(3)]).ravel())
        calib = "".join(f"P{index}: {P}\n" for index in range(4)) + f"Tr: {row}\n"
        time = np.arange(self.settings.frames) / self.settings.hz
        poses = self.world.drive.poses(time)
        poses_camera = T @ np.linalg.inv(poses[0]) @ poses @ np.linalg.inv(T)
        lines = [" ".join(f"{value:.9e}" for value in pose[:3].ravel()) for pose in poses_camera]
        self._text("calib.txt", calib)
        self._text("times.txt", "".join(f"{value:.6e}\n" for value in time))
        self._text("poses.txt", "\n".join(lines) + "\n")

    def _text(self, name: str, text: str) -> None:
        write_whole(self.folder / name, lambda path: path.write_text(text, encoding="utf-8"))

    def scene(self, frame: int) -> Scene:
        """The static scene around a frame."""
        number = self.world.window_at(frame / self.settings.hz)
        if self._window is None or self._window[0] != number:
            self._window = None  # its memory is freed first
            self._window = number, self.world.window(number)
        return self._window[1]

    def scan(self, frame: int) -> Sweep:
        """The LiDAR scan of a frame."""
        time, sensor = frame / self.settings.hz, SENSOR_MODELS[self.settings.sensor]
        pose = self.world.drive.poses(np.array([time]))[0]
        # Each moving object is where the turn passes it.
        scene = self.world.scene_at(self.scene(frame), time, lambda at: float(passing_time(sensor, pose, at[None])[0]))
        return sweep(
            scene, sensor, lambda ahead: self.world.drive.poses(time + ahead), stream(self.seed, "sweep", frame)
        )

    def images(self, frame: int) -> Iterator[tuple[str, RenderedImage]]:
        """The images of a frame: "camera" and each of the views, as far as they are saved."""
        time = frame / self.settings.hz
        scene, pose = self.world.scene_at(self.scene(frame), time), self.world.drive.poses(np.array([time]))[0]
        light = look(self.settings.look, self.seed)
        if "camera" in self.settings.save:
            yield "camera", render(scene, *pinhole(recording_camera(), pose), light, seed=frame)
        if "panorama" in self.settings.save:
            for view in self.settings.views:
                yield view, render(scene, *cylinder(panorama_view(view), pose), light, seed=frame)

    def write(self, frame: int) -> None:
        """Write the files of a frame."""
        scan = self.scan(frame)
        label = (scan.instance.astype(np.uint32) << 16) | scan.raw
        writers: list[Writer] = [
            lambda path: scan.points.astype("<f4").tofile(path),
            lambda path: label.astype("<u4").tofile(path),
        ]
        for name, rendered in self.images(frame):
            writers += _camera(rendered) if name == "camera" else _panorama(rendered)
        for path, write in zip(self.files(frame), writers, strict=True):
            write_whole(path, write)


def _camera(rendered: RenderedImage) -> list[Writer]:
    ids = CITYSCAPES_IDS[rendered.object_type]
    return [lambda path: write_png(path, rendered.image), lambda path: write_palette(path, ids, CITYSCAPES)]


def _panorama(rendered: RenderedImage) -> list[Writer]:
    ids = COMMON15_IDS[rendered.object_type]
    depth_m = np.where(np.isfinite(rendered.distance), rendered.distance, 0)
    building = rendered.object_type == OBJECT_TYPE_IDS["building"]
    openings = (building & np.isin(rendered.material, IN_OPENINGS)).astype(np.uint8) * 255
    return [
        lambda path: write_png(path, rendered.image),
        lambda path: write_palette(path, ids),
        lambda path: write_depth(path, depth_m),
        lambda path: write_ids(path, openings),
    ]


def _panorama_folders(view: str, *, first: bool) -> tuple[str, ...]:
    """pano, pano_labels, pano_depth and pano_openings of the first view; with "-2" of a further "panorama/2"."""
    part = "" if first else "-" + view.removeprefix("panorama/")
    return tuple(f"pano{layer}{part}" for layer in ("", "_labels", "_depth", "_openings"))
