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
from lidar2pano.panorama import OUTPUTS, Panorama
from lidar2pano.pipeline import Pipeline
from lidar2pano.scan import Scan
from lidar2pano.viewer.page import PageFrame, PageWriter

PAGE = "page"  # an output like OUTPUTS: the page to look around in
FILES = {
    "rgb": "panorama.png",
    "segments": "panorama.segments.png",
    "labels": "panorama.label",
    "depth": "panorama.depth.png",
    PAGE: "panorama.html",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Result:
    """What was made of a scan.

    files  the outputs by what they hold (OUTPUTS, PAGE).
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
                _, panorama = self.pipeline.step(Memory(), scan, None, timer)
                with timer("save"):
                    parts = tuple(part for part in save if part != PAGE)
                    paths = panorama.save(name, parts, None, "panorama")
                    files = dict(zip(parts, (file.read_bytes() for file in paths), strict=True))
                if PAGE in save:
                    with timer("page"):
                        files[PAGE] = page_of(panorama, scan, Path(name, FILES[PAGE]))
            except InputError as error:
                raise InputError(str(error).replace(str(path), "scan").replace(name, "")) from None
        return Result(files=files, points=len(scan), dropped=panorama.dropped, milliseconds=dict(timer.milliseconds))


def page_of(panorama: Panorama, scan: Scan, path: Path) -> bytes:
    """The bytes of a page to look around in a panorama, by way of a file at `path`."""
    writer = PageWriter("panorama")
    try:
        frame = PageFrame(
            name="scan",
            view=panorama.view,
            colour=panorama.colour,
            segments=panorama.segments,
            depth_m=panorama.depth_m,
            xyz=scan.xyz,
        )
        writer.add(frame)
        return writer.write(path).read_bytes()
    finally:
        writer.close()


def known_ending(name: str) -> str:
    """The ending of a file's name if a reader knows it, such as ".pcd" or ".csv.gz"; else ""."""
    found = [f".{part.lower()}" for part in name.split(".")[1:]]
    packed = found.pop() if found and found[-1] in PACKED else ""
    known = found[-1] if found and found[-1] in (*ENDINGS, *TEXT_ENDINGS) else ""
    return known + packed


def parse_parts(text: str) -> tuple[str, ...]:
    """The outputs that a request names, in the order of FILES; InputError for a name that is none."""
    names = {name.strip() for name in text.split(",") if name.strip()}
    if not names or not names <= {*FILES, "all"}:
        raise InputError(f"save: name some of {', '.join(FILES)}, or all (but the page)")
    names |= set(OUTPUTS) if "all" in names else set()
    return tuple(name for name in FILES if name in names)
