"""One request's work: the bytes of a scan in, the bytes of the outputs out. No name or path of the client is used."""

from __future__ import annotations

import io
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from lidar2pano.errors import InputError
from lidar2pano.formats.readers import ENDINGS, PACKED, TEXT_ENDINGS, read
from lidar2pano.hardware import Timer
from lidar2pano.memory import Memory
from lidar2pano.panorama import OUTPUTS
from lidar2pano.pipeline import Pipeline

FILES = {"rgb": "panorama.png", "segments": "panorama.segments.png", "labels": "panorama.label"} | {
    "depth": "panorama.depth.png"
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Result:
    """What was made of a scan.

    files  the outputs by what they hold (OUTPUTS).
    """

    files: Mapping[str, bytes]
    points: int
    dropped: int
    milliseconds: Mapping[str, float]

    def zipped(self) -> bytes:
        """All files in a ZIP archive; they are compressed already."""
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            for part, data in self.files.items():
                archive.writestr(zipfile.ZipInfo(FILES[part]), data)
        return buffer.getvalue()


@dataclass(frozen=True, kw_only=True)
class Translation:
    """Makes panoramas of uploaded scans, one at a time.

    pipeline  the model in memory;  weights: its name;  most_points: of a scan.
    """

    pipeline: Pipeline
    weights: str
    most_points: int

    def __call__(self, body: bytes, ending: str, save: tuple[str, ...]) -> Result:
        """The outputs `save` of a scan file's bytes.

        ending  of the file's name, which only decides where the content does not; it is not used unless it is known.
        Raises InputError where the scan cannot be used.
        """
        timer = Timer(self.pipeline.device)
        with tempfile.TemporaryDirectory(prefix="lidar2pano-") as name:
            path = Path(name, f"scan{known_ending(ending)}")
            try:
                with timer("read"):
                    path.write_bytes(body)
                    scan = replace(read(path), name="scan")
                if len(scan) > self.most_points:
                    raise InputError(f"scan: {len(scan)} points are too many (at most {self.most_points}); thin it out")
                translated = self.pipeline.translate(scan, timer)
                _, panorama = self.pipeline.paint(translated, Memory(), None, timer)
                with timer("save"):
                    paths = panorama.save(name, save, None, "panorama")
                    files = dict(zip(save, (file.read_bytes() for file in paths), strict=True))
            except InputError as error:
                raise InputError(str(error).replace(str(path), "scan").replace(name, "")) from None
        return Result(files=files, points=len(scan), dropped=panorama.dropped, milliseconds=dict(timer.milliseconds))


def known_ending(name: str) -> str:
    """The ending of a file's name if a reader knows it, such as ".pcd" or ".csv.gz"; else ""."""
    found = [f".{part.lower()}" for part in name.split(".")[1:]]
    packed = found.pop() if found and found[-1] in PACKED else ""
    known = found[-1] if found and found[-1] in (*ENDINGS, *TEXT_ENDINGS) else ""
    return known + packed


def parse_parts(text: str) -> tuple[str, ...]:
    """The outputs that a request names, in the order of OUTPUTS; InputError for a name that is none."""
    names = {name.strip() for name in text.split(",") if name.strip()}
    if not names or not names <= {*OUTPUTS, "all"}:
        raise InputError(f"save: name some of {', '.join(OUTPUTS)}, or all")
    return OUTPUTS if "all" in names else tuple(name for name in OUTPUTS if name in names)
