"""Many scans through one pipeline: what each file is called, what is said about it, and what happens to bad ones."""

from __future__ import annotations

import json
import re
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lidar2pano.calibration import Calibration, read_calib
from lidar2pano.cli.app import MISTAKE, complain, note_licences
from lidar2pano.cli.files import check_folder
from lidar2pano.cli.progress import bar
from lidar2pano.data.poses import Poses
from lidar2pano.errors import InputError, closest
from lidar2pano.formats.scan_files import read, scan_files
from lidar2pano.hardware import keep_buffers, pick_device
from lidar2pano.models.families import weight_files
from lidar2pano.panorama import WHAT, Panorama
from lidar2pano.pipeline import Memory, Pipeline, load
from lidar2pano.scan import Scan
from lidar2pano.views import sensor_view

KITTI_SIZE = "1242x375"


@dataclass(frozen=True, kw_only=True)
class Wish:
    """What the user wants of every scan; `Wish.of` makes it from the options and refuses what cannot be."""

    out: Path
    save: tuple[str, ...]
    weights: str
    device: str
    sensor: str
    calibration: Calibration | None
    as_json: bool
    steady: bool = False
    look: str = ""

    @classmethod
    def of(
        cls,
        *,
        out: Path,
        save: str,
        weights: str,
        device: str,
        sensor: str = "",
        calib: Path | None = None,
        image_size: str = "",
        as_json: bool = False,
    ) -> Wish:
        """Check everything that can be checked before the first scan is read; InputError says what is wrong."""
        check_folder(out, "--out")
        if image_size and calib is None:
            raise InputError(f"--image-size {image_size} is the size of a camera's image; name its --calib too")
        size = parse_size(image_size or KITTI_SIZE)
        pick_device(device)
        weight_files(weights)
        if sensor:
            sensor_view(sensor)
        return cls(
            out=out,
            save=parse_save(save),
            weights=weights,
            device=device,
            sensor=sensor,
            calibration=read_calib(calib, size) if calib else None,
            as_json=as_json,
        )

    def pipeline(self) -> Pipeline:
        """The pipeline that fulfils it."""
        pipeline = load(self.weights, self.device)
        if self.sensor:
            pipeline = pipeline.for_sensor(self.sensor)
        if self.look:
            pipeline = pipeline.in_look(self.look)
        return pipeline.at(self.calibration) if self.calibration else pipeline


def parse_save(text: str) -> tuple[str, ...]:
    """--save's list, in the order of WHAT."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise InputError(f"--save {text!r} names nothing; there is {', '.join(WHAT)} and all")
    for name in names:
        if name not in (*WHAT, "all"):
            raise InputError(f"--save: nothing is called {name!r}{closest(name, (*WHAT, 'all'))}")
    return WHAT if "all" in names else tuple(name for name in WHAT if name in names)


def parse_size(text: str) -> tuple[int, int]:
    """--image-size's width and height in pixels."""
    found = re.fullmatch(r"([1-9]\d{0,4})[xX]([1-9]\d{0,4})", text.strip())
    if not found:
        raise InputError(f"--image-size {text!r} is not of the form WIDTHxHEIGHT in pixels, e.g. {KITTI_SIZE}")
    return int(found[1]), int(found[2])


def stems(files: Sequence[Path]) -> dict[Path, str]:
    """What the outputs of each file are called: its stem; where several share one, folders' names before it."""
    whole = {file: file.resolve().with_suffix("").parts[1:] for file in files}
    names = {file: file.stem for file in files}
    for depth in range(2, 2 + max((len(parts) for parts in whole.values()), default=0)):
        shared = {name for name, count in Counter(names.values()).items() if count > 1}
        if not shared:
            break
        names |= {file: "-".join(_telling(whole[file])[-depth:]) for file in files if names[file] in shared}
    if len(set(names.values())) < len(files):  # the same place and stem, another suffix
        names = {file: "-".join(file.resolve().parts[1:]) for file in files}
    return names


def _telling(parts: tuple[str, ...]) -> tuple[str, ...]:
    """A path's parts without the folder that every sequence has."""
    return tuple(part for part in parts[:-1] if part != "velodyne") + parts[-1:]


