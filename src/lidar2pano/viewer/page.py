"""PageWriter: panoramas in, one self-contained HTML file out; names in it are escaped.

Layers are images for browsers, and points take a few bytes each: their codes are those that the page's script reads.
"""

from __future__ import annotations

import base64
import hashlib
import html
import io
import json
import math
import os
import pickle
import shutil
import tempfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.resources import files
from itertools import cycle
from pathlib import Path
from typing import IO, Any

import numpy as np
from PIL import Image

from lidar2pano import __version__
from lidar2pano.errors import InputError
from lidar2pano.formats.beams import find_beams
from lidar2pano.formats.image_files import write_whole
from lidar2pano.labels import COMMON15
from lidar2pano.panorama import OCCLUDED_FACTOR, OCCLUDED_M, Panorama
from lidar2pano.scan import Scan
from lidar2pano.views import View

RATE_HZ = 10.0  # frames a second when a drive is played: a LiDAR's turns
# Colours of depths from near to far, evenly spaced in the logarithm: matplotlib's map "magma", reversed.
NEAR_TO_FAR = (
    (252, 253, 191), (254, 194, 135), (251, 136, 97), (230, 81, 100), (183, 55, 121), (130, 37, 129), (81, 18, 124),
    (36, 18, 82), (16, 12, 40),
)  # fmt: skip
NO_DEPTH = (58, 66, 78)
# Colours of confidences from 0 to 1, evenly spaced: matplotlib's map "viridis".
LOW_TO_HIGH = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))

