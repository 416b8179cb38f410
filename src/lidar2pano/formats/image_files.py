"""Image files: RGB, class ids and 16 bit depth as PNG, photo spheres; and files written completely or not at all."""

from __future__ import annotations

import errno
import hashlib
import os
import platform
import secrets
import stat
import struct
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import IO, Any

import numpy as np
from PIL import Image

from lidar2pano.bounded_files import open_regular, read_bytes
from lidar2pano.errors import InputError
from lidar2pano.labels import COMMON15, LabelSet
from lidar2pano.views import FULL_TURN, View

DEPTH_STEPS = 256  # per metre, KITTI's form of 16 bit depth
PARTS = 4  # of a PNG's rows, compressed by a thread each
FAST_PNG = 1  # zlib's level: a third of the default's time for a tenth more bytes
PART = ".lidar2pano-part"  # ending of unfinished files
STALE_S = 24 * 3600  # age at which unfinished files of processes that cannot be seen from here go
# name of a format for colour images -> ending of its files, Pillow's options
COLOUR_FORMATS = {
    "png": (".png", {}),
    "webp": (".webp", {"quality": 90, "method": 0}),
    "jpeg": (".jpg", {"quality": 95}),
}
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
SMALL_PNG = 9  # for files written once and read often
READ_FORMATS = ("PNG", "JPEG", "WEBP")  # Pillow would choose among fifty by content, and starts Ghostscript for EPS
MOST_PIXELS = 1 << 25  # of an image to be read: 100 MB of RGB
JPEG_SCAN, MOST_SCANS = b"\xff\xda", 100  # a progressive JPEG has ten; each costs a pass over all pixels
PNG_KEYWORD = b"XML:com.adobe.xmp"
JPEG_NAMESPACE = b"http://ns.adobe.com/xap/1.0/\0"
PACKET = """<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"
{fields}/>
</rdf:RDF>
</x:xmpmeta>
<?xpacket end="r"?>"""


def _machine() -> str:
    """Return a name of this machine, or container, as far as its processes see each other, for names of files.

    Containers may share a host's name and a folder, but not the numbers of processes; a reboot begins them anew.
    """
    digest = hashlib.sha256()
    with suppress(OSError):  # not on Linux
        digest.update(read_bytes("/proc/sys/kernel/random/boot_id", 64))
        digest.update(bytes(Path("/proc/self/ns/pid").readlink()))
    return f"{platform.node()[:64]}-{digest.hexdigest()[:12]}"


MACHINE = _machine()


def read_image(path: Path, mode: str | None = None) -> np.ndarray:
    """Read an image file: (h, w, 3) uint8 with mode "RGB"; without a mode the values as stored, e.g. ids or depths.

    Raises InputError if the file is missing or damaged.
    """
    with _opened(path) as image:
        return np.array(image.convert(mode) if mode else image)


