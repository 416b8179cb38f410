"""Reads image and JSON files that come from outside; whatever is wrong with one is an InputError that names it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from lidar2pano.errors import InputError


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


def read_json(path: Path) -> Any:
    """Read a JSON file; InputError where it is missing or no JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); complete the data set") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is no JSON ({error}); replace it") from error


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
