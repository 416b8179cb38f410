"""The manifest of a shard: a line of JSON per scan, with its outputs or its fault."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Iterator
from typing import Any

from lidar2pano.bounded_files import read_bytes
from lidar2pano.bulk.entries import ScanKey, Shard
from lidar2pano.bulk.stores import Store
from lidar2pano.formats.json_files import json_lines

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
            self._write(b"".join(lines))
        self._lines = [] if self._store.appends else lines

    def add(self, record: dict[str, Any]) -> None:
        """Append a line."""
        if self._store.appends:
            self._store.append(self.name, _line(record))
            return
        self._lines.append(_line(record))
        if time.monotonic() - self._flushed > FLUSH_S:
            self.flush()

    def flush(self) -> None:
        """Upload the lines to a store whose files cannot grow."""
        if self._lines and not self._store.appends:
            self._write(b"".join(self._lines))
        self._flushed = time.monotonic()

    def _complete(self, record: dict[str, Any]) -> bool:
        return all(self._store.exists(name) for name in record["outputs"])

    def _read(self, name: str) -> bytes:
        if not self._store.exists(name):
            return b""
        with self._store.local(name) as path:
            return read_bytes(path, MOST_BYTES)

    def _write(self, data: bytes) -> None:
        with self._store.scratch() as scratch:
            (scratch / "manifest").write_bytes(data)
            self._store.put(scratch / "manifest", self.name)


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
    return record.get("error") is None and isinstance(record.get("outputs"), list) and bool(record["outputs"])
