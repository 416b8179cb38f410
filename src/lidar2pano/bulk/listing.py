"""The scans below a folder or URL: scan files and those of recordings, in the order of their names."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import groupby
from pathlib import PurePosixPath
from typing import NamedTuple

from lidar2pano.bulk.entries import MIRRORED, RUN_FILE, SEMANTIC_KITTI, SUFFIXES, Entry, ScanKey, Shard
from lidar2pano.bulk.stores import Folder, Store, local_copy
from lidar2pano.drives.folders import select_files
from lidar2pano.errors import InputError
from lidar2pano.formats.readers import ENDINGS, PACKED, ReadOptions
from lidar2pano.recordings.playback import playback
from lidar2pano.recordings.recorded_scans import ENDINGS as RECORDINGS
from lidar2pano.recordings.recorded_scans import METADATA

ALL = ReadOptions()
STORAGE = (".db3", ".mcap", ".db3.zstd", ".mcap.zstd")  # endings of the files of a ROS 2 bag's folder
NUMBER = re.compile(r"-\d{6,}(?=(\.segments|\.depth)?\.(png|label)$)")  # in the name of an output of a recording


class Source(NamedTuple):
    """A scan file or a recording, by its name below ROOT."""

    name: str
    recording: bool

    @property
    def folder(self) -> str:
        """The folder that it is in."""
        return self.name.rpartition("/")[0]


def entries(
    store: Store,
    shard: Shard,
    layout: str = MIRRORED,
    *,
    labels: bool = False,
    selection: ReadOptions = ALL,
    only: str = "",
) -> list[Entry]:
    """A shard's scans in the order of their folders, names and numbers.

    labels     whether the scans' own labels are needed; in a data set's layout they and the calibration are looked for.
    selection  which scans of each recording and folder.
    only       name of the recording whose scans are meant; "": whatever is found.
    Raises InputError when there is no scan at all, or two would have the same outputs. A recording that cannot be read
    is an entry with an error.
    """
    found: list[Entry] = []
    total, place_of = 0, dict[str, str]()
    sources = [Source(only, True)] if only else sorted(_sources(store), key=lambda one: (one.folder, one.name))
    grouped = {folder: _stems(list(group)) for folder, group in groupby(sources, key=lambda one: one.folder)}
    if layout == SEMANTIC_KITTI and store.exists(RUN_FILE):
        grouped = _without_outputs(grouped)
    for folder, stems in grouped.items():
        total += len(stems)
        files, refused = _wanted(store, folder, [one.name for one in stems if not one.recording], shard, selection)
        found += refused
        for source, stem in stems.items():
            if layout == SEMANTIC_KITTI:
                _check_sequence(store, source, stem, place_of)
            if source.recording:
                found += _recorded(store, source.name, stem, shard, selection)
            elif source.name in files:
                entry = Entry(key=ScanKey(source.name), stem=stem)
                found.append(_completed(entry, store, layout) if labels or layout == SEMANTIC_KITTI else entry)
    if not total:
        known = ", ".join((*ENDINGS, *RECORDINGS))
        raise InputError(f"{store.place}: holds no scan (known endings: {known}); name another folder")
    return found


def is_bag_folder(store: Store) -> bool:
    """Whether the root of a store is a ROS 2 bag's folder itself."""
    return store.exists(METADATA) and any("/" not in name and name.endswith(STORAGE) for name in store.names())


def _sources(store: Store) -> Iterator[Source]:
    """The scan files and recordings of a store; the files of a ROS 2 bag's folder are no recordings of their own."""
    described, stored = set[str](), dict[str, list[str]]()
    for name in store.names():
        folder, _, file = name.rpartition("/")
        if file.startswith("."):
            continue
        if file == METADATA:
            described.add(folder)
        elif file.lower().endswith(STORAGE):
            stored.setdefault(folder, []).append(name)
        elif file.lower().endswith(RECORDINGS):
            yield Source(name, recording=True)
        elif _unpacked(file).suffix.lower() in ENDINGS:
            yield Source(name, recording=False)
    for folder, names in stored.items():
        if folder and folder in described:
            yield Source(folder, recording=True)
        else:
            yield from (Source(name, recording=True) for name in names if name.lower().endswith(RECORDINGS))


