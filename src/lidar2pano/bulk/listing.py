"""List the scans below a folder or URL: scan files and scans of recordings, in the order of their names."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import PurePosixPath

from lidar2pano.bulk.entries import MIRRORED, RUN_FILE, SEMANTIC_KITTI, SUFFIXES, Entry, ScanKey, Shard
from lidar2pano.bulk.stores import Folder, Store, local_copy
from lidar2pano.drives.folders import STORAGE, Source, check_topic, clashing, find_sources, no_scan, select_files
from lidar2pano.errors import InputError
from lidar2pano.formats.file_contents import stem_of
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.recordings.reading_process import confined_playback
from lidar2pano.recordings.recorded_scans import METADATA

ALL = ReadOptions()
# Endings of the stems of a run's outputs: ".segments" of ".segments.png"
STEM_ENDINGS = tuple(PurePosixPath(suffix).stem for suffix in SUFFIXES.values() if suffix.count(".") > 1)


def entries(
    store: Store,
    shard: Shard,
    layout: str = MIRRORED,
    *,
    labels: bool = False,
    selection: ReadOptions = ALL,
    only: str = "",
) -> list[Entry]:
    """List a shard's scans in the order of their folders, names and numbers.

    labels     whether the scans' own labels are needed; in a data set's layout, labels and calibration are looked for.
    selection  which scans of each recording and folder.
    only       name of the recording whose scans are meant; "": all scans.
    Raises InputError when there is no scan at all, for a topic without a recording, and when two scans would have the
    same outputs. An unreadable recording is an entry with an error.
    """
    listed: list[Entry] = []
    total, place_of = 0, dict[str, str]()
    head = store.head if isinstance(store, Folder) else None
    sources = [Source(only, True)] if only else find_sources(store.names(), head)
    if sources:
        check_topic(store.place, sources, selection)
    by_folder: dict[str, list[Source]] = {}
    for source in sources:
        by_folder.setdefault(source.folder, []).append(source)
    grouped = {folder: _stems(group) for folder, group in by_folder.items()}
    if layout == SEMANTIC_KITTI and store.exists(RUN_FILE):
        grouped = _without_outputs(grouped)
    for folder, stems in grouped.items():
        total += len(stems)
        files, refused = _select_files(
            store, folder, [item.name for item in stems if not item.recording], shard, selection
        )
        listed += refused
        for source, stem in stems.items():
            if layout == SEMANTIC_KITTI:
                _check_sequence(store, source, stem, place_of)
            if source.recording:
                listed += _recorded(store, source.name, stem, shard, selection)
            elif source.name in files:
                entry = Entry(key=ScanKey(source.name), stem=stem)
                listed.append(_completed(entry, store, layout) if labels or layout == SEMANTIC_KITTI else entry)
    if not total:
        raise no_scan(store.place)
    return listed


def is_bag_folder(store: Store) -> bool:
    """Return whether the root of a store is a ROS 2 bag's folder itself."""
    return store.exists(METADATA) and any("/" not in name and name.endswith(STORAGE) for name in store.names())


def _select_files(
    store: Store, folder: str, names: Sequence[str], shard: Shard, selection: ReadOptions
) -> tuple[set[str], list[Entry]]:
    """Return the shard's selected scan files of a folder; an entry with an error if none can be selected."""
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
    """List the shard's scans of a recording: of a download all or none, since each shard has to download it first."""
    whole = not isinstance(store, Folder)
    if whole and not shard.takes(name):
        return []
    try:
        with local_copy(store, name) as path, closing(confined_playback(path, selection.topic)) as opened:
            numbers = opened.numbers(selection)
    except InputError as error:
        return [Entry(key=ScanKey(name), stem=stem, error=str(error))] if shard.takes(name) else []
    return [Entry(key=ScanKey(name, n), stem=stem) for n in (numbers if whole else shard.part(name, numbers))]


def _without_outputs(grouped: dict[str, dict[Source, str]]) -> dict[str, dict[Source, str]]:
    """Return the groups without scan files written by a run whose ROOT was its OUT."""
    recordings = [(item, stem) for stems in grouped.values() for item, stem in stems.items() if item.recording]
    written = {f"sequences/{_sequence(item, stem)}/velodyne" for item, stem in recordings}
    return {folder: stems for folder, stems in grouped.items() if folder not in written}


def _sequence(source: Source, stem: str) -> str:
    return Entry(key=ScanKey(source.name, 0 if source.recording else None), stem=stem).sequence


def _check_sequence(store: Store, source: Source, stem: str, place_of: dict[str, str]) -> None:
    """Refuse a second folder or recording for the same sequence."""
    sequence = _sequence(source, stem)
    place = source.name if source.recording else source.folder
    if place_of.setdefault(sequence, place) != place:
        raise InputError(
            f"{store.place}: {place_of[sequence]!r} and {place!r} would both be sequence {sequence}; rename one"
        )


def _completed(entry: Entry, store: Store, layout: str) -> Entry:
    folder = PurePosixPath(entry.key.input).parent
    in_sequence = folder.name == "velodyne"
    label = (folder.parent / "labels" if in_sequence else folder) / f"{stem_of(entry.key.input)}.label"
    calib = (folder.parent if in_sequence else folder) / "calib.txt"
    return replace(
        entry,
        label=str(label) if store.exists(str(label)) else None,
        calibration=str(calib) if layout == SEMANTIC_KITTI and store.exists(str(calib)) else None,
    )


def _stems(sources: Sequence[Source]) -> dict[Source, str]:
    """Return the stem of each file and recording of a folder; those whose outputs would clash keep their endings."""
    stems = {item: str(PurePosixPath(item.name).with_name(stem_of(item.name))) for item in sources}
    stems |= {item: item.name for item in clashing(stems, STEM_ENDINGS)}
    if duplicates := clashing(stems, STEM_ENDINGS):
        raise InputError(f"{sources[0].folder}: two scans would have the outputs of {duplicates[0].name!r}; rename one")
    return stems
