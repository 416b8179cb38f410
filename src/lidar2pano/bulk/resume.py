"""Repeated bulk runs: settings must be those of the earlier run, and existing outputs are not made again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from lidar2pano import __version__
from lidar2pano.bounded_files import sha256_of
from lidar2pano.bulk.data_set import copy_sequences
from lidar2pano.bulk.entries import RUN_FILE, SEMANTIC_KITTI, Entry, Job, ScanKey
from lidar2pano.bulk.manifest import Manifest, line
from lidar2pano.bulk.scan_reading import ScanReading
from lidar2pano.bulk.stores import Folder, Store, open_store
from lidar2pano.errors import InputError
from lidar2pano.formats.json_files import read_json
from lidar2pano.labels import COMMON15


def start(job: Job, listed: list[Entry], files: Mapping[str, Path], options: Mapping[str, str]) -> None:
    """Write bulk.json beside the panoramas, or check that an existing one has the same settings.

    files  the weight files by role;  options: further settings of the outputs.
    In a data set's layout, calibrations, poses and splits are copied too. Raises InputError if OUT holds panoramas
    of other settings, or files of another origin.
    """
    source, out = open_store(job.source), open_store(job.out)
    in_place = isinstance(source, Folder) and isinstance(out, Folder) and source.root.resolve() == out.root.resolve()
    if in_place and job.layout != SEMANTIC_KITTI:
        raise InputError(f"{job.out}: is the folder of the scans; choose another --out")
    settings = {
        "lidar2pano": __version__,
        "weights": job.weights,
        "sha256": {role: sha256_of(file) for role, file in sorted(files.items())},
        **options,
        "save": list(job.save),
        "as": job.layout,
        "labels": job.use_labels,
        "topic": job.selection.topic or None,
        "forward": job.overrides.forward or None,
        "remission": job.overrides.remission or None,
        "sensor_height_m": job.overrides.sensor_height_m,
        "classes": {
            str(index): {"name": name, "colour": list(colour)}
            for index, (name, colour) in enumerate(zip(COMMON15.classes, COMMON15.colours, strict=True))
        },
    }
    if out.exists(RUN_FILE):
        _compare(out, settings)
    else:
        _refuse_others(job, out, listed)
        with out.scratch() as scratch:
            (scratch / RUN_FILE).write_text(json.dumps(settings, indent=1) + "\n", encoding="utf-8")
            out.put(scratch / RUN_FILE, RUN_FILE)
    if job.layout == SEMANTIC_KITTI and not in_place:
        copy_sequences(source, out, listed)


def _compare(out: Store, settings: dict[str, Any]) -> None:
    with out.local(RUN_FILE) as path:
        settings_there = read_json(path)
    for name, value in settings.items():
        if not isinstance(settings_there, dict) or settings_there.get(name) != value:
            raise InputError(
                f"{out.place}/{RUN_FILE}: these panoramas were made with another {name!r}; choose another --out, or"
                " repeat the command with the same options"
            )


def _refuse_others(job: Job, out: Store, listed: list[Entry]) -> None:
    """Refuse files of another origin, which must not be taken for panoramas of this run."""
    for entry in listed:
        for name in () if entry.error else job.outputs(entry).values():
            if out.exists(name):
                raise InputError(f"{out.place}/{name}: is there already, but no {RUN_FILE}; choose another --out")


def remaining(job: Job, listed: list[Entry], manifest: Manifest) -> list[Entry]:
    """Return the scans that lack an output, in order; the manifest's lines then fit all others."""
    out = open_store(job.out)
    done: dict[ScanKey, Entry] = {}
    todo: list[Entry] = []
    for entry in listed:
        if not entry.error and all(out.exists(name) for name in job.outputs(entry).values()):
            done[entry.key] = entry
        else:
            todo.append(entry)
    with closing(ScanReading(open_store(job.source), job.reading)) as reading:

        def describe(key: ScanKey) -> dict[str, Any]:
            try:
                sha256 = reading.request(done[key]).sha256()
            except InputError:  # damaged after its outputs were written
                sha256 = ""
            return line(key, sha256, job.weights, outputs=list(job.outputs(done[key]).values()))

        manifest.reconcile(done, describe)
    return todo
