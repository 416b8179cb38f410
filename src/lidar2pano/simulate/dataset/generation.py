"""Generation of a simulated data set by several processes; an interrupted one is continued."""

from __future__ import annotations

import json
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from functools import lru_cache
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import NamedTuple

from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import write_whole
from lidar2pano.simulate.dataset.sequence_writer import SequenceWriter
from lidar2pano.simulate.dataset.settings import MOST_FRAMES, WorldSettings, claim_folder

MOST_PROCESSES = 1024
RANGE_LENGTH = 5  # frames of one task of a process, at most


class FrameRange(NamedTuple):
    """Frames [first, last) of a sequence."""

    out: Path
    settings: WorldSettings
    sequence: int
    first: int
    last: int


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
    _write_splits(out, sequences, settings.frames)
    ranges = [
        FrameRange(out, settings, sequence, first, min(first + RANGE_LENGTH, settings.frames))
        for sequence in range(sequences)
        for first in range(0, settings.frames, RANGE_LENGTH)
    ]
    if processes == 1:
        yield from map(write_frames, ranges)
        return
    yield from _in_parallel(ranges, processes)


def _in_parallel(ranges: list[FrameRange], processes: int) -> Iterator[int]:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # processes share the cores, so each takes one
    context = get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context, initializer=_end_with_parent) as pool:
        queues = _consecutive_runs(ranges, processes)
        running = {pool.submit(write_frames, queue.pop(0)): queue for queue in queues if queue}
        try:
            while running:
                finished, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in finished:
                    queue = running.pop(future)
                    if queue:
                        running[pool.submit(write_frames, queue.pop(0))] = queue
                    yield future.result()
        except BrokenProcessPool as error:
            raise InputError(
                "a process was killed, perhaps for lack of memory; repeat the command with fewer --processes"
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _end_with_parent() -> None:
    """End this worker when its parent process has ended, however that came about."""

    def watch() -> None:
        if parent := parent_process():
            parent.join()
            signal.raise_signal(signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


def _consecutive_runs(ranges: list[FrameRange], processes: int) -> list[list[FrameRange]]:
    """The ranges in as many runs of equal length as there are processes: neighbours share a static scene."""
    size = -(-len(ranges) // processes)
    return [ranges[first : first + size] for first in range(0, len(ranges), size)]


def write_frames(part: FrameRange) -> int:
    """Write the frames of a range that are missing; the number of frames."""
    writer = _writer(part.out, part.settings, part.sequence)
    writer.prepare()
    for frame in range(part.first, part.last):
        if not writer.is_complete(frame):
            writer.write(frame)
    return part.last - part.first


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
        name: [f"{sequence:02d}/{frame:06d}" for sequence in which for frame in range(frames)]
        for name, which in names.items()
    }
    text = json.dumps(splits, indent=1) + "\n"
    write_whole(out / "splits.json", lambda path: path.write_text(text, encoding="utf-8"))
