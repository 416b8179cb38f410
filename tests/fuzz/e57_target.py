"""An E57 whose mutants have right checksums, so that they come further than its first page."""

from __future__ import annotations

import random
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mutation import mutant

from e57_pages import content, paged


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
