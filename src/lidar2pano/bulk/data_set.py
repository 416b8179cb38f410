"""Data sets in SemanticKITTI's layout: instances on panoramas, copied calibrations, times and poses of recordings."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import closing

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from lidar2pano.bulk.entries import SEMANTIC_KITTI as KITTI_LAYOUT
from lidar2pano.bulk.entries import Entry, Job, Shard
from lidar2pano.bulk.scan_reading import OpenRecording
from lidar2pano.bulk.stores import Folder, Store, local_copy, open_store, put_bytes
from lidar2pano.errors import InputError
from lidar2pano.formats.interpretation import Overrides
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.geometry.projection import project
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI, TABLES, THINGS
from lidar2pano.panorama import Panorama
from lidar2pano.recordings.playback import Playback
from lidar2pano.recordings.reading_process import confined_playback
from lidar2pano.scan import Scan

REACH = 12  # pixels of the translator's raster: beams are up to about so many rows apart
TIMES, POSES, CALIB = "times.txt", "poses.txt", "calib.txt"
# T_camera0_lidar of calib.txt: the axes of KITTI's camera 0 (x right, y down, z forward) at the sensor's own place.
CAMERA0 = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def copy_sequences(source: Store, out: Store, listed: list[Entry]) -> None:
    """Copy splits, calibrations, times and poses beside the panoramas of scan files."""
    _copy_beside(source, out, "splits.json", "splits.json")
    of_files = [entry for entry in listed if entry.key.scan is None and not entry.error]
    for folder, sequence in sorted({(_sequence_folder(entry), entry.sequence) for entry in of_files}):
        for name in (CALIB, POSES, TIMES):
            _copy_beside(source, out, f"{folder}{name}", f"sequences/{sequence}/{name}")


def _sequence_folder(entry: Entry) -> str:
    folder = entry.key.input.rpartition("/")[0]
    parent = folder.removesuffix("velodyne").rstrip("/")
    return f"{parent}/" if parent else ""


def _copy_beside(source: Store, out: Store, name: str, target: str) -> None:
    """Copy a small file of a data set, unless it is there or there is none."""
    if source.exists(name) and not out.exists(target):
        with source.local(name) as path, out.scratch() as scratch:
            shutil.copyfile(path, scratch / "copy")
            out.put(scratch / "copy", target)


def instance_raster(scan: Scan, instance: np.ndarray, panorama: Panorama) -> np.ndarray:
    """Return instance ids (h, w) uint16 on the panorama's raster, 0 for none.

    scan      with labels;  instance: (N,) uint16 ids of its points, unique within a class.
    A pixel gets the instance of the nearest point of the pixel's own class, at most 2 REACH pixels away through pixels
    of that class; of several equally near ones, the greatest id.
    """
    assert scan.label is not None
    image = project(scan.beyond(), panorama.view.scaled(1 / 2))
    ids = image.spread(torch.from_numpy(instance.astype(np.int64)))
    table = torch.from_numpy(TABLES[SEMANTIC_KITTI.name, COMMON15.name])
    classes = image.spread(table[torch.from_numpy(scan.label)])
    segments = torch.from_numpy(panorama.segments)
    rows = [segments[row::2, column::2] for row in (0, 1) for column in (0, 1)]
    instances = torch.zeros(segments.shape, dtype=torch.int64)
    for thing in THINGS:
        seeds = ids * (classes == thing)
        if not bool(seeds.any()):
            continue
        inside = torch.stack([part == thing for part in rows]).any(0)
        grown = grow(seeds * inside, inside, REACH)
        instances = torch.where(segments == thing, grown.repeat_interleave(2, 0).repeat_interleave(2, 1), instances)
    return instances.numpy().astype(np.uint16)


def grow(seeds: Tensor, inside: Tensor, steps: int) -> Tensor:
    """Spread ids (H, W) int64 from `seeds` (0: none) over the pixels `inside`, one pixel all around per step.

    The columns are circular. Of several ids in the same step a pixel takes the greatest.
    """
    grown = seeds
    for _ in range(steps):
        padded = pad(pad(grown[None, None].float(), (1, 1, 0, 0), mode="circular"), (0, 0, 1, 1))
        reached = max_pool2d(padded, 3, stride=1)[0, 0].long()  # ids of 16 bits are exact as float32
        grown = torch.where((grown == 0) & inside, reached, grown)
    return grown


def untimed(job: Job, listed: list[Entry], shard: Shard) -> list[tuple[str, str]]:
    """List recordings, and names of their sequences, whose files this shard has to write, as it has their last scans.

    listed  the shard's scans.
    """
    if job.layout != KITTI_LAYOUT:
        return []
    source, out = open_store(job.source), open_store(job.out)
    recorded = {(entry.key.input, entry.sequence) for entry in listed if entry.key.scan is not None}
    own = (item for item in sorted(recorded) if not isinstance(source, Folder) or shard.takes_end(item[0]))
    return [(recording, name) for recording, name in own if not out.exists(f"sequences/{name}/{TIMES}")]


def write_times(job: Job, recording: str, name: str, stopped: Callable[[], bool]) -> bool:
    """Write the files of a recording's sequence; return false if it was stopped, and nothing written.

    Line n of times.txt and poses.txt is scan n of the recording, whichever scans are chosen. times.txt is written last:
    once it exists, no other file is missing. Raises InputError if the recording cannot be read any more,
    or OUT cannot be written.
    """
    source, out = open_store(job.source), open_store(job.out)
    with (
        local_copy(source, recording) as path,
        closing(confined_playback(path, job.reading.selection.topic)) as opened,
    ):
        stamps_s, poses = [], []
        for stamp_s, pose in _track(opened, job.reading.overrides):
            if stopped():
                return False
            stamps_s.append(stamp_s)
            poses.append(pose)
    for file, text in _texts(np.array(stamps_s), poses).items():
        put_bytes(out, f"sequences/{name}/{file}", text.encode())
    return True


def _track(opened: Playback, overrides: Overrides) -> Iterator[tuple[float, np.ndarray | None]]:
    """Yield each scan's time, seconds since the epoch, and T_world_sensor (4, 4) float64, None if unknown.

    A damaged scan is as late behind its recording as the one before it.
    """
    recording, late_s = OpenRecording(opened, overrides), 0.0
    for number in opened.numbers(ReadOptions()):
        try:
            stamp_s, pose = recording.pose(number)
            late_s = stamp_s - opened.recorded_s(number)
            yield stamp_s, pose
        except InputError:
            yield opened.recorded_s(number) + late_s, None


def _texts(stamp_s: np.ndarray, poses: list[np.ndarray | None]) -> dict[str, str]:
    """Return the files' contents by their names. An unknown pose is a line of NaN."""
    texts: dict[str, str] = {}
    available = [pose for pose in poses if pose is not None]
    if available:
        origin = CAMERA0 @ np.linalg.inv(available[0])
        unknown = np.full((4, 4), np.nan)
        of_camera = (unknown if pose is None else origin @ pose @ np.linalg.inv(CAMERA0) for pose in poses)
        texts[CALIB] = f"Tr: {_line(CAMERA0)}\n"
        texts[POSES] = "".join(f"{_line(pose)}\n" for pose in of_camera)
    texts[TIMES] = "".join(f"{after_s:.6f}\n" for after_s in stamp_s - stamp_s[0])
    return texts


def _line(T: np.ndarray) -> str:
    return " ".join(f"{value:.9e}" for value in T[:3].ravel())
