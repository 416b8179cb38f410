"""The scans of a bulk run: which there are, which of them a shard takes, and what their outputs are called."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import PurePosixPath

from lidar2pano.bulk.stores import Store
from lidar2pano.errors import InputError
from lidar2pano.formats.readers import ENDINGS, PACKED

MIRRORED, SEMANTIC_KITTI = "", "semantickitti"  # layouts
LAYOUTS = (MIRRORED, SEMANTIC_KITTI)
# What is added to a scan's stem, by what an output holds; and an output's name in the folder of its sequence.
SUFFIXES = {"rgb": ".png", "segments": ".segments.png", "labels": ".label", "depth": ".depth.png"}
IN_SEQUENCE = {
    "rgb": "pano/{}.png",
    "segments": "pano_labels/{}.png",
    "labels": "predicted_labels/{}.label",
    "depth": "pano_depth/{}.png",
    "instances": "pano_instances/{}.png",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One scan of a bulk run.

    input        its name below ROOT.
    stem         of its outputs: the same folder and the stem of the file, which is longer where two share one.
    label        name of its SemanticKITTI labels, None where it has none or they are not used.
    calibration  name of its sequence's calib.txt, likewise.
    """

    input: str
    stem: str
    label: str | None = None
    calibration: str | None = None

    @property
    def sequence(self) -> str:
        """Its sequence's name: that of its folders, without those which every sequence has."""
        parts = self.stem.split("/")[:-1]
        return "-".join(part for part in parts if part not in ("sequences", "velodyne")) or "00"

    def outputs(self, save: Sequence[str], layout: str = MIRRORED, colour: str = ".png") -> dict[str, str]:
        """Names of its outputs below OUT, by what they hold; `colour` is the ending of colour images."""
        if layout == MIRRORED:
            return {part: self.stem + (colour if part == "rgb" else SUFFIXES[part]) for part in save}
        frame = self.stem.rpartition("/")[2]
        parts = (*save, "instances") if self.label else save
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
        return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") % self.count == self.index


def entries(store: Store, shard: Shard, layout: str = MIRRORED, *, labels: bool = False) -> list[Entry]:
    """A shard's scans in the order of their folders and names.

    labels  whether the scans' own labels are needed; in a data set's layout they and the calibration are looked for.
    Raises InputError when there is no scan at all, or two would have the same outputs.
    """
    found: list[Entry] = []
    total, folder_of = 0, dict[str, str]()
    names = (name for name in store.names() if _is_scan(name))
    for folder, group in groupby(sorted(names, key=_folder_first), key=_folder):
        for name, stem in _stems(list(group)):
            total += 1
            entry = Entry(input=name, stem=stem)
            if layout == SEMANTIC_KITTI and folder_of.setdefault(entry.sequence, folder) != folder:
                raise InputError(
                    f"{store.place}: {folder_of[entry.sequence]!r} and {folder!r} would both be sequence"
                    f" {entry.sequence}; rename one"
                )
            if shard.takes(name):
                wanted = labels or layout == SEMANTIC_KITTI
                found.append(_completed(entry, store, layout) if wanted else entry)
    if not total:
        raise InputError(f"{store.place}: holds no scan (known endings: {', '.join(ENDINGS)}); name another folder")
    return found


def _completed(entry: Entry, store: Store, layout: str) -> Entry:
    path = _unpacked(entry.input)
    in_sequence = path.parent.name == "velodyne"
    label = path.parent.parent / "labels" / f"{path.stem}.label" if in_sequence else path.with_suffix(".label")
    calib = path.parent.parent / "calib.txt" if in_sequence else path.parent / "calib.txt"
    return Entry(
        input=entry.input,
        stem=entry.stem,
        label=str(label) if store.exists(str(label)) else None,
        calibration=str(calib) if layout == SEMANTIC_KITTI and store.exists(str(calib)) else None,
    )


def _folder(name: str) -> str:
    return name.rpartition("/")[0]


def _folder_first(name: str) -> tuple[str, str]:
    folder, _, file = name.rpartition("/")
    return folder, file


def _unpacked(name: str) -> PurePosixPath:
    """The name without the ending of its packing."""
    path = PurePosixPath(name)
    return path.with_suffix("") if path.suffix.lower() in PACKED else path


def _is_scan(name: str) -> bool:
    file = name.rpartition("/")[2]
    return not file.startswith(".") and _unpacked(file).suffix.lower() in ENDINGS


def _stems(names: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Each name of a folder with its stem; names whose outputs would clash keep their endings."""
    stems = {name: str(_unpacked(name).with_suffix("")) for name in names}
    count = Counter(stem + suffix for stem in stems.values() for suffix in SUFFIXES.values())
    for name, stem in stems.items():
        if any(count[stem + suffix] > 1 for suffix in SUFFIXES.values()):
            stems[name] = name
    if len(set(stems.values())) < len(stems):
        raise InputError(f"{_folder(name)}: two scans would have the outputs of {name!r}; rename one")
    yield from stems.items()
