"""The bytes of a file, unpacked if it is compressed (gzip, bzip2, xz, zstd), never more than a scan can have."""

from __future__ import annotations

import bz2
import codecs
import io
import lzma
import os
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Protocol

from lidar2pano.bounded_files import open_regular
from lidar2pano.errors import InputError, require_extra

HEAD_BYTES = 4096  # of a file, for readers to decide
MOST_FILE_BYTES = 1 << 29  # a sparse or wrong file must not fill the memory
MOST_COPIED_BYTES = 1 << 35  # of an unpacked recording
MOST_BYTES = 1 << 28  # unpacked: 16 million points of 16 bytes
CHUNK_BYTES = 1 << 20
PIECE_BYTES = 1 << 14  # the rest of a piece is copied after each member, which may have twenty bytes
MOST_DICTIONARY_BYTES = 1 << 27  # of xz; its highest level needs 65 MiB to unpack
MOST_EMPTY = 1000  # members in succession that hold nothing
ZSTD = b"\x28\xb5\x2f\xfd"
MEMBERS: dict[bytes, Callable[[], Any]] = {  # first bytes of a member -> its decompressor
    b"\x1f\x8b": lambda: zlib.decompressobj(31),
    b"BZh": bz2.BZ2Decompressor,
    b"\xfd7zXZ\0": lambda: lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=MOST_DICTIONARY_BYTES),
}
PACKED = (".gz", ".bz2", ".xz", ".zst", ".zstd")  # endings of their names
MAGIC_BYTES = 10  # tell all of them
ASCII = frozenset(b"\t\n\r" + bytes(range(32, 127)))


class Inflater(Protocol):
    """Gives out unpacked bytes like a file."""

    def read(self, size: int, /) -> bytes:
        """Return at most `size` further bytes; b"" at the end."""
        ...


class MemberStream:
    """Reads a packed file of one or several members; the decompressor's error or EOFError if it is damaged."""

    def __init__(self, file: io.FileIO, magic: bytes) -> None:
        self._file, self._left, self._magic = file, b"", magic
        self._member, self._empty = MEMBERS[magic](), 0

    def read(self, size: int, /) -> bytes:
        """Return at most `size` further bytes; b"" at the end."""
        while True:
            if self._member.eof or getattr(self._member, "needs_input", True):
                self._left = self._left or self._file.read(PIECE_BYTES)
            if self._member.eof:
                if not self._left.startswith(self._magic):
                    return b""  # the end, or padding behind it
                self._member = MEMBERS[self._magic]()
                self._empty += 1
                if self._empty > MOST_EMPTY:
                    raise EOFError(f"{MOST_EMPTY} empty parts follow each other")
            elif not self._left and getattr(self._member, "needs_input", True):
                raise EOFError("it ends too early")
            data = self._member.decompress(self._left, size)
            self._left = self._member.unused_data if self._member.eof else getattr(self._member, "unconsumed_tail", b"")
            if data:
                self._empty = 0
                return data


def head_of(path: Path) -> bytes:
    """Return the first HEAD_BYTES, unpacked and as `plain_text`; InputError if the file cannot be read."""
    try:
        with open_regular(path) as file:
            head = file.read(HEAD_BYTES)
            if is_packed(head):
                file.seek(0)
                if not (head := _unpacked(path, file, head, HEAD_BYTES)):
                    raise InputError(f"{path}: unpacks to nothing: it is empty, or damaged or cut off; name a scan")
            return plain_text(head)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); name a scan file that exists") from error


def contents(path: Path) -> bytes:
    """Return all bytes, unpacked; InputError if the file cannot be read, is damaged or too large for a scan."""
    try:
        with open_regular(path) as file:
            if (length := os.fstat(file.fileno()).st_size) > MOST_FILE_BYTES:
                raise InputError(
                    f"{path}: {length} bytes are no single scan (at most {MOST_FILE_BYTES}); name a scan file"
                )
            head = file.read(MAGIC_BYTES)
            file.seek(0)
            if not is_packed(head):
                return plain_text(file.readall())
            data = _unpacked(path, file, head, MOST_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); name a scan file that exists") from error
    if len(data) > MOST_BYTES:
        raise InputError(f"{path}: unpacks to more than {MOST_BYTES} bytes, which is no single scan; name a scan file")
    return plain_text(data)