def image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of an image file, by its header alone; raises like `read_image`."""
    with _opened(path) as image:
        return image.size


def image_text(path: Path) -> dict[str, str]:
    """Return texts by keyword of a PNG, as `write_png` writes them; raises like `read_image`."""
    with _opened(path) as image:
        image.load()  # they may stand behind the pixels
        return {str(key): str(value) for key, value in getattr(image, "text", {}).items()}


def write_colour(
    path: Path, colour: np.ndarray, image_format: str = "png", text: Mapping[str, str] | None = None, xmp: bytes = b""
) -> None:
    """Write an RGB image (h, w, 3) uint8 in a format of COLOUR_FORMATS; only "png" keeps every value, and the text.

    xmp  packet of metadata, which all formats keep.
    """
    if image_format == "png":
        return write_png(path, colour, text, xmp)
    settings: dict[str, Any] = dict(COLOUR_FORMATS[image_format][1])
    if xmp:
        settings |= {"extra": jpeg_segment(xmp)} if image_format == "jpeg" else {"xmp": xmp}
    return Image.fromarray(colour).save(path, format=image_format.upper(), **settings)


def write_png(path: Path, colour: np.ndarray, text: Mapping[str, str] | None = None, xmp: bytes = b"") -> None:
    """Write an RGB image (h, w, 3) uint8; `text` by keyword, both Latin-1, is written beside the pixels."""
    path.write_bytes(fast_png(colour, text, xmp))


def fast_png(colour: np.ndarray, text: Mapping[str, str] | None = None, xmp: bytes = b"") -> bytes:
    """Return an RGB image (h, w, 3) uint8 as PNG, in a third of Pillow's time, of about the same size.

    Every row is filtered by "Sub" (PNG specification, 9.2), while Pillow tries all filters, and compressed fast (by
    zlib with run lengths and Huffman codes alone), in PARTS at the same time.
    """
    rows, columns, _ = colour.shape
    lines = np.empty((rows, 1 + 3 * columns), dtype=np.uint8)
    lines[:, 0] = 1  # the filter's number
    lines[:, 1:4] = colour[:, 0]
    np.subtract(colour[:, 1:], colour[:, :-1], out=lines[:, 4:].reshape(rows, columns - 1, 3))
    header = struct.pack(">IIBBBBB", columns, rows, 8, 2, 0, 0, 0)  # 8 bits per channel, RGB, not interlaced
    with ThreadPoolExecutor(PARTS) as pool:
        blocks = pool.map(_deflated, np.array_split(lines, PARTS))
        end = b"\3\0" + struct.pack(">I", _zlib().adler32(lines.data))  # an empty block, RFC 1951; a checksum, RFC 1950
        pixels = b"\x78\1" + b"".join(blocks) + end
    texts = [_chunk(b"tEXt", f"{key}\0{value}".encode("latin-1")) for key, value in (text or {}).items()]
    texts += [_chunk(b"iTXt", PNG_KEYWORD + b"\0\0\0\0\0" + xmp)] if xmp else []
    parts = (PNG_SIGNATURE, _chunk(b"IHDR", header), *texts, _chunk(b"IDAT", pixels), _chunk(b"IEND", b""))
    return b"".join(parts)


def _deflated(data: np.ndarray) -> bytes:
    """Whole blocks of a deflated stream, none of them its last."""
    strategy = {"strategy": zlib.Z_RLE} if _zlib() is zlib else {}  # ISA-L has one only
    deflate = _zlib().compressobj(FAST_PNG, wbits=-zlib.MAX_WBITS, **strategy)
    return deflate.compress(data.data) + deflate.flush(zlib.Z_SYNC_FLUSH)


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", _zlib().crc32(name + data))


@cache
def _zlib() -> Any:  # noqa: ANN401
    """Return Intel's ISA-L if the extra `fast` is installed, a quarter of zlib's time for smaller files; else zlib."""
    try:
        from isal import isal_zlib
    except ImportError:
        return zlib
    return isal_zlib


def write_palette(path: Path, ids: np.ndarray, labels: LabelSet = COMMON15) -> None:
    """Write ids (h, w) uint8 as a palette PNG: the pixels are the ids, the palette the colours of their label set."""
    image = Image.fromarray(ids, mode="P")
    image.putpalette(labels.palette())
    image.save(path, format="PNG", compress_level=FAST_PNG)


def write_ids(path: Path, ids: np.ndarray) -> None:
    """Write ids (h, w) uint8 or uint16 as they are, as the grey values of a PNG: for programs, not for the eye."""
    Image.fromarray(ids).save(path, format="PNG", compress_level=SMALL_PNG)


def write_depth(path: Path, depth_m: np.ndarray) -> None:
    """Write depths (h, w) in metres as a 16 bit PNG, metres x 256, 0 = none, 255.99 m at most."""
    steps = np.clip(np.round(depth_m * DEPTH_STEPS), 0, 0xFFFF).astype(np.uint16)
    Image.fromarray(steps).save(path, format="PNG", compress_level=FAST_PNG)


def check_target(path: str | Path) -> None:
    """Raise OSError if renaming a file to `path` would destroy something else: a link, device, FIFO or socket."""
    try:
        mode = os.lstat(path).st_mode
    except FileNotFoundError:
        return
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError(errno.EINVAL, "it is a link, device, FIFO or socket, which is not replaced", str(path))


def append_bytes(path: str | Path, data: bytes) -> None:
    """Append to a regular file by one call of the system, so that processes' lines do not mix; no link is followed.

    Raises OSError if a full disk takes a part only; it stays at the file's end.
    """
    check_target(path)
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    descriptor = os.open(path, flags, 0o666)
    try:
        while data := data[os.write(descriptor, data) :]:  # the rest of a short write, or the error that it foretells
            pass
    finally:
        os.close(descriptor)


def write_whole(path: Path, write: Callable[[Path], object], option: str = "--out") -> Path:
    """Call `write` with a file beside `path`, flush it to the disk, then rename it: no half file is ever seen.

    Half-written files of killed processes in the same folder are removed (`is_abandoned`). Returns `path`.

    Raises InputError if the file cannot be written; `option` is the user's to choose differently.
    """
    part = path.with_name(f".{MACHINE}-{os.getpid()}-{secrets.token_hex(8)}{PART}")  # nobody can plant a link there
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        check_target(path)
        _sweep(path.parent)
        try:
            part.open("xb").close()
            write(part)
            with part.open("rb+") as file:
                os.fsync(file.fileno())
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({reason(error)}); choose another {option}") from error
    return path


def write_text(path: Path, text: str, option: str = "--out") -> Path:
    """Write text in UTF-8, complete or not at all, see `write_whole`; return `path`."""
    data = text.encode("utf-8", "backslashreplace")  # names of files may be no UTF-8
    return write_whole(path, lambda part: part.write_bytes(data), option)


def reason(error: OSError) -> str:
    """Return the system's message; numpy's `tofile` says only how many bytes it could write."""
    return error.strerror or ("No space left on device" if "requested and" in str(error) else str(error))


@cache
def _sweep(folder: Path) -> None:
    """Remove the unfinished files of processes that no longer run; once per folder and process."""
    for part in folder.glob(f".*{PART}"):
        with suppress(OSError):  # its own process has just removed it, or it is another user's
            if is_abandoned(part, part.name[1:].rpartition("-")[0].rpartition("-")[0]):
                part.unlink()


def is_abandoned(path: Path, process: str) -> bool:
    """Return whether the process of an unfinished file or folder has ended, or, if it is not seen here, must have.

    process  "MACHINE-NUMBER", as in the names of such files.
    Raises FileNotFoundError if the file is gone.
    """
    machine, _, number = process.rpartition("-")
    if machine == MACHINE and Path("/proc/self").exists():  # this tells more than a clock, which may jump
        return not Path("/proc", number).exists()
    return time.time() - path.stat().st_mtime > STALE_S


def decode_image(file: IO[bytes], title: str, mode: str | None) -> np.ndarray:
    """Decode an image in an open file, as `read_image`; InputError, with `title`, if it is damaged or too large."""
    with _decoded(file, title) as image:
        return np.array(image.convert(mode) if mode else image)


def _check_scans(file: IO[bytes]) -> None:
    """Raise ValueError for a JPEG of more scans than MOST_SCANS; the file's place stays as it was."""
    place = file.tell()
    file.seek(0)
    if file.read().count(JPEG_SCAN) > MOST_SCANS:
        raise ValueError
    file.seek(place)


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    try:
        file = open_regular(path)
    except FileNotFoundError as error:
        raise InputError(f"{path}: is missing; complete the data set") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); ask for permission, or name a file") from error
    with _decoded(file, path) as image:
        yield image


