"""Bulk runs with the stand-in pipeline, and what they leave."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from lidar2pano.bulk import Job, Manifest, Shard, entries, start, translate_all
from lidar2pano.bulk.stores import open_store
from lidar2pano.cli.bulk import Translate, work
from stand_in_pipeline import StandIn

SCANS = 24
WHOLE = Shard()


def job_of(root: Path | str, out: Path | str, **changes) -> Job:
    job = Job(source=str(root), out=str(out), save=("rgb", "depth"), weights="stand-in", pipeline=StandIn())
    return replace(job, **changes)


def run(job: Job, shard: Shard = WHOLE, translate: Translate = translate_all, only: str = "") -> int:
    """What the command does after it has understood its options."""
    store = open_store(job.source)
    found = entries(store, shard, job.layout, labels=job.use_labels, selection=job.reading.selection, only=only)
    start(job, found, {}, {})
    return work(job, found, Manifest(open_store(job.out), shard), translate)


def contents(out: Path) -> dict[str, bytes]:
    """Every file but the manifests, by its path."""
    files = (path for path in out.rglob("*") if path.is_file() and path.parent.name != "manifest")
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in files}


def manifest(out: Path) -> list[dict]:
    files = sorted((out / "manifest").iterdir())
    return [json.loads(line) for file in files for line in file.read_text().splitlines()]


def assert_each_once(out: Path, root: Path, recordings: Mapping[str, int] | None = None) -> None:
    """The manifest has one line for each scan file, and for each of so many scans of recordings."""
    scans = [(path.relative_to(root).as_posix(), -1) for path in root.rglob("*.bin")]
    scans += [(name, number) for name, count in (recordings or {}).items() for number in range(count)]
    lines = manifest(out)
    assert sorted((line["input"], -1 if line["scan"] is None else line["scan"]) for line in lines) == sorted(scans)
    assert all(line["error"] is None and (out / name).is_file() for line in lines for name in line["outputs"])


def begin(job: Job) -> int:
    """A process that does the run; its number. Its files are not flushed to the disk, which no kill notices."""
    process = os.fork()
    if process:
        return process
    os.fsync = lambda _: None
    code = 99
    try:
        code = run(job)
    finally:
        os._exit(code)