def plain_text(data: bytes) -> bytes:
    """Return text in UTF-16 or 32 as UTF-8, and text in UTF-8 without a mark before it; other bytes as they are."""
    begin = data[:64]
    for mark, encoding in ((codecs.BOM_UTF32_LE, "utf-32-le"), (codecs.BOM_UTF32_BE, "utf-32-be")):
        if begin.startswith(mark) and len(data) > 8 and ASCII.issuperset(begin[4:].replace(b"\0", b"")):
            return data[4:].decode(encoding, "ignore").encode()
    if begin.startswith(codecs.BOM_UTF8) and ASCII.issuperset(begin[3:]):
        return data[3:]
    begin = begin[2:] if begin.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else begin
    for encoding, high in (("utf-16-le", 1), ("utf-16-be", 0)):
        if len(begin) > 8 and not any(begin[high::2]) and ASCII.issuperset(begin[1 - high :: 2]):
            return data.decode(encoding, "ignore").removeprefix("\ufeff").encode()
    return data


def is_packed(head: bytes) -> bool:
    """Return whether a file is packed by gzip, bzip2, xz or zstd."""
    return head.startswith((ZSTD, *MEMBERS))


@contextmanager
def unpacked_copy(path: Path, most: int = MOST_COPIED_BYTES) -> Iterator[Path]:
    """Give an unpacked copy of a packed file for the time of the context; an InputError names the file itself.

    Raises InputError if the file is damaged, or unpacks to more than `most` bytes.
    """
    with tempfile.TemporaryDirectory(prefix="lidar2pano-") as folder:
        copy = Path(folder, path.stem)
        try:
            with open_regular(path) as file, copy.open("wb") as target:
                head = file.read(MAGIC_BYTES)
                file.seek(0)
                _unpack(path, file, head, target, most + 1)
            if copy.stat().st_size > most:
                raise InputError(f"{path}: unpacks to more than {most} bytes; unpack it")
            yield copy
        except InputError as error:
            raise InputError(str(error).replace(str(copy), str(path))) from None
        except OSError as error:
            raise InputError(f"{path}: cannot be unpacked ({error.strerror}); make room in TMPDIR") from error


def _unpacked(path: Path, file: io.FileIO, head: bytes, most: int) -> bytes:
    """Return at most so many bytes of a packed file."""
    data = io.BytesIO()
    _unpack(path, file, head, data, most)
    return data.getvalue()


def _unpack(path: Path, file: io.FileIO, head: bytes, target: BinaryIO, most: int) -> None:
    """Write at most so many bytes of a packed file."""
    magic = next((magic for magic in MEMBERS if head.startswith(magic)), b"")
    stream = MemberStream(file, magic) if magic else _zstd_stream(path, file)
    try:
        while (left := most - target.tell()) > 0 and (chunk := stream.read(min(left, CHUNK_BYTES))):
            target.write(chunk)
    except Exception as error:  # each library has errors of its own
        if isinstance(error, OSError) and error.errno:  # bzip2's own errors are of this kind, without a number
            raise
        raise InputError(f"{path}: cannot be unpacked ({error}); it is damaged or cut off, fetch it again") from error


def _zstd_stream(path: Path, file: io.FileIO) -> Inflater:
    with require_extra("formats", f"{path}:"):
        from zstandard import ZstdDecompressor
    return ZstdDecompressor(max_window_size=1 << 27).stream_reader(file, read_across_frames=True)


def stem_of(path: str | Path) -> str:
    """Return a scan file's name without its endings: "a.pcd.bin", "a.bin.gz" and "a.pcd" are all "a"."""
    name = Path(path).name
    for ending in (*PACKED, ".bin"):
        if name.lower().endswith(ending) and len(name) > len(ending):
            name = name[: -len(ending)]
            if ending == ".bin":
                return name[:-4] if name.lower().endswith(".pcd") and len(name) > 4 else name
    return Path(name).stem
