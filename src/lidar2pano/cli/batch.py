"""Many scans through one pipeline: checked options, files and records of each scan, reports of bad ones."""

from __future__ import annotations

import json
import os
import signal
import sys
import webbrowser
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from lidar2pano.annotations import save_annotations
from lidar2pano.calibration import Calibration
from lidar2pano.cli.app import MISTAKE
from lidar2pano.cli.console import bar, print_error, print_note, print_weights, spooled, until_signal
from lidar2pano.cli.options import check_file
from lidar2pano.drives.folders import drive_files, left_out, output_stems
from lidar2pano.drives.reading import (
    Reading,
    ReadingOptions,
    StreamReader,
    check_followed,
    follow_folder,
    scan_sources,
)
from lidar2pano.drives.viewpoints import Place, place_readings
from lidar2pano.engines import pick_engine
from lidar2pano.errors import InputError
from lidar2pano.formats.file_contents import stem_of
from lidar2pano.hardware import keep_buffers, pick_device
from lidar2pano.models.families import BEST, best_family, paints_look, weight_files
from lidar2pano.models.stream_painter import check_variant
from lidar2pano.name_order import sort_listed
from lidar2pano.pipeline import Pipeline, load
from lidar2pano.recordings.recorded_scans import ENDINGS as RECORDINGS
from lidar2pano.recordings.recorded_scans import recording_reader
from lidar2pano.translation import Translation, Translator, translate
from lidar2pano.viewer.outputs import Output, OutputFiles
from lidar2pano.viewer.page import title_of
from lidar2pano.views import elevation_range, sensor_view


@dataclass(frozen=True, kw_only=True)
class Options:
    """Checked options of a run, the same for every scan.

    weights  a name;  files: its weight files by role;  note: which family was chosen, "" if it was named.
    sensor   name in VIEWS of the scans' rows, "" for the weights' own.
    reading  of scans; with `poses` the panoramas of a stream are temporally smoothed.
    ply      whether the points of each scan are written, too;  annotations: forms of `annotations.FORMS`.
    common   files about all panoramas.
    """

    out: Path
    save: tuple[str, ...]
    weights: str
    files: Mapping[str, Path]
    note: str = ""
    device: torch.device
    sensor: str = ""
    calibration: Calibration | None = None
    as_json: bool = False
    look: str = ""
    quality: str = "fast"
    seed: int = 0
    elevation: str = ""
    reading: ReadingOptions = field(default_factory=ReadingOptions)
    engine: str = "auto"
    image_format: str = "png"
    projection: str = "cylinder"
    ply: bool = False
    annotations: tuple[str, ...] = ()
    common: OutputFiles = field(default_factory=OutputFiles)

    def pipeline(self) -> Pipeline:
        """Make the pipeline with these weights, for this sensor and camera."""
        keep_buffers()
        pipeline = load(self.files, self.device, self.engine)
        if self.sensor:
            pipeline = pipeline.for_sensor(self.sensor)
        if self.look and not paints_look(self.files, self.look):
            pipeline = pipeline.in_look(self.look)
        pipeline = pipeline.in_variant(self.quality, self.seed)
        pipeline = pipeline.reaching(self.elevation) if self.elevation else pipeline
        return pipeline.at(self.calibration) if self.calibration else pipeline


def checked_options(
    weights: str, *, look: str = "", device: str = "auto", engine: str = "auto", **further: Any
) -> Options:
    """Return a run's options; InputError for weights, a device, an engine or a sensor out of reach.

    further  fields of Options.
    """
    check_variant(further.get("quality", "fast"), further.get("seed", 0))
    name = best_family() if weights == BEST else weights
    note = "" if name == weights else f"weights {name}: the best that is installed"
    files, picked = weight_files(name, look=look), pick_device(device)
    pick_engine(engine, picked)
    options = Options(weights=name, files=files, note=note, device=picked, look=look, engine=engine, **further)
    if options.sensor:
        sensor_view(options.sensor)
    if options.elevation:
        elevation_range(options.elevation)
    if "valid" in options.save and not options.calibration:
        raise InputError("--save valid: is where the panorama reaches in a camera's image; name its --calib too")
    return options


def common_files(scans: Sequence[Path], page: Path | None, video: Path | None, rerun: Path | None) -> OutputFiles:
    """Return the requested files about all scans; InputError for an unwritable one, or the ending of another format."""
    for file, option, ending in ((page, "--out", ""), (video, "--video", ".mp4"), (rerun, "--rerun", ".rrd")):
        if file:
            check_file(file, option)
            if ending not in ("", file.suffix.lower()):
                raise InputError(f"{option} {file}: is written as {ending}; name a file with this ending")
    return OutputFiles(page=page, title=title_of(scans), video=video, rerun=rerun)


