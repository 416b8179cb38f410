"""Many scans through one pipeline: the names of their outputs, the summary of each, and what happens to bad ones."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidar2pano.calibration import Calibration, read_calib
from lidar2pano.cli.app import MISTAKE, complain, note_licence
from lidar2pano.cli.progress import bar
from lidar2pano.data.poses import Poses
from lidar2pano.errors import InputError, closest
from lidar2pano.formats.scan_files import read, scan_files
from lidar2pano.hardware import Timer, keep_buffers
from lidar2pano.memory import Memory
from lidar2pano.panorama import OUTPUTS
from lidar2pano.pipeline import Pipeline, load
from lidar2pano.scan import Scan
from lidar2pano.viewer.outputs import Output, PageOutput, RerunOutput, VideoOutput

ENDINGS = (".segments", ".depth", ".camera", ".camera-segments")  # of outputs' stems
KITTI_SIZE = "1242x375"


@dataclass(frozen=True, kw_only=True)
class Options:
    """What the user asked of every scan, checked.

    weights  the name that was given;  files: the weight files by role that it stands for.
    sensor   name in VIEWS of the scans' rows, "" for the weights' own.
    smooth   whether a folder's panoramas are temporally smoothed.
    ply      whether the points of each scan are written, too.
    page, video, rerun  files about all scans together, and the page's title.
    """

    out: Path
    save: tuple[str, ...]
    weights: str
    files: Mapping[str, Path]
    device: torch.device
    sensor: str = ""
    calibration: Calibration | None = None
    as_json: bool = False
    smooth: bool = False
    look: str = ""
    ply: bool = False
    page: Path | None = None
    title: str = ""
    video: Path | None = None
    rerun: Path | None = None

    @contextmanager
    def common_outputs(self, frames: int) -> Iterator[list[Output]]:
        """The files about all of so many scans together; they are written in the end, and reported."""
        with ExitStack() as stack:
            outputs: list[Output] = []
            if self.page:
                outputs.append(stack.enter_context(closing(PageOutput(self.page, self.title, frames))))
            if self.video:
                outputs.append(stack.enter_context(closing(VideoOutput(self.video))))
            if self.rerun:
                outputs.append(stack.enter_context(closing(RerunOutput(self.rerun))))
            yield outputs
            for path in [output.finish() for output in outputs]:
                if path and not self.as_json:
                    print(path, flush=True)

    def pipeline(self) -> Pipeline:
        """The pipeline with these weights, for this sensor and camera."""
        keep_buffers()
        pipeline = load(self.files, self.device)
        if self.sensor:
            pipeline = pipeline.for_sensor(self.sensor)
        if self.look:
            pipeline = pipeline.in_look(self.look)
        return pipeline.at(self.calibration) if self.calibration else pipeline


def parse_camera(calib: Path | None, image_size: str) -> Calibration | None:
    """The camera of --calib with an image of --image-size."""
    if image_size and calib is None:
        raise InputError(f"--image-size {image_size} is the size of a camera's image; name its --calib too")
    size = parse_size(image_size or KITTI_SIZE)
    return read_calib(calib, size) if calib else None


def parse_save(text: str) -> tuple[str, ...]:
    """--save's list, in the order of OUTPUTS."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise InputError(f"--save {text!r} names nothing; there is {', '.join(OUTPUTS)} and all")
    for name in names:
        if name not in (*OUTPUTS, "all"):
            raise InputError(f"--save: nothing is called {name!r}{closest(name, (*OUTPUTS, 'all'))}")
    return OUTPUTS if "all" in names else tuple(name for name in OUTPUTS if name in names)


def parse_size(text: str) -> tuple[int, int]:
    """--image-size's width and height in pixels."""
    found = re.fullmatch(r"([1-9]\d{0,4})[xX]([1-9]\d{0,4})", text.strip())
    if not found:
        raise InputError(f"--image-size {text!r} is not of the form WIDTHxHEIGHT in pixels, e.g. {KITTI_SIZE}")
    return int(found[1]), int(found[2])


