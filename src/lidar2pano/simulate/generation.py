"""The files of a simulated data set, in SemanticKITTI's layout, and their generation by several processes."""

from __future__ import annotations

import json
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from functools import lru_cache
from itertools import starmap
from multiprocessing import get_context, parent_process
from pathlib import Path

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import write_depth, write_palette, write_png, write_text, write_whole
from lidar2pano.labels import CITYSCAPES
from lidar2pano.markdown import front_matter
from lidar2pano.simulate.layout.street_world import build_world
from lidar2pano.simulate.render.looks import look
from lidar2pano.simulate.render.renderer import RenderedImage, cylinder, pinhole, render
from lidar2pano.simulate.scanner import Sweep, passing_time, sweep
from lidar2pano.simulate.scene.random_streams import stream
from lidar2pano.simulate.scene.raycast import Scene
from lidar2pano.simulate.scene.surfaces import CITYSCAPES_IDS, COMMON15_IDS
from lidar2pano.simulate.sensor_models import SENSOR_MODELS
from lidar2pano.simulate.settings import (
    FORMAT,
    MOST_FRAMES,
    WorldSettings,
    claim_folder,
    panorama_view,
    recording_camera,
)

PAGE = "README.md"
CONTENT = """
Drives through streets that a program made from a seed: no place, person or vehicle in them exists. The layout is
SemanticKITTI's, so that its readers read it; `splits.json` names the frames of `train`, `val` and `all`.

| in each of `sequences/*/` | content |
| --- | --- |
| `velodyne/` | scans of a rotating LiDAR: x, y, z (forward, left, up; metres), remission; float32 |
| `labels/` | SemanticKITTI's raw ids (low 16 bits) and instances (high 16 bits) of the points, uint32 |
| `calib.txt`, `poses.txt`, `times.txt` | KITTI's files |
"""
FOLDERS = {
    "camera": "| `image_2/`, `camera_labels/` | the camera's image, and its classes as Cityscapes' train ids |\n",
    "panorama": "| `pano/`, `pano_labels/`, `pano_depth/` | all around: RGB, ids of common-15, depth"
    " (metres x 256), windows and doors |\n",
}
Writer = Callable[[Path], object]
MOST_PROCESSES = 1024
RANGE_LENGTH = 5  # frames of one task of a process, at most


def data_set_page(settings: WorldSettings) -> str:
    """Return the page of a world: Markdown with a YAML header, a function of its settings alone."""
    header = {
        "license": "apache-2.0",
        "pretty_name": f"lidar2pano world {settings.seed}",
        "tags": ["lidar", "point-cloud", "panorama", "autonomous-driving", "synthetic", "lidar2pano"],
        "task_categories": ["image-segmentation", "depth-estimation", "image-to-image"],
        "annotations_creators": ["machine-generated"],
        "source_datasets": ["original"],
    }
    values = {key: value for key, value in settings.as_dict().items() if key not in ("form", "save", "views")}
    options = " ".join(f"--{key.replace('_', '-')} {value}" for key, value in values.items() if value != "")
    if settings.save:
        options += "".join(f" --view {view}" for view in settings.views)
    options += f" --save {','.join(settings.save) or 'scans'}"
    made = f"Made by `lidar2pano world OUT {options}` (form {FORMAT}): the same seed gives the same bytes.\n"
    folders = "".join(FOLDERS[name] for name in settings.save)
    return f"{front_matter(header)}\n# A simulated world\n{CONTENT}{folders}\n{made}"


class SequenceWriter:
    """One sequence: each of its files is a function of settings, sequence number and frame alone."""

    def __init__(self, folder: Path, settings: WorldSettings, sequence: int) -> None:
        self.folder, self.settings = folder, settings
        self.seed = int(stream(settings.seed, "sequence", sequence).integers(2**31))
        self.world = build_world(self.seed, settings.frames / settings.hz, settings.place)
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
        poses = self.poses(time)
        poses_camera = T @ np.linalg.inv(poses[0]) @ poses @ np.linalg.inv(T)
        lines = [" ".join(f"{value:.9e}" for value in pose[:3].ravel()) for pose in poses_camera]
        write_text(self.folder / "calib.txt", calib)
        write_text(self.folder / "times.txt", "".join(f"{value:.6e}\n" for value in time))
        write_text(self.folder / "poses.txt", "\n".join(lines) + "\n")

    def poses(self, time: np.ndarray) -> np.ndarray:
        """T_world_lidar (N, 4, 4) float64 at times (N,) seconds."""
        return self.world.drive.poses(time, self.settings.sensor_height)

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
        pose = self.poses(np.array([time]))[0]

        def delay(position: np.ndarray) -> float:
            """Seconds until the turn passes a moving object."""
            return float(passing_time(sensor, pose, position[None])[0])

        scene = self.world.scene_at(self.scene(frame), time, delay)
        return sweep(scene, sensor, lambda ahead: self.poses(time + ahead), stream(self.seed, "sweep", frame))

    def images(self, frame: int) -> Iterator[tuple[str, RenderedImage]]:
        """The images of a frame: "camera" and each of the views, as far as they are saved."""
        time = frame / self.settings.hz
        scene, pose = self.world.scene_at(self.scene(frame), time), self.poses(np.array([time]))[0]
        light = look(self.settings.look, self.seed)
        if "camera" in self.settings.save:
            yield "camera", render(scene, pinhole(recording_camera(), pose), light, seed=frame)
        if "panorama" in self.settings.save:
            for view in self.settings.views:
                yield view, render(scene, cylinder(panorama_view(view), pose), light, seed=frame)

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
    return [
        lambda path: write_png(path, rendered.image),
        lambda path: write_palette(path, ids),
        lambda path: write_depth(path, depth_m),
    ]


