"""A bulk run: its settings; the keys of its scans, the names of their outputs, their division into shards."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from lidar2pano.drives.reading import ReadingOptions
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import COLOUR_FORMATS
from lidar2pano.geometry.camera import CUBE_AXES
from lidar2pano.pipeline import Pipeline

MIRRORED, SEMANTIC_KITTI = "", "semantickitti"  # layouts
LAYOUTS = (MIRRORED, SEMANTIC_KITTI)
RUN_FILE = "bulk.json"  # in the folder of every run's outputs
# Suffix after a scan's stem, by output; and an output's name in the folder of its sequence.
SUFFIXES = {"rgb": ".png", "segments": ".segments.png", "labels": ".label", "depth": ".depth.png"}
IN_SEQUENCE = {
    "rgb": "pano/{}.png",
    "segments": "pano_labels/{}.png",
    "labels": "predicted_labels/{}.label",
    "depth": "pano_depth/{}.png",
    "instances": "pano_instances/{}.png",
    "scan": "velodyne/{}.bin",
}


class ScanKey(NamedTuple):
    """The key of a scan.

    input  name of its file or recording below ROOT;  scan: its number in the recording, None for a scan file.
    """

    input: str
    scan: int | None = None

    def __str__(self) -> str:
        """For messages."""
        return self.input if self.scan is None else f"{self.input}, scan {self.scan}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One scan of a bulk run.

    key          its name and number.
    stem         of its outputs: the same folder and the stem of the file or recording, a longer one if two share it;
                 a recording's scans have their numbers behind it.
    label        name of its SemanticKITTI labels, None without labels or their use.
    calibration  name of its sequence's calib.txt, likewise.
    error        fault of an unreadable recording or folder; the entry then stands for it.
    """

    key: ScanKey
    stem: str
    label: str | None = None
    calibration: str | None = None
    error: str = ""

    @property
    def sequence(self) -> str:
        """Name of its sequence: of its folders, and its recording, without folders common to every sequence."""
        parts = self.stem.split("/")
        parts = parts[:-1] if self.key.scan is None else parts
        return "-".join(part for part in parts if part not in ("sequences", "velodyne")) or "00"


@dataclass(frozen=True, kw_only=True)
class Job:
    """Settings of a bulk run, the same for every scan. They can be pickled, to be sent to other processes.

    source, out  folder or URL of the scans, and of the panoramas.
    save         of OUTPUTS, in that order.
    layout       of LAYOUTS.
    use_labels   whether a scan's own labels take the place of the segmenter's.
    weights      name, for the manifest.
    pipeline     makes the pipeline, once per process.
    image_format  of colour images, one of COLOUR_FORMATS;  projection: of all images, one of PROJECTIONS.
    reading      options of reading scans; of the selection in recordings, here the topic counts.
    """

    source: str
    out: str
    save: tuple[str, ...]
    weights: str
    pipeline: Callable[[], Pipeline]
    layout: str = MIRRORED
    use_labels: bool = False
    image_format: str = "png"
    projection: str = "cylinder"
    reading: ReadingOptions = field(default_factory=ReadingOptions)

    def outputs(self, entry: Entry) -> dict[str, str]:
        """Return the names of a scan's outputs below `out`, by output and face."""
        number = "" if entry.key.scan is None else f"{entry.key.scan:06d}"
        if self.layout == MIRRORED:
            stem = f"{entry.stem}-{number}" if number else entry.stem
            suffixes = SUFFIXES | {"rgb": COLOUR_FORMATS[self.image_format][0]}
            faces = [f".{face}" for face in CUBE_AXES] if self.projection == "cubemap" else [""]
            return {
                f"{part}{face}": stem + face + suffixes[part]
                for part in self.save
                for face in ([""] if part == "labels" else faces)
            }
        frame = number or entry.stem.rpartition("/")[2]
        parts = (*self.save, *(["instances"] if entry.label else []), *(["scan"] if number else []))
        return {part: f"sequences/{entry.sequence}/{IN_SEQUENCE[part].format(frame)}" for part in parts}


@dataclass(frozen=True, slots=True)
class Shard:
    """Shard number `index`, from 0, of `count`."""

    index: int = 0
    count: int = 1

    @classmethod
    def parsed(cls, text: str) -> Shard:
        """Return the shard of --shard's "i/n"; InputError for another text."""
        numbers = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text.strip())
        if not numbers or int(numbers[1]) >= int(numbers[2]):
            raise InputError(f"--shard {text}: is not of the form i/n with i from 0 to n - 1, e.g. 0/8")
        return cls(int(numbers[1]), int(numbers[2]))

    def takes(self, name: str) -> bool:
        """Return whether the scan of this name is the shard's: by the hash of the name, whatever other scans exist."""
        return _hash(name) % self.count == self.index

    def takes_end(self, name: str) -> bool:
        """Return whether the shard takes the last scans of the recording of this name, as exactly one shard does."""
        return (self.index - _hash(name)) % self.count == self.count - 1

    def part(self, name: str, numbers: Sequence[int]) -> Sequence[int]:
        """Return the shard's scans of a recording: consecutive ones, as many as other shards', or one more."""
        place = (self.index - _hash(name)) % self.count
        return numbers[len(numbers) * place // self.count : len(numbers) * (place + 1) // self.count]


def _hash(name: str) -> int:
    return int.from_bytes(hashlib.sha256(os.fsencode(name)).digest()[:8], "big")
