"""Image files: RGB, class ids and 16 bit depth as PNG; and files that are written completely or not at all."""

from __future__ import annotations

import os
import platform
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image, PngImagePlugin

from lidar2pano.errors import InputError
from lidar2pano.labels import COMMON15, LabelSet

DEPTH_STEPS = 256  # per metre, KITTI's form of 16 bit depth
FAST_PNG = 1  # zlib's level: a third of the default's time for a tenth more bytes
PART = ".lidar2pano-part"  # ending of unfinished files
HOST = platform.node()[:64]
SMALL_PNG = 9  # for what is written once and read often


def read_image(path: Path, mode: str | None = None) -> np.ndarray:
    """Read an image file: (h, w, 3) uint8 with mode "RGB"; without a mode the values as stored, e.g. ids or depths.

    Raises InputError where the file is missing or damaged.
    """
    with _opened(path) as image:
        return np.array(image.convert(mode) if mode else image)


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of an image file, by its header alone; raises like `read_image`."""
    with _opened(path) as image:
        return image.size


def image_text(path: Path) -> dict[str, str]:
    """Texts by keyword that a PNG has beside its pixels, as `write_png` wrote them; raises like `read_image`."""
    with _opened(path) as image:
        image.load()  # they may stand behind the pixels
        found = {key: value for key, value in getattr(image, "text", {}).items() if isinstance(value, str)}
    return {str(key): str(value) for key, value in found.items()}


def write_png(path: Path, colour: np.ndarray, text: Mapping[str, str] | None = None) -> None:
    """Write an RGB image (h, w, 3) uint8; `text` by keyword is written beside the pixels."""
    chunks = PngImagePlugin.PngInfo()
    for keyword, value in (text or {}).items():
        chunks.add_text(keyword, value)
    Image.fromarray(colour).save(path, format="PNG", compress_level=FAST_PNG, pnginfo=chunks)


def write_palette(path: Path, ids: np.ndarray, labels: LabelSet = COMMON15) -> None:
    """Write ids (h, w) uint8 as a palette PNG: the pixels are the ids, the palette the colours of their label set."""
    image = Image.fromarray(ids, mode="P")
    image.putpalette(labels.palette())
    image.save(path, format="PNG", compress_level=FAST_PNG)


def write_ids(path: Path, ids: np.ndarray) -> None:
    """Write ids (h, w) uint8 as they are, as the grey values of a PNG: for programs, not for the eye."""
    Image.fromarray(ids).save(path, format="PNG", compress_level=SMALL_PNG)


def write_depth(path: Path, depth_m: np.ndarray) -> None:
    """Write depths (h, w) in metres as a 16 bit PNG, metres x 256, 0 = none, 255.99 m at most."""
    steps = np.clip(np.round(depth_m * DEPTH_STEPS), 0, 0xFFFF).astype(np.uint16)
    Image.fromarray(steps).save(path, format="PNG", compress_level=FAST_PNG)


def write_whole(path: Path, write: Callable[[Path], object], option: str = "--out") -> Path:
    """Call `write` with a file beside `path`, flush it to the disk, then rename it: no half file is ever seen.

    What a killed process left half written in the same folder is removed. Returns `path`.

    Raises InputError where the file cannot be written; `option` is what the user should choose differently.
    """
    beside = path.with_name(f".{HOST}-{os.getpid()}-{threading.get_native_id()}{PART}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _sweep(path.parent)
        try:
            write(beside)
            with beside.open("rb+") as file:
                os.fsync(file.fileno())
            beside.replace(path)
        finally:
            beside.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); choose another {option}") from error
    return path


@cache
def _sweep(folder: Path) -> None:
    """Remove the unfinished files of processes of this machine that no longer run; once per folder and process."""
    for part in folder.glob(f".{HOST}-*{PART}"):
        process = part.name.removeprefix(f".{HOST}-").partition("-")[0]
        if process.isdecimal() and not Path(f"/proc/{process}").exists() and Path("/proc/self").exists():
            part.unlink(missing_ok=True)


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    try:
        with Image.open(path) as image:
            yield image
    except FileNotFoundError as error:
        raise InputError(f"{path}: is missing; complete the data set") from error
    except PermissionError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); ask for permission") from error
    except (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError) as error:  # Pillow raises all
        raise InputError(f"{path}: is no readable image; replace it") from error
