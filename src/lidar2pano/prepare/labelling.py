"""Labelling of frames: files to write, files up to date, and files of somebody else."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path

from lidar2pano.data.frames import FrameList, stems
from lidar2pano.data.journal import Journal, Record, Stamp, stamp_of
from lidar2pano.data.semantic_kitti import SEQUENCES, SemanticKittiFrame, frames, open_frame, sequences_of
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import write_whole
from lidar2pano.name_order import sort_names
from lidar2pano.prepare.teachers import Teacher


class State(StrEnum):
    """Outcome for one file."""

    WRITTEN = "written"  # now
    CURRENT = "current"  # written before, and nothing has changed since
    KEPT = "kept"  # there, and not ours
    FAILED = "failed"  # its scan or image cannot be used, or it cannot be written


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelledFile:
    """Outcome of a teacher's file for one frame; `problem` is the reason of a failure."""

    folder: str
    file: Path
    state: State
    problem: str = ""


def frames_to_label(root: Path, splits: Sequence[str] = ()) -> FrameList[SemanticKittiFrame]:
    """Every frame of the data set at `root` with a scan or an image, by sequence; or those of some splits.

    A split of splits.json has the listed frames, whose scans must exist; one of SemanticKITTI's own has all frames of
    its sequences. Raises InputError without a data set or split, or anything to label.
    """
    folder = root / "sequences"
    if not folder.is_dir():
        raise InputError(f"{root}: has no folder sequences/; name the root of a data set in SemanticKITTI layout")
    sequences: list[str] = []
    names: dict[str, None] = {}
    for split in splits:
        if (root / "splits.json").is_file() or split not in SEQUENCES:
            names |= dict.fromkeys(frames(root, split).names)
        else:
            sequences += sequences_of(folder, split)
    if not splits:
        sequences = sort_names(path.name for path in folder.iterdir() if path.is_dir())
    for sequence in sequences:
        scans = stems(folder / sequence / "velodyne", ".bin")
        images = stems(folder / sequence / "image_2", ".png", ".jpg")
        names |= dict.fromkeys(f"{sequence}/{stem}" for stem in sort_names({*scans, *images}))
    if not names:
        raise InputError(f"{root}: has neither scans (velodyne/*.bin) nor images (image_2/*.png or *.jpg)")
    by_sequence = sorted(names, key=lambda name: name.partition("/")[0])  # stable; one journal at a time is open
    return FrameList((name, partial(open_frame, folder)) for name in by_sequence)


def label(
    frames: Iterable[SemanticKittiFrame], teachers: Sequence[Teacher]
) -> Iterator[tuple[SemanticKittiFrame, list[LabelledFile]]]:
    """Let every teacher label every possible frame; yields each frame and the outcomes of its files.

    An unusable scan or image is reported as FAILED and the rest goes on. Raises InputError when a teacher's
    weights cannot be used.
    """
    journal: Journal | None = None
    for frame in frames:
        if journal is None or journal.path.parent != frame.folder:
            journal = Journal(frame.folder)
        yield frame, [outcome for teacher in teachers if (outcome := _by(teacher, frame, journal))]


def _by(teacher: Teacher, frame: SemanticKittiFrame, journal: Journal) -> LabelledFile | None:
    source = teacher.source(frame)
    if source is None:
        return None
    file = frame.file(teacher.folder, teacher.suffix)
    try:
        state = _standing(teacher, frame, source, file, journal)
    except InputError as error:
        return LabelledFile(folder=teacher.folder, file=file, state=State.FAILED, problem=str(error))
    if state is None:
        _ = teacher.network  # loaded once; its errors concern every frame: they end the work
        try:
            _write(teacher, frame, source, file, journal)
        except InputError as error:
            return LabelledFile(folder=teacher.folder, file=file, state=State.FAILED, problem=str(error))
    return LabelledFile(folder=teacher.folder, file=file, state=state or State.WRITTEN)


def _standing(teacher: Teacher, frame: SemanticKittiFrame, source: Path, file: Path, journal: Journal) -> State | None:
    """Return the state of a file to keep; None for one to write."""
    if not file.exists() and not file.is_symlink():
        return None
    if not journal.of(_name(file)):
        journal.refresh()  # whoever labels at the same time enters a file before it has its name
    records = journal.of(_name(file))
    if not records:
        return State.KEPT
    stamp = stamp_of(file, records[0].stamp)
    ours = next((record for record in records if record.stamp.sha256 == stamp.sha256), None)
    if ours is None:  # ours once: now it is broken, or somebody put another one in its place
        return State.KEPT if teacher.whole(frame, file) else None
    source_stamp = stamp_of(source, ours.source)
    if ours.made_by != teacher.made_by or source_stamp.sha256 != ours.source.sha256:
        return None
    if (source_stamp, stamp) != (records[0].source, records[0].stamp):
        # copied or touched: next time need not read them
        with suppress(OSError):  # it only saves time
            journal.enter(Record(file=_name(file), made_by=teacher.made_by, source=source_stamp, stamp=stamp))
    return State.CURRENT


def _write(teacher: Teacher, frame: SemanticKittiFrame, source: Path, file: Path, journal: Journal) -> None:
    source_stamp: Stamp = stamp_of(source)

    def write(part: Path) -> None:
        teacher.write(frame, part)
        journal.enter(Record(file=_name(file), made_by=teacher.made_by, source=source_stamp, stamp=stamp_of(part)))

    write_whole(file, write, "labels folder")


def _name(file: Path) -> str:
    return f"{file.parent.name}/{file.name}"
