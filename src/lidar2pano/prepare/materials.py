"""What there is to label in a data set: a scan, a picture, or both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lidar2pano.data.sequences import SEQUENCES, Frame, frames
from lidar2pano.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class Material:
    """One moment of a data set, with the files that teachers may look at; None where there is none."""

    frame: Frame
    scan: Path | None
    picture: Path | None


def materials(root: Path, splits: Sequence[str] = ()) -> list[Material]:
    """Every moment of the data set at `root` with a scan or a picture, by sequence; or those of some splits.

    A split that splits.json lists has the listed frames, whose scans must be there; one of SemanticKITTI's own has
    whatever its sequences have. Raises InputError when there is no data set or split, or nothing to label.
    """
    folder = root / "sequences"
    if not folder.is_dir():
        raise InputError(f"{root}: has no folder sequences/; name the root of a data set in SemanticKITTI layout")
    found: dict[str, Material] = {}
    for split in splits:
        if (root / "splits.json").is_file() or split not in SEQUENCES:
            found |= {frame.name: _of(frame) for frame in frames(root, split)}
        else:
            for number in SEQUENCES[split]:
                found |= _in_sequence(folder / f"{number:02d}")
    if not splits:
        for sequence in sorted(path for path in folder.iterdir() if path.is_dir()):
            found |= _in_sequence(sequence)
    if not found:
        raise InputError(f"{root}: has neither scans (velodyne/*.bin) nor pictures (image_2/*.png or *.jpg)")
    return list(found.values())


def _in_sequence(folder: Path) -> dict[str, Material]:
    scans = _by_stem(folder / "velodyne", ".bin")
    pictures = _by_stem(folder / "image_2", ".jpg") | _by_stem(folder / "image_2", ".png")  # as Frame.image prefers
    return {
        f"{folder.name}/{stem}": Material(
            frame=Frame(folder=folder, stem=stem), scan=scans.get(stem), picture=pictures.get(stem)
        )
        for stem in sorted(scans.keys() | pictures.keys())
    }


def _by_stem(folder: Path, suffix: str) -> dict[str, Path]:
    return {path.stem: path for path in folder.glob(f"*{suffix}") if not path.name.startswith(".")}


def _of(frame: Frame) -> Material:
    pictures = (frame.folder / "image_2" / f"{frame.stem}{suffix}" for suffix in (".png", ".jpg"))
    return Material(
        frame=frame,
        scan=frame.folder / "velodyne" / f"{frame.stem}.bin",
        picture=next((path for path in pictures if path.is_file()), None),
    )
