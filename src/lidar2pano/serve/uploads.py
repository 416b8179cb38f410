"""Uploaded scans: a request's parameters and the bytes of a scan in, the bytes of the outputs out.

No name or path of the client is used.
"""

from __future__ import annotations

import io
import math
import secrets
import tempfile
import time
import zipfile
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from email.message import Message
from email.parser import BytesHeaderParser
from pathlib import Path

from starlette.datastructures import QueryParams
from starlette.exceptions import HTTPException

from lidar2pano.drives.reading import ReadingOptions, ScanSource, read_scan
from lidar2pano.errors import InputError, closest
from lidar2pano.formats.file_contents import PACKED
from lidar2pano.formats.interpretation import Overrides
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.formats.readers import ENDINGS, TEXT_ENDINGS
from lidar2pano.panorama import OUTPUTS
from lidar2pano.pipeline import Pipeline
from lidar2pano.recordings.reading_process import read_cloud
from lidar2pano.translation import Translation, Translator
from lidar2pano.viewer.page import PageWriter, facts_of, page_frame

READING = ReadingOptions()
PAGE = "page"  # an output like OUTPUTS: the page to look around in
FILES = {
    "rgb": "panorama.png",
    "segments": "panorama.segments.png",
    "labels": "panorama.label",
    "depth": "panorama.depth.png",
    PAGE: "panorama.html",
}

ANSWERS = ("png", "zip", "json")
PARAMETERS = ("as", "save", "name", "forward", "remission", "sensor-height", "strict")
TRUTHS = dict.fromkeys(("", "1", "true", "yes"), True) | dict.fromkeys(("0", "false", "no"), False)


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Bounds of a server.

    body_bytes  of one request;  points: of one scan.
    waiting     requests taken and not answered yet; one more is refused with 429.
    seconds     from a request to its answer;  upload_seconds: until its body is there.
    kept        results behind links; kept_seconds: for how long.
    """

    body_bytes: int = 64 << 20
    points: int = 2_000_000
    waiting: int = 8
    seconds: float = 120.0
    upload_seconds: float = 30.0
    kept: int = 16
    kept_seconds: float = 300.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Result:
    """The outputs of a scan.

    files   by their names in OUTPUTS, and PAGE;  doubts: sentences about implausible properties of the scan.
    """

    files: Mapping[str, bytes]
    points: int
    dropped: int
    milliseconds: Mapping[str, float]
    doubts: list[str] = field(default_factory=list)

    def zipped(self) -> bytes:
        """Return all files in a ZIP archive; they are compressed already."""
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            for part, data in self.files.items():
                archive.writestr(zipfile.ZipInfo(FILES[part]), data)
        return buffer.getvalue()


class KeptResults:
    """Results under unguessable names; the oldest goes when there are too many or it is too old."""

    def __init__(self, limits: Limits, clock: Callable[[], float] = time.monotonic) -> None:
        self._limits, self._clock = limits, clock
        self._kept: dict[str, tuple[float, Result]] = {}  # the oldest first

    def keep(self, result: Result) -> str:
        """Keep a result and return its name."""
        name = secrets.token_urlsafe(16)
        self._kept[name] = (self._clock(), result)
        while len(self._kept) > self._limits.kept:
            del self._kept[next(iter(self._kept))]
        return name

    def get(self, name: str) -> Result | None:
        """Return the result of this name, None if there is none (any more)."""
        oldest = self._clock() - self._limits.kept_seconds
        while self._kept and next(iter(self._kept.values()))[0] < oldest:
            del self._kept[next(iter(self._kept))]
        kept = self._kept.get(name)
        return kept and kept[1]


@dataclass(frozen=True, kw_only=True)
class UploadTranslator:
    """Makes panoramas of uploaded scans, one at a time.

    pipeline  the model in memory;  weights: its name.
    most_points, most_seconds  of a scan, and of processor time for reading it.
    """

    pipeline: Pipeline
    weights: str
    most_points: int
    most_seconds: float = math.inf

    def __call__(self, body: bytes, ending: str, save: tuple[str, ...], options: ReadingOptions = READING) -> Result:
        """Return the outputs `save` of a scan file's bytes.

        ending   of the file's name, used for ambiguous content, and only if it is known.
        options  overrides, and whether an implausible scan is an error.
        Raises InputError for an unusable scan.
        """
        with tempfile.TemporaryDirectory(prefix="lidar2pano-") as name:
            path = Path(name, f"scan{known_ending(ending)}")
            try:
                source = ScanSource(path=path, title="scan", stem="panorama", cloud=lambda: self._cloud(path, body))
                translation = Translator(lambda: self.pipeline)(read_scan(source, options))
                if translation.error:
                    raise translation.error
                return _result(translation, save, Path(name), self.weights)
            except InputError as error:
                raise InputError(str(error).replace(str(path), "scan").replace(name, "")) from None

    def _cloud(self, path: Path, body: bytes) -> PointCloud:
        path.write_bytes(body)
        return read_cloud(path, most_points=self.most_points, most_seconds=self.most_seconds)


def _result(translation: Translation, save: tuple[str, ...], folder: Path, weights: str) -> Result:
    """Write the outputs of a scan into a folder and return their bytes."""
    panorama, scan, timer = translation.panorama, translation.reading.scan, translation.timer
    assert panorama and scan
    with timer("save"):
        parts = tuple(part for part in save if part != PAGE)
        paths = panorama.save(folder, parts, None, translation.reading.source.stem)
        files = dict(zip(parts, (file.read_bytes() for file in paths), strict=True))
    if PAGE in save:
        with timer("page"), closing(PageWriter("panorama", facts_of(weights, scan))) as writer:
            writer.add(page_frame(panorama, scan, "scan"))
            files[PAGE] = writer.write(folder / FILES[PAGE]).read_bytes()
    return Result(
        files=files,
        points=len(scan),
        dropped=panorama.dropped,
        milliseconds=translation.counts()["milliseconds"],
        doubts=translation.doubts,
    )


def known_ending(name: str) -> str:
    """Return the ending of a file's name if a reader knows it, such as ".pcd" or ".csv.gz"; else ""."""
    endings = [f".{part.lower()}" for part in name.split(".")[1:]]
    packing = endings.pop() if endings and endings[-1] in PACKED else ""
    ending = endings[-1] if endings and endings[-1] in (*ENDINGS, *TEXT_ENDINGS) else ""
    return ending + packing


