"""How long the street world takes: to build a piece of it, a scan, a frame with everything, many frames at once."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

from lidar2pano.bench.timings import Row
from lidar2pano.simulate.dataset.generation import produce
from lidar2pano.simulate.dataset.sequence_writer import Recording
from lidar2pano.simulate.dataset.settings import Settings

SEED, PLACE = 5, "residential"
AIMS = {"scan": "< 150", "frame": "< 4000 on two cores"}


def measure_world(runs: int, processes: int) -> list[Row]:
    """Time one street: its build, `runs` scans and whole frames in this process, and frames over `processes`.

    A frame is an HDL-64E scan with labels, the 1242 x 375 camera and the 384 x 4608 panorama with their classes and
    depth, written to files. Raises InputError without embreex.
    """
    settings = Settings(seed=SEED, frames=max(runs + 1, 10 * processes), place=PLACE)
    with tempfile.TemporaryDirectory() as folder:
        recording = Recording(Path(folder) / "one", settings, 0)
        build = _times(recording.scene, 1)
        scans = _times(recording.scan, runs + 1)[1:]
        whole = _times(recording.write, runs + 1)[1:]  # the first one makes the textures
        rows = [
            _row("world: build a piece of a town", build),
            _row("world: scan with labels", scans, AIMS["scan"]),
            _row("world: whole frame, one process", whole),
        ]
        begin = time.perf_counter()
        frames = sum(produce(Path(folder) / "many", settings, 1, processes))
        each = (time.perf_counter() - begin) * 1e3 / frames
        what = f"world: whole frame, {processes} processes, {frames} frames, start and build included"
        return [*rows, _row(what, [each], AIMS["frame"])]


def _times(work: Callable[[int], object], frames: int) -> list[float]:
    out = []
    for frame in range(frames):
        begin = time.perf_counter()
        work(frame)
        out.append((time.perf_counter() - begin) * 1e3)
    return out


def _row(what: str, times: list[float], aim: str = "") -> Row:
    return Row(what=what, median_ms=round(median(times), 1), least_ms=round(min(times), 1), aim=aim)