def stems(files: Sequence[Path]) -> dict[Path, str]:
    """The name of each file's outputs: its stem; where several share one, with folders' names before it."""
    whole = {file: file.resolve().with_suffix("").parts[1:] for file in files}
    names = {file: file.stem for file in files}
    for depth in range(2, 2 + max((len(parts) for parts in whole.values()), default=0)):
        shared = {name for name, count in Counter(names.values()).items() if count > 1}
        if not shared:
            break
        names |= {file: "-".join(_telling(whole[file])[-depth:]) for file in files if names[file] in shared}
    taken = {f"{name}{ending}" for name in names.values() for ending in ("", *ENDINGS)}
    if len(taken) < (1 + len(ENDINGS)) * len(files):  # another suffix only, or "a" beside "a.segments"
        names = {file: "-".join(file.resolve().parts[1:]) for file in files}
    return names


def _telling(parts: tuple[str, ...]) -> tuple[str, ...]:
    """A path's parts without the folder that every sequence has."""
    return tuple(part for part in parts[:-1] if part != "velodyne") + parts[-1:]


def gather(paths: Iterable[Path]) -> tuple[list[Path], bool]:
    """Scan files that paths stand for, each once; and whether some path could not be used (reported on stderr)."""
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


def translate_files(paths: Iterable[Path], options: Options) -> int:
    """Translate the scans that `paths` stand for and return the exit code: a bad scan is reported, the rest goes on.

    Scans of one folder are one stream. Weights are loaded when the first scan has been read.
    """
    files, failed = gather(paths)
    names = stems(files)
    if renamed := sum(names[file] != file.stem for file in files):
        complain(f"{renamed} scans share a name with another; their outputs carry names of folders before it")
    pipeline: Pipeline | None = None
    memory, folder, poses, noted = Memory(), None, None, False
    with options.common_outputs(len(files)) as common, bar(len(files), "translating") as advance:
        for file in files:
            timer = Timer(options.device)
            try:
                with timer("read"):
                    scan = replace(read(file), name=str(file))
            except InputError as error:
                complain(error)
                failed = True
                advance()
                continue
            pipeline = pipeline or options.pipeline()
            if file.parent != folder:
                memory, folder = Memory(), file.parent
                poses = Poses(folder) if options.smooth else None
            try:
                pose = _timed_pose(poses, file, scan, timer) if poses else None
                memory, panorama = pipeline.step(memory, scan, pose, timer)
                if not noted:  # before the first panorama is written
                    note_licence(pipeline.cards.values())
                noted = True
                with timer("save"):
                    outputs = panorama.save(options.out, options.save, options.calibration, names[file])
                    if options.ply:
                        outputs.append(panorama.save_points(options.out / f"{names[file]}.ply", scan))
                    for output in common:
                        output.add(panorama, scan, file)
            except InputError as error:
                complain(error)
                failed = True
            else:
                record = {
                    "input": str(file),
                    "outputs": [str(path) for path in outputs],
                    "points": len(scan),
                    "dropped": panorama.dropped,
                    "milliseconds": {stage: round(value, 2) for stage, value in timer.milliseconds.items()},
                    "weights": options.weights,
                    "device": str(options.device),
                }
                print(json.dumps(record) if options.as_json else summary(record), flush=True)
            advance()
    return MISTAKE if failed else 0


def _timed_pose(poses: Poses, file: Path, scan: Scan, timer: Timer) -> np.ndarray:
    with timer("pose"):
        return poses.of(file, scan)


def summary(record: dict[str, Any]) -> str:
    """One scan's record as text."""
    stages = record["milliseconds"]
    times = ", ".join(f"{stage.replace('_', ' ')} {value:.0f}" for stage, value in stages.items())
    dropped = f", {record['dropped']} of them unusable" if record["dropped"] else ""
    return "\n".join(
        [
            f"{record['input']}: {record['points']} points{dropped}; {sum(stages.values()):.0f} ms ({times})",
            *(f"  {path}" for path in record["outputs"]),
        ]
    )