def parse_parts(text: str) -> tuple[str, ...]:
    """Return the outputs named by a request, in the order of FILES; InputError for an unknown name."""
    names = {name.strip() for name in text.split(",") if name.strip()}
    if not names or not names <= {*FILES, "all"}:
        raise InputError(f"save: name some of {', '.join(FILES)}, or all (but the page)")
    names |= set(OUTPUTS) if "all" in names else set()
    return tuple(name for name in FILES if name in names)


@dataclass(frozen=True, kw_only=True)
class Query:
    """A request's parameters.

    answer  form of the answer, one of ANSWERS;  save: outputs, of FILES;  name: of the file, for its ending.
    reading  overrides, and whether an implausible scan is an error.
    """

    answer: str
    save: tuple[str, ...]
    name: str
    reading: ReadingOptions


def parse_query(parameters: QueryParams) -> Query:
    """Return a request's parameters; HTTPException for an unknown or repeated name, else InputError for a fault."""
    if unknown := [name for name in parameters if name not in PARAMETERS]:
        guess = closest(unknown[0], PARAMETERS)
        raise HTTPException(400, f"{unknown[0]}: unknown parameter{guess}; known are {', '.join(PARAMETERS)}")
    if repeated := [name for name in parameters if len(parameters.getlist(name)) > 1]:
        raise HTTPException(400, f"{repeated[0]}: stands twice; give it once")
    answer, save = parameters.get("as", "png"), parse_parts(parameters.get("save", "rgb"))
    if answer not in ANSWERS:
        raise InputError(f"as: there is {', '.join(ANSWERS)}")
    if answer == "png" and save != ("rgb",):
        raise InputError("save: a PNG holds rgb alone; ask for as=zip or as=json")
    if (strict := parameters.get("strict", "0").lower()) not in TRUTHS:
        raise InputError("strict: is true or false")
    reading = ReadingOptions(overrides=_overrides(parameters), strict=TRUTHS[strict])
    return Query(answer=answer, save=save, name=parameters.get("name", ""), reading=reading)


def _overrides(parameters: Mapping[str, str]) -> Overrides:
    height = parameters.get("sensor-height", "")
    try:
        height_m = float(height) if height else None
    except ValueError:
        raise InputError(f"sensor-height: {height[:20]!r} is no height above the ground in metres") from None
    try:
        forward, remission = parameters.get("forward", ""), parameters.get("remission", "")
        return Overrides(sensor_height_m=height_m, forward=forward, remission=remission)
    except InputError as error:
        raise InputError(str(error).removeprefix("--")) from None


def file_of_form(body: bytes, content_type: str) -> tuple[bytes, str]:
    """Return the content and name of the file in a form (RFC 7578); any other body as it is, without a name.

    Raises InputError for a form without a file, or with several or other fields.
    """
    header = Message()
    header["content-type"] = content_type
    boundary = header.get_param("boundary")
    if header.get_content_type() != "multipart/form-data" or not isinstance(boundary, str):
        return body, ""
    parts = (b"\r\n" + body).split(b"\r\n--" + boundary.encode("latin-1", "replace"))[1:-1]
    if len(parts) != 1:
        raise InputError(f"form: holds {len(parts)} fields; send the scan file alone, and options in the URL")
    head, separator, content = parts[0].lstrip(b"\r\n").partition(b"\r\n\r\n")
    if not separator:
        raise InputError("form: its field has no content; send the bytes of a scan file")
    name = BytesHeaderParser().parsebytes(head).get_param("filename", "", "content-disposition")
    return content, name[2] if isinstance(name, tuple) else name  # of three: charset, language, value