# Of invented pixels, and of cameras: Okabe and Ito's colours, which colour-blind people tell apart.
SOURCE_COLOURS = (
    (128, 128, 128), (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (0, 114, 178), (213, 94, 0),
    (204, 121, 167),
)  # fmt: skip

NEAREST_M, FARTHEST_M = 1.0, 256.0  # depths of the codes 1 and 255; equal steps of the logarithm, 2.2 % each
STEPS = 254
CONFIDENCE_STEPS = 20  # of 5 %: finer ones would be noise, and large in any coding
CENTIMETRE = 0.01  # of point coordinates: they reach 327 m
FEW_FRAMES = 4  # so many are coded exactly
MOST_FRAMES = 60  # on a page with more, every image is coarser
MANY_POINTS = 3000  # of a scan, on a page with more than MOST_FRAMES
MOST_POINTS = 1_200_000  # of a page with fewer: those of ten scans


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PageFrame:
    """One panorama as the page shows it; everything but the colour may be None. (h, w) is any raster of the view.

    name      shown as it is, whatever characters it has.
    view      the cylinder; only its directions and its origin count, not its numbers of rows and columns.
    colour    (h, w, 3) uint8 RGB.
    segments  (h, w) uint8 ids of COMMON15.
    depth_m   (h, w) float32 metres, 0 = none.
    confidence  (h, w) float32 in [0, 1]: the translator's probability of the class.
    camera    (h, w, 4) uint8 RGBA: camera images on the panorama, transparent outside them.
    xyz       (N, 3) float32: the scan's points, sensor frame, metres;  remission: (N,) float32 in [0, 1].
    source    (h, w) uint8: number of a pixel's camera, from 1; 0: invented;  cameras: their names.
    """

    name: str
    view: View
    colour: np.ndarray
    segments: np.ndarray | None = None
    depth_m: np.ndarray | None = None
    confidence: np.ndarray | None = None
    camera: np.ndarray | None = None
    xyz: np.ndarray | None = None
    remission: np.ndarray | None = None
    source: np.ndarray | None = None
    cameras: tuple[str, ...] = ()


def page_frame(panorama: Panorama, scan: Scan, name: str, camera: np.ndarray | None = None) -> PageFrame:
    """Return a panorama with its scan as a frame of a page.

    camera  (h, w, 4) uint8 RGBA: see PageFrame.
    """
    return PageFrame(
        name=name,
        view=panorama.view,
        colour=panorama.colour,
        segments=panorama.segments,
        depth_m=panorama.depth_m,
        confidence=panorama.confidence,
        camera=camera,
        xyz=scan.xyz,
        remission=scan.remission,
        source=panorama.source,
        cameras=tuple(camera.name for camera in panorama.cameras),
    )


def facts_of(weights: str, scan: Scan) -> tuple[str, ...]:
    """Return what a page says about the panoramas of such scans: weights, sensor, the day they were made."""
    beams = find_beams(scan.xyz, scan.ring)
    sensor = [f"{len(beams.elevations_deg)} beams"] if beams else []
    sensor += [f"like {beams.sensor()}"] if beams and beams.sensor() else []
    return (f"weights {weights}", *sensor, f"made {datetime.now(UTC):%Y-%m-%d}")


def title_of(paths: Sequence[Path]) -> str:
    """Return the page's title: the first path without the folders far above it, and the number of further ones."""
    first = Path(*Path(os.path.realpath(paths[0])).parts[-2:]).as_posix().lstrip("/")
    return first if len(paths) == 1 else f"{first} and {len(paths) - 1} more"


class PageWriter:
    """Collects frames on the disk and writes the page: memory does not depend on the number of frames.

    The coding depends on the number of frames, so MOST_FRAMES of them wait as they are.
    """

    def __init__(self, title: str, facts: Sequence[str] = ()) -> None:
        self.title, self.facts = title, tuple(facts)
        self._cameras: tuple[str, ...] = ()
        self._waiting: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 both are kept until the page is written
        self._data: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115
        self._coding: Coding | None = None
        self._count = self._blocks = 0
        self._frames: list[dict[str, Any]] = []
        self._present = np.zeros(256, dtype=bool)

    def add(self, frame: PageFrame) -> None:
        """Add the next frame; InputError unless its view is a cylinder."""
        if frame.view.kind != "cylinder":
            raise InputError(f"{frame.name}: is no cylinder (its rows are not tangents of elevation); view a panorama")
        self._count += 1
        if self._coding is None:
            pickle.dump(frame, self._waiting, protocol=pickle.HIGHEST_PROTOCOL)
            if self._count > MOST_FRAMES:
                self._code_waiting()
        else:
            self._frames.append(self._coded(frame, self._coding))

    def __len__(self) -> int:
        """Number of frames so far."""
        return self._count

    def _code_waiting(self) -> None:
        """Code the waiting frames, once the coding is known."""
        self._coding = coding_for(self._count)
        self._waiting.seek(0)
        for _ in range(self._count):
            self._frames.append(self._coded(pickle.load(self._waiting), self._coding))
        self._waiting.truncate(0)

    def _coded(self, frame: PageFrame, coding: Coding) -> dict[str, Any]:
        """Write a frame's blocks; return its entry in the page's index."""
        view = frame.view
        layers = {"colour": self._block(*colour_image(frame.colour, coding))}
        if frame.segments is not None:
            layers["classes"] = self._block(*code_image(frame.segments, coding.coarser))
            self._present[np.unique(frame.segments)] = True
        if frame.depth_m is not None:
            layers["depth"] = self._block(*code_image(depth_codes(frame.depth_m), coding.depth_coarser))
        if frame.confidence is not None:
            layers["confidence"] = self._block(*code_image(confidence_codes(frame.confidence), coding.depth_coarser))
        if frame.camera is not None:
            layers["camera"] = self._block(*colour_image(frame.camera, coding))
        if frame.source is not None:
            layers["source"] = self._block(*code_image(frame.source, coding.coarser))
            named, count = len(frame.cameras), max(len(frame.cameras), int(frame.source.max()))
            numbers = range(len(self._cameras), count)
            self._cameras += tuple(frame.cameras[n] if n < named else f"camera {n + 1}" for n in numbers)
        entry: dict[str, Any] = {
            "name": frame.name,
            "size": list(frame.colour.shape[:2]),
            "view": [view.up, view.down, math.radians(view.left), math.radians(view.right)],
            "origin": list(view.origin),
            "layers": layers,
        }
        if frame.xyz is not None:
            chosen, usable = chosen_points(frame.xyz, coding)
            entry["points"] = [*self._block(point_bytes(frame.xyz[chosen]), "")[:1], len(chosen), usable]
            if frame.remission is not None:
                entry["points"] += self._block(intensity_bytes(frame.remission[chosen]), "")[:1]
        return entry

    def write(self, path: Path) -> Path:
        """Write the page, complete or not at all, and return `path`; InputError if it cannot be written."""
        if not self._count:
            raise ValueError("a page needs a frame")
        if self._coding is None:
            self._code_waiting()
        head, tail = (part.encode("utf-8", "replace") for part in self._document())

        def write(unfinished: Path) -> None:
            with unfinished.open("wb") as file:
                file.write(head)
                self._data.seek(0)
                shutil.copyfileobj(self._data, file)
                file.write(tail)

        return write_whole(path, write)

    def close(self) -> None:
        """Forget the frames."""
        self._waiting.close()
        self._data.close()

    def _block(self, data: bytes, mime: str) -> list[str]:
        """Write bytes as a block of the page; return [its id, its MIME type]."""
        name = f"d{self._blocks}"
        self._blocks += 1
        self._data.write(f'<script type="text/plain" id="{name}">'.encode())
        self._data.write(base64.b64encode(data))
        self._data.write(b"</script>\n")
        return [name, mime]

    def _document(self) -> tuple[str, str]:
        """Return the parts of the page in front of and behind its blocks of data."""
        parts = files(__name__.rpartition(".")[0]) / "web"
        source = {name: (parts / name).read_text(encoding="utf-8") for name in ("page.html", "page.css", "page.js")}
        shaders = (parts / "shaders.js").read_text(encoding="utf-8")
        style, script = f"\n{source['page.css']}", f"\n{shaders}\n{source['page.js']}"
        policy = f"default-src 'none'; img-src data: blob:; script-src {_hash(script)}; style-src {_hash(style)};"
        values = {
            "policy": f"{policy} base-uri 'none'; form-action 'none'",
            "generator": f"lidar2pano {__version__}",
            "title": html.escape(self.title),
            "style": style,
            "script": script,
            "index": _json(self._index()),
        }
        head, _, tail = source["page.html"].partition("{{data}}")
        return _substituted(head, values), _substituted(tail, values)

    def _index(self) -> dict[str, Any]:
        return {
            "frames": self._frames,
            "classes": [
                {"name": name, "colour": list(colour), "present": bool(self._present[index])}
                for index, (name, colour) in enumerate(zip(COMMON15.classes, COMMON15.colours, strict=True))
            ],
            "depth": {"nearest": NEAREST_M, "farthest": FARTHEST_M, "colours": [NO_DEPTH, *_ramp(NEAR_TO_FAR, 255)]},
            "confidence": {"colours": _ramp(LOW_TO_HIGH, CONFIDENCE_STEPS + 1)},
            "occluded": [OCCLUDED_FACTOR, OCCLUDED_M],
            "sources": [
                {"name": name, "colour": list(colour)}
                for name, colour in zip(("invented", *self._cameras), cycle(SOURCE_COLOURS), strict=False)
            ],
            "about": list(self.facts),
            "rate": RATE_HZ,
        }


def _ramp(stops: tuple[tuple[int, int, int], ...], steps: int) -> list[list[int]]:
    """Return `steps` colours between the first and the last of the evenly spaced `stops`."""
    places = np.linspace(0, len(stops) - 1, steps)
    channels = [np.interp(places, np.arange(len(stops)), channel) for channel in zip(*stops, strict=True)]
    return np.stack(channels, axis=1).round().astype(int).tolist()


def _hash(text: str) -> str:
    """Return the source of a content security policy for this text alone."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _json(value: object) -> str:
    """Return JSON in ASCII without special characters of HTML."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _substituted(template: str, values: dict[str, str]) -> str:
    """Return the template with {{NAME}} replaced; values are not searched again."""
    first, *rest = template.split("{{")
    parts = (part.partition("}}") for part in rest)
    return first + "".join(values[name] + text for name, _, text in parts)


@dataclass(frozen=True, slots=True, kw_only=True)
class Coding:
    """Bounds of a frame's bytes.

    quality      of WebP for colours, 0 .. 100; None: PNG, without loss.
    coarser      panorama pixels per pixel of the colours and classes, in either direction.
    depth_coarser  likewise of the depth and the confidence.
    points       of a scan, at most.
    """

    quality: int | None
    coarser: int
    depth_coarser: int
    points: int


def coding_for(frames: int) -> Coding:
    """Return the coding of a page with so many frames: exact for few; about 30 MB for 300 frames."""
    if frames > MOST_FRAMES:
        return Coding(quality=65, coarser=2, depth_coarser=4, points=MANY_POINTS)
    points = MOST_POINTS // max(frames, 1)
    if frames > FEW_FRAMES:
        return Coding(quality=70, coarser=1, depth_coarser=2, points=points)
    return Coding(quality=None, coarser=1, depth_coarser=1, points=points)


def colour_image(colour: np.ndarray, coding: Coding) -> tuple[bytes, str]:
    """Return (bytes, MIME type) of colours (h, w, 3 or 4) uint8; the fourth channel is opacity."""
    image = Image.fromarray(colour)
    if coding.coarser > 1:
        image = image.resize([max(side // coding.coarser, 1) for side in image.size], Image.Resampling.BOX)
    if coding.quality is None:
        return _coded(image, "PNG", compress_level=6), "image/png"
    return _coded(image, "WEBP", quality=coding.quality, method=4), "image/webp"


def code_image(codes: np.ndarray, coarser: int) -> tuple[bytes, str]:
    """Return (bytes, MIME type) of every so many-th of codes (h, w) uint8, as grey values, exact."""
    part = np.ascontiguousarray(codes[coarser // 2 :: coarser, coarser // 2 :: coarser])
    return _coded(Image.fromarray(part).convert("RGB"), "WEBP", lossless=True, quality=50, method=2), "image/webp"


def confidence_codes(confidence: np.ndarray) -> np.ndarray:
    """Return codes uint8 of confidences in [0, 1], in CONFIDENCE_STEPS."""
    return np.round(confidence * CONFIDENCE_STEPS).astype(np.uint8)


def depth_codes(depth_m: np.ndarray) -> np.ndarray:
    """Return codes uint8 of depths in metres: 0 = none, 1 = NEAREST_M, 255 = FARTHEST_M, equal steps of the logarithm.

    Depths out of range take its ends.
    """
    inside = np.clip(depth_m, NEAREST_M, FARTHEST_M, dtype=np.float64)
    steps = np.round(np.log(inside / NEAREST_M) * (STEPS / np.log(FARTHEST_M / NEAREST_M)))
    return np.where(depth_m > 0, steps + 1, 0).astype(np.uint8)


def point_bytes(xyz: np.ndarray) -> bytes:
    """Return points (n, 3) in metres, finite and within 327 m, as a page has them.

    They are whole centimetres, each the difference from the point before, in six planes (low and high bytes of x, of y,
    of z), compressed by zlib.
    """
    centimetres = np.round(xyz.astype(np.float64) / CENTIMETRE)
    steps = np.diff(centimetres.astype("<i2"), axis=0, prepend=np.zeros((1, 3), dtype="<i2"))  # wraps, as the sum does
    planes = np.ascontiguousarray(steps.T).view(np.uint8).reshape(3, -1, 2).transpose(0, 2, 1)
    return zlib.compress(planes.tobytes(), 6)


def intensity_bytes(remission: np.ndarray) -> bytes:
    """Return the remission (n,) of points, a byte each, compressed by zlib: 255 above 98 of 100.

    A few retroreflectors shine brighter than everything else together.
    """
    values = remission.astype(np.float64)
    bright = np.quantile(values, 0.98) if len(values) else 0.0
    return zlib.compress(np.round(np.clip(values / max(bright, 1e-6), 0, 1) * 255).astype(np.uint8).tobytes(), 6)


def chosen_points(xyz: np.ndarray, coding: Coding) -> tuple[np.ndarray, int]:
    """Return the indices of a page's points among (N, 3), `coding.points` at most, and the number of usable ones.

    Usable are finite points within 327 m, but for the sensor's origin, the mark of no echo.
    """
    centimetres = np.round(xyz.astype(np.float64) / CENTIMETRE)
    usable = np.flatnonzero((np.abs(centimetres) < 1 << 15).all(axis=1) & centimetres.any(axis=1))  # NaN is not less
    if len(usable) <= coding.points:
        return usable, len(usable)
    return usable[np.linspace(0, len(usable) - 1, coding.points).astype(np.int64)], len(usable)


def _coded(image: Image.Image, form: str, **settings: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, form, **settings)
    return buffer.getvalue()
