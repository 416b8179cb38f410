"""Files of tensors, safetensors and torch.save's: nothing in them is executed, none takes more memory than it holds.

They are opened once and read, never mapped: where somebody cuts a mapped file, the system ends the process.
"""

from __future__ import annotations

import io
import os
import pickle
import zipfile
from pathlib import Path
from typing import IO, Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor

from lidar2pano.bounded_files import open_regular
from lidar2pano.errors import InputError
from lidar2pano.formats.json_files import parse_json

# The only thing built by torch's restricted reader that takes more memory than the file has: its size is a number.
HUNGRY = b"bytearray"
ENTRY, MOST_PARTS = b"PK\1\2", 1 << 16  # of an archive: the beginning of an entry
BLOCK_BYTES = 1 << 20
MOST_HEADER = 1 << 24  # bytes of a safetensors file's names, shapes and texts: ours have some 50,000
MOST_BYTES = 1 << 32  # of a safetensors file: checkpoints of large networks with their averages
SPARSE, HOLE_BYTES = 4, 1 << 24  # weights are no zeros: packed by a file system, too, a quarter of them is stored


def read_tensors(path: Path, mend: str) -> dict[str, Tensor]:
    """Return the tensors of a safetensors file; InputError if it is missing, damaged or none."""
    return read_weights(path, mend=mend)[0]


def read_weights(
    path: Path, *, with_tensors: bool = True, mend: str = "fetch or make it again"
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return the tensors, none unless `with_tensors`, and the texts of a weight file; raises like `read_tensors`."""
    try:
        with open_regular(path) as file:
            texts = _texts(file)
            file.seek(0)
            tensors = load(file.readall()) if with_tensors else {}
    except (SafetensorError, OSError) as error:
        reason = getattr(error, "strerror", None) or str(error).partition("\n")[0] or type(error).__name__
        raise InputError(f"{path} is cut off or not a weight file ({reason}); {mend}") from None
    return tensors, texts


def _texts(file: io.FileIO) -> dict[str, Any]:
    """Return the texts in the header of a safetensors file; SafetensorError unless its tensors fill the file."""
    status, head = os.fstat(file.fileno()), int.from_bytes(file.read(8), "little")
    size, stored = status.st_size, 512 * getattr(status, "st_blocks", 0)
    if head > MOST_HEADER:
        raise SafetensorError(f"its header would have {head} bytes, at most {MOST_HEADER} are read")
    if size > MOST_BYTES or 0 < stored < size // SPARSE - HOLE_BYTES:
        raise SafetensorError(f"it would have {size} bytes, of which {stored} are stored")
    try:
        header = parse_json(file.read(head), "its header")
        texts = header.pop("__metadata__", None) or {}
        end = max((entry["data_offsets"][1] for entry in header.values()), default=0)
    except (InputError, AttributeError, LookupError, TypeError) as error:
        raise SafetensorError(str(error) if isinstance(error, InputError) else "its header is none") from None
    if end != size - 8 - head or not isinstance(texts, dict):
        raise SafetensorError(f"its tensors end at byte {end} of {size - 8 - head}")
    return texts


def load_torch(path: Path | str) -> Any:  # noqa: ANN401
    """Return the content of a file of `torch.save`, tensors on the CPU; raises torch's errors, and
    UnpicklingError for a bomb.
    """
    with io.BufferedReader(open_regular(path)) as file:
        size = os.fstat(file.fileno()).st_size
        if _count(file, HUNGRY):
            raise pickle.UnpicklingError("it builds a bytearray, which no weights do")
        if _count(file, ENTRY) > MOST_PARTS:
            raise pickle.UnpicklingError(f"it has more than {MOST_PARTS} parts")
        file.seek(0)
        if file.read(2) == b"PK" or zipfile.is_zipfile(file):
            _check_archive(file, size)
        file.seek(0)
        return torch.load(file, map_location="cpu", weights_only=True)


def _count(file: IO[bytes], word: bytes) -> int:
    """Return how often a word stands in a file."""
    count, rest = 0, b""
    file.seek(0)
    while block := file.read(BLOCK_BYTES):
        count += (rest + block).count(word)
        rest = block[1 - len(word) :]
    return count


def _check_archive(file: IO[bytes], size: int) -> None:
    """Raise UnpicklingError for an archive that unpacks to more than it holds; torch looks farther for one than we."""
    try:
        with zipfile.ZipFile(file) as archive:
            parts = archive.infolist()
    except (zipfile.BadZipFile, ValueError, NotImplementedError, OSError) as error:
        raise pickle.UnpicklingError(f"its archive is damaged ({error})") from None
    if any(part.compress_type != zipfile.ZIP_STORED or part.compress_size != part.file_size for part in parts):
        raise pickle.UnpicklingError("it is packed, which torch's files are not")
    if sum(part.file_size for part in parts) > size:
        raise pickle.UnpicklingError("several of its parts lie in the same place")
