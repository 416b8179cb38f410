"""A scan of a bulk run: what it is known by, what its outputs are called; and which scans a shard takes."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from lidar2pano.errors import InputError

MIRRORED, SEMANTIC_KITTI = "", "semantickitti"  # layouts
LAYOUTS = (MIRRORED, SEMANTIC_KITTI)
RUN_FILE = "bulk.json"  # in the folder of every run's outputs
# What is added to a scan's stem, by what an output holds; and an output's name in the folder of its sequence.
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
    """What a scan is known by.

    input  name of its file or recording below ROOT;  scan: its number in the recording, None where it has a file.
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
    stem         of its outputs: the same folder and the stem of the file or recording, which is longer where two share
                 one; a recording's scans have their numbers behind it.
    label        name of its SemanticKITTI labels, None where it has none or they are not used.
    calibration  name of its sequence's calib.txt, likewise.
    error        what is wrong with a recording that cannot be read, or with a folder; the entry then stands for it.
    """

    key: ScanKey
    stem: str
    label: str | None = None
    calibration: str | None = None
    error: str = ""

    @property
    def sequence(self) -> str:
        """Its sequence's name: that of its folders, and its recording, without those which every sequence has."""
        parts = self.stem.split("/")
        parts = parts[:-1] if self.key.scan is None else parts
        return "-".join(part for part in parts if part not in ("sequences", "velodyne")) or "00"

    def outputs(self, save: Sequence[str], layout: str = MIRRORED, colour: str = ".png") -> dict[str, str]:
        """Names of its outputs below OUT, by what they hold; `colour` is the ending of colour images."""
        number = "" if self.key.scan is None else f"{self.key.scan:06d}"
        if layout == MIRRORED:
            stem = f"{self.stem}-{number}" if number else self.stem
            return {part: stem + (colour if part == "rgb" else SUFFIXES[part]) for part in save}
        frame = number or self.stem.rpartition("/")[2]
        parts = (*save, *(["instances"] if self.label else []), *(["scan"] if number else []))
        return {part: f"sequences/{self.sequence}/{IN_SEQUENCE[part].format(frame)}" for part in parts}


@dataclass(frozen=True, slots=True)
class Shard:
    """Shard number `index`, from 0, of `count`."""

    index: int = 0
    count: int = 1

    @classmethod
    def parsed(cls, text: str) -> Shard:
        """The shard of --shard's "i/n"; InputError for another text."""
        found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text.strip())
        if not found or int(found[1]) >= int(found[2]):
            raise InputError(f"--shard {text}: is not of the form i/n with i from 0 to n - 1, e.g. 0/8")
        return cls(int(found[1]), int(found[2]))

    def takes(self, name: str) -> bool:
        """Whether the scan of this name is the shard's: by the hash of the name alone, whatever else there is."""
        return _hash(name) % self.count == self.index

    def takes_end(self, name: str) -> bool:
        """Whether the shard takes the last scans of the recording of this name, as exactly one shard does."""
        return (self.index - _hash(name)) % self.count == self.count - 1

    def part(self, name: str, numbers: Sequence[int]) -> Sequence[int]:
        """The shard's scans of the recording of this name: consecutive ones, as many as other shards', or one more."""
        place = (self.index - _hash(name)) % self.count
        return numbers[len(numbers) * place // self.count : len(numbers) * (place + 1) // self.count]


def _hash(name: str) -> int:
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big")
