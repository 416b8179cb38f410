"""Production: a whole simulated data set over several processes, which goes on where it was stopped."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

from lidar2pano.errors import InputError
from lidar2pano.formats.output_files import write_whole
from lidar2pano.simulate.record import Recording
from lidar2pano.simulate.settings import Settings, claim

SLICE = 5  # frames that a process takes at once, at most


class Slice(NamedTuple):
    """Frames [first, last) of a sequence."""

    out: Path
    settings: Settings
    sequence: int
    first: int
    last: int


def produce(out: Path, settings: Settings, sequences: int, processes: int) -> Iterator[int]:
    """Write `sequences` sequences into `out`; yields the number of frames done, as they are done.

    Frames whose files are all there are kept. Raises InputError where `out` holds another world or cannot be written.
    """
    if sequences < 1 or processes < 1:
        raise InputError("--sequences and --processes must be at least 1")
    claim(out, settings)
    _splits(out, sequences, settings.frames)
    slices = [
        Slice(out, settings, sequence, first, min(first + SLICE, settings.frames))
        for sequence in range(sequences)
        for first in range(0, settings.frames, SLICE)
    ]
    # Neighbouring slices share their piece of the world: a process takes them one after the other.
    if processes == 1:
        yield from map(record, slices)
        return
    yield from _shared(slices, processes)


def _shared(slices: list[Slice], processes: int) -> Iterator[int]:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # processes share the cores, so each takes one
    context = get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        queues = _dealt(slices, processes)
        running = {pool.submit(record, queue.pop(0)): queue for queue in queues if queue}
        try:
            while running:
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    queue = running.pop(future)
                    if queue:
                        running[pool.submit(record, queue.pop(0))] = queue
                    yield future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _dealt(slices: list[Slice], processes: int) -> list[list[Slice]]:
    """As many runs of neighbouring slices as there are processes, of equal length."""
    size = -(-len(slices) // processes)
    return [slices[first : first + size] for first in range(0, len(slices), size)]


def record(part: Slice) -> int:
    """Write the frames of a slice that are not there yet; the number of frames."""
    recording = _recording(part.out, part.settings, part.sequence)
    recording.prepare()
    for frame in range(part.first, part.last):
        if not recording.done(frame):
            recording.write(frame)
    return part.last - part.first


@lru_cache(maxsize=1)
def _recording(out: Path, settings: Settings, sequence: int) -> Recording:
    return Recording(out / "sequences" / f"{sequence:02d}", settings, sequence)


def _splits(out: Path, sequences: int, frames: int) -> None:
    """splits.json: the last tenth of the sequences (one at least, where there are several) is `val`."""
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