@contextmanager
def _decoded(file: IO[bytes], title: object) -> Iterator[Image.Image]:
    try:
        with file, Image.open(file, formats=READ_FORMATS) as image:
            if image.width * image.height > MOST_PIXELS:
                raise Image.DecompressionBombError
            if image.format == "JPEG":
                _check_scans(file)
            yield image
    except InputError:
        raise
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise InputError(f"{title}: has more pixels than an image may ({MOST_PIXELS}); shrink it") from error
    except (OSError, SyntaxError, ValueError, EOFError) as error:  # Pillow raises all
        raise InputError(f"{title}: is no readable image; replace it") from error


def gpano(view: View) -> bytes:
    """Return the XMP packet of an equirectangular image, the part of a full sphere that `view` (a sphere) is."""
    if view.kind != "sphere":
        raise ValueError("a photo sphere's rows are equal steps of elevation")
    step = (view.left - view.right) / view.columns
    width = round(FULL_TURN / step)
    fields = {
        "UsePanoramaViewer": "True",
        "ProjectionType": "equirectangular",
        "FullPanoWidthPixels": width,
        "FullPanoHeightPixels": width // 2,
        "CroppedAreaImageWidthPixels": view.columns,
        "CroppedAreaImageHeightPixels": view.rows,
        "CroppedAreaLeftPixels": round((FULL_TURN / 2 - view.left) / step),
        "CroppedAreaTopPixels": round((90 - view.up) / step),
    }
    return PACKET.format(fields="\n".join(f'GPano:{name}="{value}"' for name, value in fields.items())).encode()


def jpeg_segment(xmp: bytes) -> bytes:
    """Return the APP1 segment with an XMP packet."""
    content = JPEG_NAMESPACE + xmp
    return b"\xff\xe1" + struct.pack(">H", len(content) + 2) + content
