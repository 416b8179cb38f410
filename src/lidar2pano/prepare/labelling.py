"""The work itself: what has to be written, what stands, and what is somebody else's."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from lidar2pano.errors import InputError
from lidar2pano.formats.output_files import write_whole
from lidar2pano.prepare.journal import Journal, Record, Stamp, stamp_of
from lidar2pano.prepare.materials import Material
from lidar2pano.prepare.teachers import Teacher


class State(StrEnum):
    """What became of one file."""

    WRITTEN = "written"  # now
    CURRENT = "current"  # written before, and nothing has changed since
    KEPT = "kept"  # there, and not ours
    FAILED = "failed"  # its scan or picture cannot be used, or it cannot be written


@dataclass(frozen=True, slots=True, kw_only=True)
class Labelled:
    """What became of a teacher's file for one moment; `problem` says why it failed."""

    folder: str
    file: Path
    state: State
    problem: str = ""


def label(materials: Iterable[Material], teachers: Sequence[Teacher]) -> Iterator[tuple[Material, list[Labelled]]]:
    """Let every teacher label every moment that it can see; each moment, and what became of its files.

    A scan or picture that cannot be used is reported as FAILED and the rest goes on. Raises InputError when a
    teacher's weights cannot be used.
    """
    journals: dict[Path, Journal] = {}
    for material in materials:
        folder = material.frame.folder
        if folder not in journals:
            journals[folder] = Journal(folder)
        yield material, [one for teacher in teachers if (one := _by(teacher, material, journals[folder]))]


def _by(teacher: Teacher, material: Material, journal: Journal) -> Labelled | None:
    source = teacher.source(material)
    if source is None:
        return None
    frame = material.frame
    file = frame.folder / teacher.folder / f"{frame.stem}{teacher.suffix}"
    try:
        state = _standing(teacher, material, source, file, journal)
    except InputError as error:
        return Labelled(folder=teacher.folder, file=file, state=State.FAILED, problem=str(error))
    if state is None:
        teacher.get_ready()  # its errors concern every frame: they end the work
        try:
            _write(teacher, material, source, file, journal)
        except InputError as error:
            return Labelled(folder=teacher.folder, file=file, state=State.FAILED, problem=str(error))
    return Labelled(folder=teacher.folder, file=file, state=state or State.WRITTEN)


def _standing(teacher: Teacher, material: Material, source: Path, file: Path, journal: Journal) -> State | None:
    """The state of a file that stays as it is; None for one that has to be written."""
    records = journal.of(_name(file))
    if not file.exists() and not file.is_symlink():
        return None
    if not records:
        return State.KEPT
    stamp = stamp_of(file, records[0].stamp)
    ours = next((record for record in records if record.stamp.sha256 == stamp.sha256), None)
    if ours is None:  # ours once: now it is broken, or somebody put another one in its place
        return State.KEPT if teacher.whole(material, file) else None
    seen = stamp_of(source, ours.source)
    if ours.made_by != teacher.made_by or seen.sha256 != ours.source.sha256:
        return None
    if (seen, stamp) != (records[0].source, records[0].stamp):  # copied or touched: next time need not read them
        with suppress(OSError):  # it only saves time
            journal.enter(Record(file=_name(file), made_by=teacher.made_by, source=seen, stamp=stamp))
    return State.CURRENT


def _write(teacher: Teacher, material: Material, source: Path, file: Path, journal: Journal) -> None:
    seen: Stamp = stamp_of(source)

    def write(beside: Path) -> None:
        for left in file.parent.glob(f".{file.name}.*"):  # of a run that was killed
            left.unlink(missing_ok=True)
        teacher.write(material, beside)
        journal.enter(Record(file=_name(file), made_by=teacher.made_by, source=seen, stamp=stamp_of(beside)))

    write_whole(file, write, "labels folder")


def _name(file: Path) -> str:
    return f"{file.parent.name}/{file.name}"
