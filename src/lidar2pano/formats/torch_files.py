"""Files of `torch.save`, read as data: nothing in them is executed, and none takes more memory than it holds."""

from __future__ import annotations

import io
import mmap
import pickle
import zipfile
from pathlib import Path
from typing import Any

import torch

from lidar2pano.bounded_files import open_regular

# The only thing built by torch's restricted reader that takes more memory than the file has: its size is a number.
HUNGRY = b"bytearray"


def load_torch(path: Path | str) -> Any:  # noqa: ANN401
    """Return the content of a file of `torch.save`, tensors on the CPU; raises torch's errors, and
    UnpicklingError for a bomb.
    """
    with open_regular(path) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        if content.find(HUNGRY) >= 0:
            raise pickle.UnpicklingError("it builds a bytearray, which no weights do")
        if content[:2] == b"PK" or zipfile.is_zipfile(file):
            _check_archive(file, len(content))
    return torch.load(path, map_location="cpu", weights_only=True)


def _check_archive(file: io.FileIO, size: int) -> None:
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
