"""The one loop: readings become panoramas, files and records, for commands, fleets, servers and nodes alike."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from lidar2pano.drives.reading import Reading
from lidar2pano.errors import InputError
from lidar2pano.hardware import Timer
from lidar2pano.memory import Memory
from lidar2pano.panorama import Panorama
from lidar2pano.pipeline import Pipeline


@dataclass(kw_only=True)
class Translation:
    """A reading with its panorama, or with an error.

    outputs  files from the sinks.
    """

    reading: Reading
    panorama: Panorama | None = None
    outputs: list[Path] = field(default_factory=list)
    error: Exception | None = None

    @property
    def timer(self) -> Timer:
        """Milliseconds per stage."""
        return self.reading.timer

    @property
    def doubts(self) -> list[str]:
        """Sentences about implausible properties of the scan, an assumed height and a used VIEWPOINT."""
        interpretation = self.reading.interpretation
        if interpretation is None:
            return []
        sentences = list(interpretation.doubts)
        if (height_m := interpretation.assumed_height_m) is not None:
            sentences.append(
                f"the sensor is assumed {height_m:g} m above the ground, since its place cannot be found; name its"
                " height with --sensor-height"
            )
        if interpretation.uses_viewpoint:
            sentences.append("its VIEWPOINT is used, since it makes the scan plausible")
        return [*sentences, *self.camera_doubts]

    @property
    def camera_doubts(self) -> tuple[str, ...]:
        """Sentences about unreadable cameras and unfit ones."""
        return (*self.reading.camera_doubts, *(self.panorama.doubts if self.panorama else ()))

    def counts(self) -> dict[str, Any]:
        """Return points, dropped points and milliseconds per stage for a record; None for a stage never reached."""
        return {
            "points": None if self.reading.scan is None else len(self.reading.scan),
            "dropped": None if self.panorama is None else self.panorama.dropped,
            "milliseconds": {stage: round(value, 2) for stage, value in self.timer.milliseconds.items()},
        }


# Writes files of a panorama and returns them; InputError costs this scan alone.
Sink = Callable[[Translation], list[Path]]


class Translator:
    """Makes panoramas of readings, one at a time; those of one stream share a memory.

    make_pipeline  called for the first readable scan; its errors end the run.
    every_fault    whether any exception costs one scan alone; otherwise InputError does, and others end the run.
    """

    def __init__(self, make_pipeline: Callable[[], Pipeline], *, every_fault: bool = False) -> None:
        self._make_pipeline = make_pipeline
        self._faults: type[Exception] = Exception if every_fault else InputError
        self._memory, self._stream = Memory(), None

    @cached_property
    def pipeline(self) -> Pipeline:
        """The pipeline, made on first use."""
        return self._make_pipeline()

    def __call__(self, reading: Reading) -> Translation:
        """Translate a reading as the next one of its stream."""
        translation = Translation(reading=reading, error=reading.error)
        if reading.error or reading.scan is None:
            return translation
        pipeline, timer = self.pipeline, reading.timer
        timer.device = pipeline.device
        memory = self._memory_of(reading.source.stream)
        try:
            if reading.calibration is not None:
                pipeline = pipeline.at(reading.calibration)
            memory, translation.panorama = pipeline.step(
                memory, reading.scan, reading.pose, timer, reading.labels, reading.cameras
            )
        except self._faults as error:
            translation.error = error
        self._memory = memory
        return translation

    def _memory_of(self, stream: Hashable) -> Memory:
        """Return the memory of the scans before, an empty one for another stream or for a scan by itself."""
        if stream is None or stream != self._stream:
            self._stream = stream
            return Memory()
        return self._memory


def translate(readings: Iterable[Reading], translator: Translator, sinks: Iterable[Sink] = ()) -> Iterator[Translation]:
    """Translate readings one after the other and write each panorama with the sinks; a bad scan has its error."""
    sinks = list(sinks)
    for reading in readings:
        translation = translator(reading)
        if sinks and translation.panorama is not None:
            try:
                with translation.timer("save"):
                    for sink in sinks:
                        translation.outputs += sink(translation)
            except InputError as error:
                translation.error = error
        yield translation
