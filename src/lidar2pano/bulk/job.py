"""The work on each scan of a bulk run: read, paint, write, each a step of its own so that they can overlap."""

from __future__ import annotations

import hashlib
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import takewhile
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from lidar2pano.bulk.data_set import instance_raster
from lidar2pano.bulk.entries import SEMANTIC_KITTI, Entry, Job
from lidar2pano.bulk.manifest import line
from lidar2pano.bulk.scan_reading import Request, ScanReading, source_of
from lidar2pano.bulk.stores import local_copy, open_store
from lidar2pano.calibration import Calibration, has_camera, read_calib
from lidar2pano.drives.reading import Reading
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import write_ids, write_whole
from lidar2pano.formats.scan_files import raw_labels, read_label, write_bin
from lidar2pano.labels import unpack_label
from lidar2pano.panorama import OUTPUTS
from lidar2pano.translation import Translation, Translator

A = TypeVar("A")
B = TypeVar("B")
MOST_THREADS = 8  # for writing: coding a panorama's PNG takes a core about a seventh of a second


@dataclass(kw_only=True)
class Work:
    """One scan on its way through the steps.

    sha256     of the scan's file, or of its message in a recording.
    instance   (N,) uint16 ids of SemanticKITTI's points, None without labels or their use.
    instances  (h, w) uint16: the same on the panorama.
    """

    entry: Entry
    translation: Translation
    sha256: str = ""
    instance: np.ndarray | None = None
    instances: np.ndarray | None = None

    def record(self, job: Job) -> dict[str, Any]:
        """Return the manifest's line."""
        error = self.translation.error
        text = str(error) if isinstance(error, InputError) else f"{self.entry.key}: {_unexpected(error)}"
        return line(
            self.entry.key,
            self.sha256,
            job.weights,
            outputs=[] if error else list(job.outputs(self.entry).values()),
            error=" ".join(text.split()) if error else None,
            doubts=self.translation.doubts,
            **self.translation.counts(),
        )


def _unexpected(error: Exception | None) -> str:
    """Return what ended a scan's work: the system's reason, or the name of a fault."""
    if isinstance(error, OSError) and error.strerror:
        return f"cannot be read or written ({error.strerror}); mend it and repeat the command"
    return f"{type(error).__name__}: {error}"


class Worker:
    """Does the steps with a pipeline. `load` and `write` may run in threads beside `paint`.

    folder  for unfinished files: a scratch folder of the job's `out`.
    """

    def __init__(self, job: Job, folder: Path) -> None:
        self.job, self._folder = job, folder
        self.source, self.out = open_store(job.source), open_store(job.out)
        self._reading = ScanReading(self.source, job.reading)
        self.translator = Translator(job.pipeline, every_fault=True)  # a bug or a lack of memory costs one scan alone
        self._calibration = lru_cache(maxsize=8)(self._read_calibration)

    def request(self, entry: Entry) -> Request:
        """Return the request for a scan; to be called for one entry after the other, in order."""
        return self._reading.request(entry)

    def load(self, request: Request) -> Work:
        """Read a scan, its labels and its sequence's camera, as far as they are used."""
        entry, checksums = request.entry, [""]
        instance = None
        try:
            reading = request.read(checksums.append)
            if reading.scan is not None and not reading.error:
                reading, instance = self._labelled(reading, entry)
        except Exception as error:
            reading = Reading(source=source_of(entry, self.source), error=error)
        return Work(
            entry=entry,
            translation=Translation(reading=reading, error=reading.error),
            sha256=checksums[-1],
            instance=instance,
        )

    def _labelled(self, reading: Reading, entry: Entry) -> tuple[Reading, np.ndarray | None]:
        """Return a reading with labels and calibration, and the instances of its points."""
        scan, instance = reading.scan, None
        assert scan is not None
        if entry.label is not None:
            with local_copy(self.source, entry.label) as path:
                scan = replace(scan, label=read_label(path, len(scan)))
                if self.job.layout == SEMANTIC_KITTI:
                    instance = unpack_label(raw_labels(path, len(scan)))[1].astype(np.uint16)
        elif self.job.use_labels:
            raise InputError(
                f"{reading.source.title}: has no labels (.label beside it, or in labels/); leave --labels out"
            )
        labels = scan.label if self.job.use_labels else None
        calibration = self._calibration(entry.calibration) if entry.calibration else None
        return replace(reading, scan=scan, labels=labels, calibration=calibration), instance

    def _read_calibration(self, name: str) -> Calibration | None:
        """Read the camera of a sequence, None if its file names none."""
        with self.source.local(name) as path:
            return read_calib(path) if has_camera(path) else None

    def paint(self, work: Work) -> Work:
        """Make the panorama; each scan by itself, so that the order of scans does not matter."""
        work.translation = self.translator(work.translation.reading)
        scan, panorama = work.translation.reading.scan, work.translation.panorama
        if work.instance is not None and scan and panorama:
            try:
                with work.translation.timer("instances"):
                    work.instances = instance_raster(scan, work.instance, panorama)
            except Exception as error:
                work.translation.error = error
        return work

    def write(self, work: Work) -> Work:
        """Write the outputs. Raises InputError if OUT cannot be written: then no other scan's can be either."""
        panorama, scan = work.translation.panorama, work.translation.reading.scan
        if work.translation.error is None and panorama and scan:
            names, save = self.job.outputs(work.entry), self.job.save
            with work.translation.timer("save"):
                stem = hashlib.sha256(os.fsencode(str(work.entry.key))).hexdigest()
                files = panorama.save(self._folder, save, None, stem, self.job.image_format, self.job.projection)
                parts = [part for output in OUTPUTS for part in names if part.partition(".")[0] == output]
                file_by_output = dict(zip(parts, files, strict=True))
                if (raster := work.instances) is not None:
                    file = self._folder / f"{stem}.instances.png"
                    file_by_output["instances"] = write_whole(file, lambda path: write_ids(path, raster))
                if "scan" in names:
                    file = self._folder / f"{stem}.bin"
                    file_by_output["scan"] = write_whole(file, lambda path: write_bin(path, scan))
                for output, name in names.items():
                    self.out.put(file_by_output[output], name)
        return work

    def close(self) -> None:
        """Close recordings."""
        self._reading.close()


def translate_all(job: Job, todo: Iterable[Entry], stopped: Callable[[], bool]) -> Iterator[dict[str, Any]]:
    """Translate scans and yield the manifest's lines in their order, each when its outputs are written.

    stopped  asked before each scan: when true, no further one is begun.
    Raises InputError when the outputs cannot be written or the pipeline cannot be made.
    """
    threads = min(MOST_THREADS, os.cpu_count() or 1)
    going = takewhile(lambda _: not stopped(), todo)
    with (
        open_store(job.out).scratch() as folder,
        closing(Worker(job, folder)) as worker,
        ThreadPoolExecutor(threads) as pool,
    ):
        painted = (worker.paint(work) for work in _map_ahead(pool, worker.load, map(worker.request, going), threads))
        for work in _map_ahead(pool, worker.write, painted, threads):
            yield work.record(job)


def _map_ahead(pool: ThreadPoolExecutor, function: Callable[[A], B], items: Iterable[A], most: int) -> Iterator[B]:
    """Map in threads, in order, with at most so many items begun beyond the yielded one."""
    begun: deque[Future[B]] = deque()
    try:
        for item in items:
            begun.append(pool.submit(function, item))
            while begun and (len(begun) > most or begun[0].done()):
                yield begun.popleft().result()
        while begun:
            yield begun.popleft().result()
    finally:
        for future in begun:
            future.cancel()
