"""An E57 whose mutants have right checksums, so that they come further than its first page."""

from __future__ import annotations

import random
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mutation import mutant

PAGE = 1024  # bytes, the last four of which are the CRC-32C of the others
LENGTH = 16  # place of the file's own length


def crc32c(data: bytes) -> int:
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def content(file: bytes) -> bytes:
    """The bytes of a file without checksums."""
    return b"".join(file[start : start + PAGE - 4] for start in range(0, len(file), PAGE))


def paged(data: bytes) -> bytes:
    """A file of such bytes."""
    data += bytes(-len(data) % (PAGE - 4))
    pages = [data[start : start + PAGE - 4] for start in range(0, len(data), PAGE - 4)]
    pages[0] = pages[0][:LENGTH] + struct.pack("<Q", PAGE * len(pages)) + pages[0][LENGTH + 8 :]
    return b"".join(page + struct.pack(">I", crc32c(page)) for page in pages)


def seed(xyz: np.ndarray) -> bytes | None:
    """A small E57; None where pye57 is not installed."""
    try:
        import pye57
    except ImportError:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.e57")
        file = pye57.E57(str(path), mode="w")
        file.write_scan_raw({f"cartesian{axis}": xyz[:, place].astype(float) for place, axis in enumerate("XYZ")})
        file.close()
        return path.read_bytes()


def change(seeds: list[bytes]) -> Callable[[random.Random, bytes], bytes]:
    """The mutation of a file's content."""
    plain = [content(file) for file in seeds]
    return lambda draw, data: paged(mutant(draw, content(data), plain))
