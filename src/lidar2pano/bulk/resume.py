"""What of a bulk run is done already: the outputs that are there say so, and the manifest is put right."""

from __future__ import annotations

from typing import Any

from lidar2pano.bulk.entries import Entry
from lidar2pano.bulk.job import Job, file_hash
from lidar2pano.bulk.manifest import Manifest, line
from lidar2pano.bulk.stores import open_store


def remaining(job: Job, found: list[Entry], manifest: Manifest) -> list[Entry]:
    """The scans that lack an output, in order; the manifest's lines then fit those that lack none."""
    source, out = open_store(job.source), open_store(job.out)
    done: dict[str, Entry] = {}
    todo: list[Entry] = []
    for entry in found:
        if all(out.exists(name) for name in job.outputs(entry).values()):
            done[entry.input] = entry
        else:
            todo.append(entry)

    def describe(name: str) -> dict[str, Any]:
        with source.local(name) as path:
            sha256 = file_hash(path)
        return line(name, sha256, job.weights, outputs=list(job.outputs(done[name]).values()))

    manifest.reconcile(done, describe)
    return todo
