"""Reads JSON files that come from outside."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lidar2pano.errors import InputError


def read_json(path: Path) -> Any:
    """Read a JSON file; InputError where it is missing or no JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); complete the data set") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is no JSON ({error}); replace it") from error
