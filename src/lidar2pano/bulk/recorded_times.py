"""KITTI's files of a recording's sequence: times.txt; and poses.txt with calib.txt, if the recording holds poses."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from typing import NamedTuple

import numpy as np

from lidar2pano.bulk.entries import SEMANTIC_KITTI, Entry, Shard
from lidar2pano.bulk.job import Job
from lidar2pano.bulk.scan_reading import OpenRecording
from lidar2pano.bulk.stores import Folder, Store, local_copy, open_store
from lidar2pano.errors import InputError
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.recordings.playback import Playback, playback

TIMES, POSES, CALIB = "times.txt", "poses.txt", "calib.txt"
# T_camera0_lidar of calib.txt: the axes of KITTI's camera 0 (x right, y down, z forward) at the sensor's own place.
CAMERA0 = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


class RecordedSequence(NamedTuple):
    """A recording, and the name of its sequence in the output."""

    recording: str
    name: str

    @property
    def folder(self) -> str:
        """The sequence's folder below OUT."""
        return f"sequences/{self.name}"


def untimed(job: Job, listed: list[Entry], shard: Shard) -> list[RecordedSequence]:
    """List the recordings whose files this shard still has to write: the shard with their last scans does.

    listed  the shard's scans.
    """
    if job.layout != SEMANTIC_KITTI:
        return []
    source, out = open_store(job.source), open_store(job.out)
    recorded = {RecordedSequence(entry.key.input, entry.sequence) for entry in listed if entry.key.scan is not None}
    own = (item for item in sorted(recorded) if not isinstance(source, Folder) or shard.takes_end(item.recording))
    return [item for item in own if not out.exists(f"{item.folder}/{TIMES}")]


def write_times(job: Job, sequence: RecordedSequence, stopped: Callable[[], bool]) -> bool:
    """Write the files of one sequence; return false if it was stopped, and nothing written.

    Line n of times.txt and poses.txt is scan n of the recording, whichever scans are chosen. times.txt is written last:
    once it exists, no other file is missing. Raises InputError if the recording cannot be read any more,
    or OUT cannot be written.
    """
    source, out = open_store(job.source), open_store(job.out)
    with (
        local_copy(source, sequence.recording) as path,
        closing(playback(path, job.selection.topic)) as opened,
    ):
        stamps_s, poses = [], []
        for stamp_s, pose in _track(opened):
            if stopped():
                return False
            stamps_s.append(stamp_s)
            poses.append(pose)
    _write(out, sequence.folder, _texts(np.array(stamps_s), poses))
    return True


def _track(opened: Playback) -> Iterator[tuple[float, np.ndarray | None]]:
    """Yield each scan's time, seconds since the epoch, and T_world_sensor (4, 4) float64, None if unknown.

    A damaged scan is as late behind its recording as the one before it.
    """
    recording, late_s = OpenRecording(opened), 0.0
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


def _write(out: Store, folder: str, texts: dict[str, str]) -> None:
    with out.scratch() as scratch:
        for name, text in texts.items():
            (scratch / name).write_text(text, encoding="utf-8")
            out.put(scratch / name, f"{folder}/{name}")
