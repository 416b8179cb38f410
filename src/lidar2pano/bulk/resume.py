"""What of a bulk run is done already: the outputs that are there say so, and the manifest is put right."""

from __future__ import annotations

from contextlib import closing
from typing import Any

from lidar2pano.bulk.entries import Entry, ScanKey
from lidar2pano.bulk.job import Job
from lidar2pano.bulk.manifest import Manifest, line
from lidar2pano.bulk.scan_reading import ScanReading
from lidar2pano.bulk.stores import open_store
from lidar2pano.errors import InputError


def remaining(job: Job, found: list[Entry], manifest: Manifest) -> list[Entry]:
    """The scans that lack an output, in order; the manifest's lines then fit those that lack none."""
    out = open_store(job.out)
    done: dict[ScanKey, Entry] = {}
    todo: list[Entry] = []
    for entry in found:
        if not entry.error and all(out.exists(name) for name in job.outputs(entry).values()):
            done[entry.key] = entry
        else:
            todo.append(entry)
    with closing(ScanReading(open_store(job.source), job.selection)) as reading:

        def describe(key: ScanKey) -> dict[str, Any]:
            try:
                sha256 = reading.request(done[key]).sha256()
            except InputError:  # it was damaged after its outputs were written
                sha256 = ""
            return line(key, sha256, job.weights, outputs=list(job.outputs(done[key]).values()))

        manifest.reconcile(done, describe)
    return todo
