"""Files of `torch.save`, read as data: nothing in them is executed, and none takes more memory than it holds."""

from __future__ import annotations

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
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            if any(part.compress_type != zipfile.ZIP_STORED for part in archive.infolist()):
                raise pickle.UnpicklingError("it is packed, which torch's files are not")
    return torch.load(path, map_location="cpu", weights_only=True)