def gather(paths: Iterable[Path]) -> tuple[list[Path], bool]:
    """Scan files that paths stand for, each once; and whether some path could not be used (said on stderr)."""
    files: dict[Path, Path] = {}
    failed = False
    for path in paths:
        try:
            for file in scan_files(path):
                files.setdefault(file.resolve(), file)
        except InputError as error:
            complain(error)
            failed = True
    return list(files.values()), failed


def translate_files(paths: Iterable[Path], wish: Wish) -> int:
    """Translate the scans that `paths` stand for and return the exit code: a bad scan is reported, the rest goes on.

    Scans of one folder are one stream, steadied where that is wished. Weights are loaded when the first scan has been
    read.
    """
    files, failed = gather(paths)
    names = stems(files)
    if renamed := sum(names[file] != file.stem for file in files):
        complain(f"{renamed} scans share a name with another; their outputs carry names of folders before it")
    lazy = Lazy(wish)
    memory, folder, poses = Memory(), None, None
    with bar(len(files), "translating") as advance:
        for file in files:
            if file.parent != folder:
                memory, folder = Memory(), file.parent
                poses = Poses(folder) if wish.steady else None
            try:
                memory, record = one(lazy, memory, poses, file, names[file])
            except InputError as error:
                if lazy.broken:
                    raise
                complain(error)
                failed = True
            else:
                print(json.dumps(record) if wish.as_json else spoken(record), flush=True)
            advance()
    return MISTAKE if failed else 0


class Lazy:
    """The wished pipeline, loaded when it is first asked for.

    broken  it was asked for and could not be had.
    """

    def __init__(self, wish: Wish) -> None:
        self.wish = wish
        self.broken = self.noted = False
        self._held: Pipeline | None = None

    def pipeline(self) -> Pipeline:
        """The pipeline; raises InputError when the weights cannot be used."""
        if self._held is None:
            keep_buffers()
            self.broken = True
            self._held = self.wish.pipeline()
            self.broken = False
        return self._held

    def note_licence(self) -> None:
        """Say once, before the first picture is written, when the weights' licence restricts their use."""
        if not self.noted:
            note_licences([self.wish.weights])
        self.noted = True


def one(lazy: Lazy, memory: Memory, poses: Poses | None, file: Path, stem: str) -> tuple[Memory, dict[str, Any]]:
    """Read, translate and save one scan: (the stream's memory, what there is to say about it)."""
    wish, milliseconds = lazy.wish, {}
    scan = timed(milliseconds, "read", lambda: replace(read(file), name=str(file)))
    pipeline = lazy.pipeline()
    pose = None if poses is None else timed(milliseconds, "pose", lambda: poses.of(file, scan))
    memory, panorama = pipeline.step(memory, scan, pose)
    milliseconds |= panorama.milliseconds
    lazy.note_licence()
    outputs = timed(milliseconds, "save", lambda: panorama.save(wish.out, wish.save, wish.calibration, stem))
    return memory, record_of(file, outputs, scan, panorama, milliseconds, lazy)


def record_of(
    file: Path, outputs: list[Path], scan: Scan, panorama: Panorama, milliseconds: dict[str, float], lazy: Lazy
) -> dict[str, Any]:
    """What --json prints of one scan."""
    return {
        "input": str(file),
        "outputs": [str(path) for path in outputs],
        "points": len(scan),
        "dropped": panorama.dropped,
        "milliseconds": {stage: round(value, 2) for stage, value in milliseconds.items()},
        "weights": lazy.wish.weights,
        "device": str(lazy.pipeline().device),
    }


def timed(milliseconds: dict[str, float], stage: str, work: Callable[[], Any]) -> Any:  # noqa: ANN401
    """What `work` returns; its time is entered under `stage`."""
    begin = time.perf_counter()
    result = work()
    milliseconds[stage] = (time.perf_counter() - begin) * 1e3
    return result


def spoken(record: dict[str, Any]) -> str:
    """What is printed of one scan for people."""
    stages = record["milliseconds"]
    times = ", ".join(f"{stage.replace('_', ' ')} {value:.0f}" for stage, value in stages.items())
    dropped = f", {record['dropped']} of them unusable" if record["dropped"] else ""
    return "\n".join(
        [
            f"{record['input']}: {record['points']} points{dropped}; {sum(stages.values()):.0f} ms ({times})",
            *(f"  {path}" for path in record["outputs"]),
        ]
    )
