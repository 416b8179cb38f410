"""Pages of E57 files, so that what is changed in one has right lengths and checksums."""

from __future__ import annotations

import struct

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
    """A file of such bytes, a page at least."""
    data += bytes(-len(data) % (PAGE - 4)) or bytes(PAGE - 4) * (not data)
    pages = [data[start : start + PAGE - 4] for start in range(0, len(data), PAGE - 4)]
    pages[0] = pages[0][:LENGTH] + struct.pack("<Q", PAGE * len(pages)) + pages[0][LENGTH + 8 :]
    return b"".join(page + struct.pack(">I", crc32c(page)) for page in pages)
