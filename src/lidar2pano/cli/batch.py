"""Many scans through one pipeline: the names of their outputs, the summary of each, and what happens to bad ones."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidar2pano.calibration import Calibration, read_calib
from lidar2pano.cli.app import MISTAKE, complain, note_licence
from lidar2pano.cli.follow import followed, until_interrupted
from lidar2pano.cli.progress import bar
from lidar2pano.cli.scan_queue import Complaints, QueuedScan, queued, refuse_doubts
from lidar2pano.drive_motion import Motion, motion_of
from lidar2pano.errors import InputError, closest
from lidar2pano.formats.file_contents import stem_of
from lidar2pano.formats.image_files import COLOUR_FORMATS
from lidar2pano.formats.interpretation import Interpretation, Overrides
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.hardware import Timer, keep_buffers
from lidar2pano.memory import Memory
from lidar2pano.models.families import paints_look
from lidar2pano.panorama import CONFIDENCE, OUTPUTS, Panorama
from lidar2pano.pipeline import Pipeline, load
from lidar2pano.recordings.drive_scans import drive_files
from lidar2pano.recordings.recorded_scans import ENDINGS as RECORDINGS
from lidar2pano.scan import Scan
from lidar2pano.viewer.outputs import Output, OutputFiles

ENDINGS = (".segments", ".depth", ".confidence", ".camera", ".camera-segments")  # of outputs' stems
KITTI_SIZE = "1242x375"
MOST_PIXELS = 1 << 26  # of a camera's image


@dataclass(frozen=True, kw_only=True)
class Options:
    """What the user asked of every scan, checked.

    weights  the name that was given;  files: the weight files by role that it stands for.
    sensor   name in VIEWS of the scans' rows, "" for the weights' own.
    smooth   whether a folder's or recording's panoramas are temporally smoothed.
    selection  which scans of a recording or folder;  overrides: what is known about them.
    strict     whether a scan that no LiDAR gives is an error.
    ply        whether the points of each scan are written, too;  common: files about all panoramas.
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
    selection: ReadOptions = field(default_factory=ReadOptions)
    overrides: Overrides = field(default_factory=Overrides)
    engine: str = "auto"
    image_format: str = "png"
    ply: bool = False
    strict: bool = False
    common: OutputFiles = field(default_factory=OutputFiles)

    def pipeline(self) -> Pipeline:
        """The pipeline with these weights, for this sensor and camera."""
        keep_buffers()
        pipeline = load(self.files, self.device, self.engine)
        if self.sensor:
            pipeline = pipeline.for_sensor(self.sensor)
        if self.look and not paints_look(self.files, self.look):
            pipeline = pipeline.in_look(self.look)
        return pipeline.at(self.calibration) if self.calibration else pipeline


def parse_camera(calib: Path | None, image_size: str) -> Calibration | None:
    """The camera of --calib with an image of --image-size."""
    if image_size and calib is None:
        raise InputError(f"--image-size {image_size} is the size of a camera's image; name its --calib too")
    size = parse_size(image_size or KITTI_SIZE)
    return read_calib(calib, size) if calib else None


def parse_save(text: str, confidence: bool = False) -> tuple[str, ...]:
    """--save's list, in the order of OUTPUTS; `confidence` may be in it, too, but "all" does not mean it."""
    further = (CONFIDENCE,) if confidence else ()
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise InputError(f"--save {text!r} names nothing; there is {', '.join((*OUTPUTS, *further))} and all")
    for name in names:
        if name not in (*OUTPUTS, *further, "all"):
            raise InputError(f"--save: nothing is called {name!r}{closest(name, (*OUTPUTS, *further, 'all'))}")
    wanted = {*names, *(OUTPUTS if "all" in names else ())}
    return tuple(name for name in (*OUTPUTS, *further) if name in wanted)


def parse_format(name: str) -> str:
    """--format's name, one of COLOUR_FORMATS."""
    if name not in COLOUR_FORMATS:
        raise InputError(f"--format {name!r}: no format for colour images{closest(name, COLOUR_FORMATS)}")
    return name


def parse_size(text: str) -> tuple[int, int]:
    """--image-size's width and height in pixels."""
    found = re.fullmatch(r"([1-9]\d{0,4})[xX]([1-9]\d{0,4})", text.strip())
    if not found:
        raise InputError(f"--image-size {text!r} is not of the form WIDTHxHEIGHT in pixels, e.g. {KITTI_SIZE}")
    width, height = int(found[1]), int(found[2])
    if width * height > MOST_PIXELS:
        raise InputError(f"--image-size {text!r} has more than {MOST_PIXELS} pixels; name that of the camera's image")
    return width, height


