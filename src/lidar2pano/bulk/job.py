"""What is done with each scan of a bulk run: read, paint, write, each a step of its own so that they can overlap."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from dataclasses import replace as changed
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano.bulk.entries import MIRRORED, SEMANTIC_KITTI, Entry
from lidar2pano.bulk.instances import instance_raster
from lidar2pano.bulk.manifest import line
from lidar2pano.bulk.scan_reading import Request, ScanReading
from lidar2pano.bulk.stores import Store, local_copy, open_store
from lidar2pano.calibration import has_camera, read_calib
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import COLOUR_FORMATS, write_ids, write_whole
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.formats.scan_files import read_label, write_bin
from lidar2pano.hardware import Timer
from lidar2pano.labels import unpack_label
from lidar2pano.memory import Memory
from lidar2pano.panorama import OUTPUTS, Panorama
from lidar2pano.pipeline import Pipeline
from lidar2pano.scan import Scan


@dataclass(frozen=True, kw_only=True)
class Job:
    """What is wanted of every scan. It can be pickled, to be sent to other processes.

    source, out  folder or URL of the scans, and of the panoramas.
    save         of OUTPUTS, in that order.
    layout       of LAYOUTS.
    use_labels   whether a scan's own labels take the place of the segmenter's.
    weights      name, for the manifest.
    pipeline     makes the pipeline, once per process.
    image_format  of colour images, one of COLOUR_FORMATS.
    selection    which scans of recordings and folders; here the topic counts.
    """

    source: str
    out: str
    save: tuple[str, ...]
    weights: str
    pipeline: Callable[[], Pipeline]
    layout: str = MIRRORED
    use_labels: bool = False
    image_format: str = "png"
    selection: ReadOptions = field(default_factory=ReadOptions)

    def outputs(self, entry: Entry) -> dict[str, str]:
        """Names of a scan's outputs below `out`, by what they hold."""
        return entry.outputs(self.save, self.layout, COLOUR_FORMATS[self.image_format][0])


@dataclass(kw_only=True)
class Work:
    """One scan on its way through the steps; each sets what the next one needs, or `error`.

    sha256     of the scan's file, or of its message in a recording.
    instance   (N,) uint16 ids of SemanticKITTI, None where they are not used.
    instances  (h, w) uint16: the same on the panorama.
    """

    entry: Entry
    timer: Timer
    sha256: str = ""
    scan: Scan | None = None
    instance: np.ndarray | None = None
    panorama: Panorama | None = None
    instances: np.ndarray | None = None
    error: str | None = None

    def note(self, sha256: str) -> None:
        """Set the checksum as soon as it is known."""
        self.sha256 = sha256

    @contextmanager
    def step(self, stage: str = "") -> Iterator[None]:
        """Turn what is raised into the scan's error: whatever is wrong with one scan, the others go on."""
        try:
            if stage:
                with self.timer(stage):
                    yield
            else:
                yield
        except InputError as error:
            self.error = str(error)
        except Exception as error:  # a bug or a lack of memory costs this scan alone
            self.error = f"{self.entry.key}: {type(error).__name__}: {error}"

    def record(self, job: Job) -> dict[str, Any]:
        """The manifest's line."""
        return line(
            self.entry.key,
            self.sha256,
            job.weights,
            outputs=[] if self.error else list(job.outputs(self.entry).values()),
            error=self.error and " ".join(self.error.split()),
            points=None if self.scan is None else len(self.scan),
            dropped=None if self.panorama is None else self.panorama.dropped,
            milliseconds={stage: round(value, 2) for stage, value in self.timer.milliseconds.items()},
        )


class Worker:
    """Does the steps with a pipeline. `load` and `write` may run in threads beside `paint`.

    folder  for unfinished files: a scratch folder of the job's `out`.
    """

    def __init__(self, job: Job, folder: Path) -> None:
        self.job, self._folder = job, folder
        self.source, self.out = open_store(job.source), open_store(job.out)
        self._reading = ScanReading(self.source, job.selection)

    @cached_property
    def pipeline(self) -> Pipeline:
        """Made when the first scan has been read."""
        return self.job.pipeline()

    def request(self, entry: Entry) -> Request:
        """A scan that is to be loaded; to be called for one after the other, in order."""
        return self._reading.request(entry)

    def load(self, request: Request) -> Work:
        """Read a scan, and its labels where they are used."""
        from torch import device

        entry = request.entry
        work = Work(entry=entry, timer=Timer(device("cpu")))
        with work.step("read"):
            place = f"{self.source.place}/{entry.key}"
            work.scan = changed(request.read(work.note), name=place)
            if entry.label is not None:
                with local_copy(self.source, entry.label) as path:
                    label = read_label(path, len(work.scan))
                    instance = unpack_label(np.fromfile(path, dtype="<u4"))[1].astype(np.uint16)
                work.scan = changed(work.scan, label=label)
                work.instance = instance if self.job.layout == SEMANTIC_KITTI else None
            elif self.job.use_labels:
                raise InputError(f"{place}: has no labels (.label beside it, or in labels/); leave --labels out")
        return work

    def paint(self, work: Work) -> Work:
        """Make the panorama; each scan by itself, so that the order of scans does not matter."""
        if work.error is None and work.scan is not None:
            work.timer.device = self.pipeline.device
            with work.step():
                pipeline, labels = self.pipeline, work.scan.label if self.job.use_labels else None
                if work.entry.calibration is not None:
                    pipeline = _at_sequence_camera(self, work.entry.calibration)
                _, work.panorama = pipeline.step(Memory(), work.scan, None, work.timer, labels)
                if work.instance is not None:
                    with work.timer("instances"):
                        work.instances = instance_raster(work.scan, work.instance, work.panorama)
        return work

    def write(self, work: Work) -> Work:
        """Write the outputs. Raises InputError where OUT cannot be written: then no other scan's can be either."""
        if work.error is None and work.panorama is not None:
            names = self.job.outputs(work.entry)
            with work.timer("save"):
                stem = hashlib.sha256(str(work.entry.key).encode()).hexdigest()
                files = work.panorama.save(self._folder, self.job.save, None, stem, self.job.image_format)
                of = dict(zip((part for part in OUTPUTS if part in self.job.save), files, strict=True))
                if (raster := work.instances) is not None:
                    file = self._folder / f"{stem}.instances.png"
                    of["instances"] = write_whole(file, lambda path: write_ids(path, raster))
                if "scan" in names and (scan := work.scan):
                    file = self._folder / f"{stem}.bin"
                    of["scan"] = write_whole(file, lambda path: write_bin(path, scan))
                for part, name in names.items():
                    self.out.put(of[part], name)
        return work

    def translate(self, entry: Entry) -> dict[str, Any]:
        """All steps; the manifest's line."""
        return self.write(self.paint(self.load(self.request(entry)))).record(self.job)

    def close(self) -> None:
        """Close recordings."""
        self._reading.close()


@lru_cache(maxsize=8)
def _at_sequence_camera(worker: Worker, calibration: str) -> Pipeline:
    """The pipeline with the viewpoint of a sequence's camera, where it has one."""
    with worker.source.local(calibration) as path:
        return worker.pipeline.at(read_calib(path)) if has_camera(path) else worker.pipeline


def copy_beside(source: Store, out: Store, name: str, target: str) -> None:
    """Copy a small file of a data set, unless it is there or there is none."""
    if source.exists(name) and not out.exists(target):
        with source.local(name) as path, out.scratch() as scratch:
            shutil.copyfile(path, scratch / "copy")
            out.put(scratch / "copy", target)
