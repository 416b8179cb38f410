"""LZF, the compression of PCD files: by python-neo-lzf (extra `pcd`) where it is installed, else in Python.

A packet begins with one byte: below 32 it is followed by so many plus one literal bytes; otherwise its upper three bits
are a length (7: a further byte is added) and the lower five with the next byte a distance to copy from.
"""

from __future__ import annotations

MOST_RATIO = 90  # three bytes stand for 264 at most


def decompress(data: bytes, size: int) -> bytes:
    """The `size` bytes that `data` unpacks to; ValueError where it unpacks to something else."""
    try:
        import lzf
    except ModuleNotFoundError:
        return decompress_in_python(data, size)
    try:
        found = lzf.decompress(data, size)
    except Exception as error:  # its own errors are not documented
        raise ValueError(str(error)) from None
    if found is None or len(found) != size:
        raise ValueError("it does not have the length that it says")
    return found


def decompress_in_python(data: bytes, size: int) -> bytes:
    """Like `decompress`, without a library."""
    out = bytearray()
    at, end = 0, len(data)
    try:
        while at < end and len(out) <= size:
            control = data[at]
            at += 1
            if control < 32:
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[at]
                at += 1
            start = len(out) - ((control & 31) << 8) - data[at] - 1
            at += 1
            length += 2
            if start < 0:
                raise ValueError("it copies from before its beginning")
            piece = bytes(out[start : start + length])
            if len(piece) < length:  # what is copied overlaps what it is copied to
                piece *= -(-length // len(piece))
            out += piece[:length]
    except IndexError:
        raise ValueError("it ends too early") from None
    if len(out) != size or at != end:
        raise ValueError("it does not have the length that it says")
    return bytes(out)
