"""Any number of scans through one pipeline, on one machine or many; existing files tell the progress."""

from __future__ import annotations

from lidar2pano.bulk.entries import Entry, Job, ScanKey, Shard
from lidar2pano.bulk.job import translate_all
from lidar2pano.bulk.listing import entries
from lidar2pano.bulk.manifest import Manifest, start

__all__ = ["Entry", "Job", "Manifest", "ScanKey", "Shard", "entries", "start", "translate_all"]