def stems(files: Sequence[Path]) -> dict[Path, str]:
    """The name of each file's outputs: its stem; where several share one, with folders' names before it."""
    whole = {file: (*file.resolve().parts[1:-1], stem_of(file)) for file in files}
    names = {file: stem_of(file) for file in files}
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


def gather(paths: Iterable[Path], selection: ReadOptions) -> tuple[list[Path], bool]:
    """Scan files and recordings that paths stand for, each once; and whether some could not be used (on stderr)."""
    files: dict[Path, Path] = {}
    failed = False
    for path in paths:
        try:
            for file in drive_files(path, selection):
                files.setdefault(file.resolve(), file)
        except InputError as error:
            complain(error)
            failed = True
    return list(files.values()), failed


def translate_files(paths: Iterable[Path], options: Options) -> int:
    """Translate the scans that `paths` stand for and return the exit code: a bad scan is reported, the rest goes on.

    Scans of one folder are one stream. Weights are loaded when the first scan has been read.
    """
    files, failed = gather(paths, options.selection)
    names = stems(files)
    if renamed := sum(names[file] != stem_of(file) for file in files):
        complain(f"{renamed} scans share a name with another; their outputs carry names of folders before it")
    unknown = any(file.suffix.lower() in RECORDINGS or file.is_dir() for file in files)  # how many scans these hold
    failed |= translate_queue(queued(files, names, options.selection), 0 if unknown else len(files), options)
    return MISTAKE if failed else 0


def translate_followed(folder: Path, options: Options) -> int:
    """Translate what is written into a folder, as it is completed, until interrupted; the exit code."""
    with until_interrupted() as stopped:
        return MISTAKE if translate_queue(followed(folder, options.selection, stopped), 0, options) else 0


def translate_queue(scans: Iterable[QueuedScan], total: int, options: Options) -> bool:
    """Translate scans one after the other; whether one failed. Those of one stream share a memory."""
    pipeline: Pipeline | None = None
    memory, stream, like, motion, noted = Memory(), None, None, None, False
    complaints = Complaints()
    with options.common.opened() as common, bar(total, "translating") as advance:
        for waiting in scans:
            timer = Timer(options.device)
            try:
                with timer("read"):
                    scan, found = waiting.read(options.overrides, like if waiting.stream == stream else None)
                    if options.strict:
                        refuse_doubts(found, waiting)
            except InputError as error:
                complaints.add(error, waiting)
                advance()
                continue
            pipeline = pipeline or options.pipeline()
            if waiting.stream != stream:
                memory, stream, like = Memory(), waiting.stream, found
                motion = motion_of(stream, scan, found, options.selection, options.smooth)
            try:
                scan, pose = _timed_pose(motion, waiting, scan, found, timer) if motion else (scan, None)
                memory, panorama = pipeline.step(memory, scan, pose if options.smooth else None, timer)
                complaints.doubt(found, waiting)  # a scan that failed has had its line
                complaints.assume(found, waiting)
                if not noted:  # before the first panorama is written
                    note_licence(pipeline.cards.values())
                noted = True
                with timer("save"):
                    outputs = _save(panorama, scan, waiting, options, common)
            except InputError as error:
                complaints.add(error, waiting)
            else:
                record = {
                    "input": str(waiting.input),
                    **waiting.place(found),
                    "outputs": [str(path) for path in outputs],
                    "points": len(scan),
                    "dropped": panorama.dropped,
                    "beyond_rows": panorama.beyond_rows,
                    "points_between": panorama.points_between,
                    "reading": found.as_dict(),
                    "milliseconds": {stage: round(value, 2) for stage, value in timer.milliseconds.items()},
                    "weights": options.weights,
                    "device": str(options.device),
                    "engine": pipeline.engine,
                }
                print(json.dumps(record) if options.as_json else summary(record), flush=True)
            advance()
        complaints.flush()
        for path in [output.finish() for output in common]:
            if path and not options.as_json:
                print(path, flush=True)
    return complaints.failed


def _save(
    panorama: Panorama, scan: Scan, waiting: QueuedScan, options: Options, common: Iterable[Output]
) -> list[Path]:
    outputs = panorama.save(options.out, options.save, options.calibration, waiting.stem, options.image_format)
    if options.ply:
        outputs.append(panorama.save_points(options.out / f"{waiting.stem}.ply", scan))
    for output in common:
        output.add(panorama, scan, waiting.input, waiting.stem)
    return outputs


def _timed_pose(
    motion: Motion, waiting: QueuedScan, scan: Scan, found: Interpretation, timer: Timer
) -> tuple[Scan, np.ndarray | None]:
    with timer("pose"):
        return motion(waiting.input, scan, found)


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
