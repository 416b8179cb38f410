"""Timings of the street world: building a scene, a scan, a whole frame, many frames in parallel."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

from lidar2pano.bench.timings import Row
from lidar2pano.simulate.dataset.generation import SequenceWriter, generate
from lidar2pano.simulate.dataset.settings import WorldSettings

SEED, PLACE = 5, "residential"
AIMS = {"scan": "< 150", "frame": "< 4000 on two cores"}


def measure_world(runs: int, processes: int) -> list[Row]:
    """Time one street: its scene, `runs` scans and whole frames in this process, and frames by `processes`.

    A frame is an HDL-64E scan with labels, the 1242 x 375 camera image and the 384 x 4608 panorama with labels and
    depth, written to files. Raises InputError without embreex.
    """
    settings = WorldSettings(seed=SEED, frames=max(runs + 1, 10 * processes), place=PLACE)
    with tempfile.TemporaryDirectory() as folder:
        writer = SequenceWriter(Path(folder) / "one", settings, 0)
        build = _times(writer.scene, 1)
        scans = _times(writer.scan, runs + 1)[1:]
        whole = _times(writer.write, runs + 1)[1:]  # the first one makes the textures
        rows = [
            _row("world: build a piece of a town", build),
            _row("world: scan with labels", scans, AIMS["scan"]),
            _row("world: whole frame, one process", whole),
        ]
        begin = time.perf_counter()
        frames = sum(generate(Path(folder) / "many", settings, 1, processes))
        frame_ms = (time.perf_counter() - begin) * 1e3 / frames
        what = f"world: whole frame, {processes} processes, {frames} frames, start and build included"
        return [*rows, _row(what, [frame_ms], AIMS["frame"])]


def _times(work: Callable[[int], object], frames: int) -> list[float]:
    out = []
    for frame in range(frames):
        begin = time.perf_counter()
        work(frame)
        out.append((time.perf_counter() - begin) * 1e3)
    return out


def _row(what: str, times: list[float], aim: str = "") -> Row:
    return Row(what=what, median_ms=round(median(times), 1), least_ms=round(min(times), 1), aim=aim)