def open_page(path: Path | None, code: int) -> int:
    """Open a page in the user's browser, if it was written (exit code 0) and there is a screen; return the code."""
    headless = sys.platform.startswith("linux") and not ({"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys())
    if path and not code and not headless:
        webbrowser.open(path.resolve().as_uri())
    return code


def gather_files(paths: Iterable[Path], options: Options) -> tuple[list[Path], bool]:
    """Return the scan files and recordings of paths, each once; and whether a path was reported as unusable.

    Of scan files that are named one by one, as by a shell's *.bin, one of --every counts, as in a folder.
    """
    files: dict[Path, Path] = {}
    failed, single, every = False, 0, options.reading.selection.every
    for path in sort_listed(list(paths)):
        try:
            chosen = drive_files(path, options.reading.selection)
            if every > 1 and chosen == [path] and recording_reader(path) is None:
                single += 1
                if (single - 1) % every:
                    continue
            for file in chosen:
                files.setdefault(file.resolve(), file)
            if chosen != [path] and (note := left_out(path, (file.relative_to(path).as_posix() for file in chosen))):
                print_note(note)
        except InputError as error:
            print_error(error)
            failed = True
    return list(files.values()), failed


def translate_all(paths: Sequence[Path], options: Options, places: Sequence[Place], follow: bool) -> int:
    """Translate scans, those of a growing folder, or a map seen from places; returns the exit code."""
    return translate_followed(paths, options) if follow else translate_files(paths, options, places)


def translate_files(paths: Iterable[Path], options: Options, places: Sequence[Place] = ()) -> int:
    """Translate the scans of `paths`, or the views from places in their map; return the exit code.

    A bad scan is reported, the others go on; a map needs all files. Scans of one folder are one stream. Weights are
    loaded when the first scan has been read.
    """
    with spooled(paths) as sources:
        files, failed = gather_files(sources, options)
        if places:
            readings = () if failed else place_readings(files, places, options.sensor, options.reading)
            return MISTAKE if failed or translate_readings(readings, len(places), options) else 0
        stems = output_stems(files)
        if renamed := sum(stems[file] != stem_of(file) for file in files):
            print_note(f"{renamed} scans share a name with another; their outputs carry names of folders before it")
        countable = not any(file.suffix.lower() in RECORDINGS or file.is_dir() for file in files)
        scans = scan_sources(files, options.reading.selection, stems)
        readings = StreamReader(options.reading)(scans)
        failed |= translate_readings(readings, len(files) if countable else 0, options)
    return MISTAKE if failed else 0


def translate_followed(paths: Sequence[Path], options: Options) -> int:
    """Translate the scans of one folder as they are completed, until interrupted; return the exit code."""
    folder = check_followed(paths, options.reading.selection)
    with until_signal(signal.SIGINT, signal.SIGTERM) as stopped:
        sources = follow_folder(folder, options.reading.selection, stopped)
        return MISTAKE if translate_readings(StreamReader(options.reading)(sources), 0, options) else 0


def translate_readings(readings: Iterable[Reading], total: int, options: Options) -> bool:
    """Translate scans one after the other and print a record of each; return whether one failed."""
    translator, reporter = Translator(options.pipeline), ErrorReporter(options.note, options.out, options.common)
    with options.common.opened(options.weights) as common, bar(total, "translating") as advance:

        def sink(translation: Translation) -> list[Path]:
            if options.reading.strict and (doubts := translation.camera_doubts):  # of scans, errors already
                title = translation.reading.source.title
                raise InputError(f"{title}: {doubts[0]} (an error because of --strict)")
            reporter.warn(translation)
            reporter.note_licence(translator.pipeline)  # before the first panorama is written
            return write_outputs(translation, options, common)

        for translation in translate(readings, translator, [sink]):
            if translation.error:
                reporter.add(translation)
            else:
                reporter.note_replaced(translation.outputs)
                line = record(translation, options, translator.pipeline.engine)
                print(json.dumps(line) if options.as_json else summary(line), flush=True)
            advance()
        reporter.flush()
        for path in filter(None, [output.finish() for output in common]):
            reporter.note_replaced([path])
            if not options.as_json:
                print(path, flush=True)
    return reporter.failed


def write_outputs(translation: Translation, options: Options, common: Iterable[Output]) -> list[Path]:
    """Write the files of a scan, add it to the files about all scans, and return its own ones."""
    panorama, scan, source = translation.panorama, translation.reading.scan, translation.reading.source
    assert panorama and scan
    files = panorama.save(
        options.out,
        options.save,
        options.calibration,
        source.stem,
        options.image_format,
        options.projection,
        scan,
    )
    if options.ply:
        files.append(panorama.save_points(options.out / f"{source.stem}.ply", scan))
    files += save_annotations(
        panorama, options.out, source.stem, options.annotations, options.image_format, source.path
    )
    for output in common:
        output.add(panorama, scan, source.path, source.stem)
    return files


def record(translation: Translation, options: Options, engine: str) -> dict[str, Any]:
    """Return the JSON record of a scan; a recording's scan has its number and stamp."""
    source, panorama = translation.reading.source, translation.panorama
    interpretation = translation.reading.interpretation
    assert panorama and interpretation
    place = {} if source.number is None else {"scan": source.number, "stamp_s": interpretation.stamp_s}
    counts = translation.counts()
    return {
        "input": str(source.path),
        **place,
        "outputs": [str(path) for path in translation.outputs],
        "points": counts["points"],
        "dropped": counts["dropped"],
        "beyond_rows": panorama.beyond_rows,
        "points_between": panorama.points_between,
        "cameras": [camera.name for camera in panorama.cameras],
        "reading": interpretation.as_dict(),
        "milliseconds": counts["milliseconds"],
        "weights": options.weights,
        "device": str(options.device),
        "engine": engine,
    }


def summary(record: Mapping[str, Any]) -> str:
    """Return one scan's record as text."""
    stages = record["milliseconds"]
    times = ", ".join(f"{stage.replace('_', ' ')} {value:.0f}" for stage, value in stages.items())
    place = f", scan {record['scan']}" if "scan" in record else ""
    dropped = f", {record['dropped']} of them unusable" if record["dropped"] else ""
    return "\n".join(
        [
            f"{record['input']}{place}: {record['points']} points{dropped}; {sum(stages.values()):.0f} ms ({times})",
            *(f"  {path}" for path in record["outputs"]),
        ]
    )


class ErrorReporter:
    """Reports on stderr: bad files one line each at once, bad scans of a recording one line together at its end.

    note    is printed with the first success, "" for none: a mistake is one line alone.
    out     folder of the outputs;  common: files about all scans.
    """

    def __init__(self, note: str, out: Path, common: OutputFiles) -> None:
        self.failed, self._note = False, note
        self._earlier_files = dict.fromkeys(out.glob("*"), "--out")  # -> option
        named = {common.video: "--video", common.rerun: "--rerun"}
        self._earlier_files |= {file: option for file, option in named.items() if file and file.exists()}
        self._licence_noted = False
        self._warnings: set[tuple[Any, str]] = set()  # stream, text
        self._recording: Path | None = None
        self._first_error, self._further_errors = "", 0

    def add(self, translation: Translation) -> None:
        """Report a failed scan."""
        self.failed = True
        source = translation.reading.source
        if source.number is None:
            print_error(translation.error)
        elif self._recording == source.path:
            self._further_errors += 1
        else:
            self.flush()
            self._recording, self._first_error = source.path, str(translation.error)

    def warn(self, translation: Translation) -> None:
        """Print the doubts about the scans, once for each stream."""
        source, interpretation = translation.reading.source, translation.reading.interpretation
        for text in translation.doubts:
            if (source.stream, text) not in self._warnings:
                self._warnings.add((source.stream, text))
                strict = interpretation is not None and text in interpretation.doubts
                strict |= text in translation.camera_doubts
                print_note(f"{source.title}: {text}{' (a warning; --strict makes it an error)' * strict}")

    def note_licence(self, pipeline: Pipeline) -> None:
        """Print the note and the weights' restrictive licence once."""
        if not self._licence_noted:
            print_weights(self._note, pipeline.cards.values())
        self._licence_noted = True

    def note_replaced(self, outputs: Iterable[Path]) -> None:
        """Say once if an output has replaced an earlier command's, be it of the same scan or of another."""
        if replaced := sorted(self._earlier_files.keys() & outputs):
            option = self._earlier_files[replaced[0]]
            self._earlier_files.clear()
            print_note(
                f"{replaced[0]}: was there and is replaced, as are others of equal names; to keep them name another"
                f" {option}"
            )

    def flush(self) -> None:
        """Report the held-back errors of a recording."""
        if self._recording:
            further = f"; {self._further_errors} more of its scans failed" if self._further_errors else ""
            print_error(self._first_error + further)
        self._recording, self._first_error, self._further_errors = None, "", 0
