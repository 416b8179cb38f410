"""The state of a bulk run: bulk.json with its settings, and a manifest per shard, a line of JSON per scan.

A repeated run has the settings of the earlier one, and makes no existing output again.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from lidar2pano import __version__
from lidar2pano.bounded_files import read_bytes, sha256_of
from lidar2pano.bulk.data_set import copy_sequences
from lidar2pano.bulk.entries import RUN_FILE, SEMANTIC_KITTI, Entry, Job, ScanKey, Shard
from lidar2pano.bulk.scan_reading import ScanReading
from lidar2pano.bulk.stores import Folder, Store, open_store, put_bytes
from lidar2pano.errors import InputError
from lidar2pano.formats.json_files import json_lines, read_json
from lidar2pano.labels import COMMON15

FLUSH_S = 30.0  # between uploads of a manifest to a store whose files cannot grow
FOLDER = "manifest"
MOST_BYTES = 1 << 30  # of a manifest: a million scans have some 500 MB


class Manifest:
    """The lines of one shard, in manifest/<i>-of-<n>.jsonl of the output's store.

    The outputs are the state and the manifest only reports on them: `reconcile` writes a lost line again and removes
    one whose outputs are gone.
    """

    def __init__(self, store: Store, shard: Shard) -> None:
        self.shard = shard
        self.name = f"{FOLDER}/{shard.index}-of-{shard.count}.jsonl"
        self._store = store
        self._lines: list[bytes] = []  # only for a store whose files cannot grow
        self._flushed = time.monotonic()

    def reconcile(self, done: Collection[ScanKey], describe: Callable[[ScanKey], dict[str, Any]]) -> None:
        """Make the lines fit the outputs: one for each scan in `done`, none with an error.

        done      scans of the shard whose outputs are all there;  describe: scan -> its line, if it was lost.
        Scans with a line in a manifest of another division into shards get no second one.
        """
        content = self._read(self.name)
        complete = {_key(record): record for record in _parsed(content) if _made(record)}
        kept = {name: record for name, record in complete.items() if name in done or self._complete(record)}
        elsewhere = {
            _key(record)
            for name in self._store.names(FOLDER)
            if name != self.name
            for record in _parsed(self._read(name))
            if _made(record)
        }
        for name in done:
            if name not in kept and name not in elsewhere:
                kept[name] = describe(name)
        lines = [_line(record) for record in kept.values()]
        if b"".join(lines) != content or not self._store.exists(self.name):
            put_bytes(self._store, self.name, b"".join(lines))
        self._lines = [] if isinstance(self._store, Folder) else lines

    def add(self, record: dict[str, Any]) -> None:
        """Append a line."""
        if isinstance(self._store, Folder):
            self._store.append(self.name, _line(record))
            return
        self._lines.append(_line(record))
        if time.monotonic() - self._flushed > FLUSH_S:
            self.flush()

    def flush(self) -> None:
        """Upload the lines to a store whose files cannot grow."""
        if self._lines:
            put_bytes(self._store, self.name, b"".join(self._lines))
        self._flushed = time.monotonic()

    def _complete(self, record: dict[str, Any]) -> bool:
        return all(self._store.exists(name) for name in record["outputs"])

    def _read(self, name: str) -> bytes:
        if not self._store.exists(name):
            return b""
        with self._store.local(name) as path:
            return read_bytes(path, MOST_BYTES)


def line(key: ScanKey, sha256: str, weights: str, **values: Any) -> dict[str, Any]:  # noqa: ANN401
    """Return a line with all fields; None for fields missing in `values`."""
    fields: dict[str, Any] = dict.fromkeys(("outputs", "error", "points", "dropped", "milliseconds", "doubts"))
    return {"input": key.input, "scan": key.scan, "sha256": sha256, **(fields | values), "weights": weights}


def _key(record: dict[str, Any]) -> ScanKey:
    return ScanKey(record["input"], record.get("scan"))


def _line(record: dict[str, Any]) -> bytes:
    return json.dumps(record, separators=(",", ":")).encode() + b"\n"


def _parsed(data: bytes) -> Iterator[dict[str, Any]]:
    """Yield the records of whole lines; a torn one is passed over."""
    records = (record for record in json_lines(data) if isinstance(record.get("input"), str))
    return (record for record in records if isinstance(record.get("scan"), int | None))


def _made(record: dict[str, Any]) -> bool:
    """Return whether the line is of a scan with outputs."""
    outputs = record.get("outputs") if record.get("error") is None else None
    return isinstance(outputs, list) and bool(outputs) and all(isinstance(name, str) for name in outputs)


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
    overrides = job.reading.overrides
    settings = {
        "lidar2pano": __version__,
        "weights": job.weights,
        "sha256": {role: sha256_of(file) for role, file in sorted(files.items())},
        **options,
        "save": list(job.save),
        "as": job.layout,
        "labels": job.use_labels,
        "projection": None if job.projection == "cylinder" else job.projection,
        "topic": job.reading.selection.topic or None,
        "forward": overrides.forward or None,
        "remission": overrides.remission or None,
        "sensor_height_m": overrides.sensor_height_m,
        "classes": {
            str(index): {"name": name, "colour": list(colour)}
            for index, (name, colour) in enumerate(zip(COMMON15.classes, COMMON15.colours, strict=True))
        },
    }
    if out.exists(RUN_FILE):
        _compare(out, settings)
    else:
        _refuse_others(job, out, listed)
        put_bytes(out, RUN_FILE, f"{json.dumps(settings, indent=1)}\n".encode())
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