def _wanted(
    store: Store, folder: str, names: Sequence[str], shard: Shard, selection: ReadOptions
) -> tuple[set[str], list[Entry]]:
    """The shard's scan files of a folder, of those that are selected; an entry with an error where none can be."""
    timed = selection.start_s is not None or selection.end_s is not None
    chosen = list(names)
    if timed and names:
        try:
            if not isinstance(store, Folder):
                raise InputError(
                    f"{store.place}: --from and --to choose among scan files of this machine's folders only"
                )
            paths = {store.root / name: name for name in names}
            chosen = [paths[path] for path in select_files(list(paths), selection)]
        except InputError as error:
            place = f"{folder}/" if folder else "./"
            entry = Entry(key=ScanKey(place), stem=place, error=str(error))
            return set(), [entry] if shard.takes(place) else []
    else:
        chosen = chosen[:: selection.every]
    return {name for name in chosen if shard.takes(name)}, []


def _recorded(store: Store, name: str, stem: str, shard: Shard, selection: ReadOptions) -> list[Entry]:
    """The shard's scans of a recording: of a download all or none, since each shard has to download it first."""
    whole = not isinstance(store, Folder)
    if whole and not shard.takes(name):
        return []
    try:
        with local_copy(store, name) as path, closing(playback(path, selection.topic)) as opened:
            numbers = opened.numbers(selection)
    except InputError as error:
        return [Entry(key=ScanKey(name), stem=stem, error=str(error))] if shard.takes(name) else []
    return [Entry(key=ScanKey(name, n), stem=stem) for n in (numbers if whole else shard.part(name, numbers))]


def _without_outputs(grouped: dict[str, dict[Source, str]]) -> dict[str, dict[Source, str]]:
    """The groups without the scan files that a run with ROOT as its OUT wrote of ROOT's recordings."""
    recordings = [(one, stem) for stems in grouped.values() for one, stem in stems.items() if one.recording]
    written = {f"sequences/{_sequence(one, stem)}/velodyne" for one, stem in recordings}
    return {folder: stems for folder, stems in grouped.items() if folder not in written}


def _sequence(source: Source, stem: str) -> str:
    return Entry(key=ScanKey(source.name, 0 if source.recording else None), stem=stem).sequence


def _check_sequence(store: Store, source: Source, stem: str, place_of: dict[str, str]) -> None:
    """Refuse a second folder or recording that would be the same sequence."""
    sequence = _sequence(source, stem)
    place = source.name if source.recording else source.folder
    if place_of.setdefault(sequence, place) != place:
        raise InputError(
            f"{store.place}: {place_of[sequence]!r} and {place!r} would both be sequence {sequence}; rename one"
        )


def _completed(entry: Entry, store: Store, layout: str) -> Entry:
    path = _unpacked(entry.key.input)
    in_sequence = path.parent.name == "velodyne"
    label = path.parent.parent / "labels" / f"{path.stem}.label" if in_sequence else path.with_suffix(".label")
    calib = path.parent.parent / "calib.txt" if in_sequence else path.parent / "calib.txt"
    return Entry(
        key=entry.key,
        stem=entry.stem,
        label=str(label) if store.exists(str(label)) else None,
        calibration=str(calib) if layout == SEMANTIC_KITTI and store.exists(str(calib)) else None,
    )


def _unpacked(name: str) -> PurePosixPath:
    """The name without the ending of its packing."""
    path = PurePosixPath(name)
    return path.with_suffix("") if path.suffix.lower() in PACKED else path


def _stems(sources: Sequence[Source]) -> dict[Source, str]:
    """The stem of each file and recording of a folder; those whose outputs would clash keep their endings."""
    stems = {one: str(_unpacked(one.name).with_suffix("")) for one in sources}
    stems |= {one: one.name for one in _clashing(stems)}
    if clashing := _clashing(stems):
        raise InputError(f"{sources[0].folder}: two scans would have the outputs of {clashing[0].name!r}; rename one")
    return stems


def _clashing(stems: dict[Source, str]) -> list[Source]:
    """The files and recordings that would have an output of the same name as another one."""
    outputs = {
        one: {f"{stem}{'-#' if one.recording else ''}{suffix}" for suffix in SUFFIXES.values()}
        for one, stem in stems.items()
    }
    count = Counter(name for names in outputs.values() for name in names)
    numbered = {one: {NUMBER.sub("-#", name) for name in names} for one, names in outputs.items() if not one.recording}
    of_files = {name for names in numbered.values() for name in names}
    of_recordings = {name for one, names in outputs.items() if one.recording for name in names}
    return [
        one
        for one, names in outputs.items()
        if any(count[name] > 1 for name in names)
        or (names & of_files if one.recording else numbered[one] & of_recordings)
    ]