def _panorama_folders(view: str, *, first: bool) -> tuple[str, ...]:
    """pano, pano_labels and pano_depth of the first view; with "-2" of a further "panorama/2", "-tall-2" likewise."""
    part = "" if first else "-" + view.removeprefix("panorama/").removeprefix("panorama-").replace("/", "-")
    return tuple(f"pano{layer}{part}" for layer in ("", "_labels", "_depth"))


def generate(out: Path, settings: WorldSettings, sequences: int, processes: int) -> Iterator[int]:
    """Write `sequences` sequences into `out`; yields numbers of frames as they are completed.

    Frames whose files all exist are kept. Raises InputError where `out` holds another world or cannot be written, and
    where a process was killed.
    """
    if sequences < 1 or not 1 <= processes <= MOST_PROCESSES:
        raise InputError(f"--sequences and --processes must be at least 1, processes at most {MOST_PROCESSES}")
    if sequences * settings.frames > MOST_FRAMES:
        raise InputError(f"--sequences x --frames must be at most {MOST_FRAMES}")
    claim_folder(out, settings)
    if not (out / PAGE).exists():  # one that is there may be someone's own
        write_text(out / PAGE, data_set_page(settings))
    _write_splits(out, sequences, settings.frames)
    ranges = [
        (out, settings, sequence, first, min(first + RANGE_LENGTH, settings.frames))
        for sequence in range(sequences)
        for first in range(0, settings.frames, RANGE_LENGTH)
    ]
    yield from starmap(write_frames, ranges) if processes == 1 else _in_parallel(ranges, processes)


def _in_parallel(ranges: list[tuple[Path, WorldSettings, int, int, int]], processes: int) -> Iterator[int]:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # processes share the cores, so each takes one
    size = -(-len(ranges) // processes)  # of runs of equal length: neighbours share a static scene
    queues = [ranges[first : first + size] for first in range(0, len(ranges), size)]
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn"), initializer=_end_with_parent) as pool:
        running = {pool.submit(write_frames, *queue.pop(0)): queue for queue in queues}
        try:
            while running:
                finished, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in finished:
                    queue = running.pop(future)
                    if queue:
                        running[pool.submit(write_frames, *queue.pop(0))] = queue
                    yield future.result()
        except BrokenProcessPool as error:
            raise InputError(
                "a process was killed, perhaps for lack of memory; repeat the command with fewer --processes"
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _end_with_parent() -> None:
    """End this worker when its parent process has ended, for any reason."""

    def watch() -> None:
        if parent := parent_process():
            parent.join()
            signal.raise_signal(signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


def write_frames(out: Path, settings: WorldSettings, sequence: int, first: int, last: int) -> int:
    """Write the missing ones of the frames [first, last) of a sequence; return the number of all."""
    writer = _writer(out, settings, sequence)
    writer.prepare()
    for frame in range(first, last):
        if not all(path.is_file() for path in writer.files(frame)):
            writer.write(frame)
    return last - first


@lru_cache(maxsize=1)
def _writer(out: Path, settings: WorldSettings, sequence: int) -> SequenceWriter:
    return SequenceWriter(out / "sequences" / f"{sequence:02d}", settings, sequence)


def _write_splits(out: Path, sequences: int, frames: int) -> None:
    """Write splits.json: the last tenth of several sequences, one at least, is `val`."""
    val = max(sequences // 10, 1) if sequences > 1 else 0
    names = {
        "train": range(sequences - val),
        "val": range(sequences - val, sequences) if val else range(sequences),
        "all": range(sequences),
    }
    splits = {
        name: [f"{sequence:02d}/{frame:06d}" for sequence in numbers for frame in range(frames)]
        for name, numbers in names.items()
    }
    write_text(out / "splits.json", json.dumps(splits, indent=1) + "\n")
