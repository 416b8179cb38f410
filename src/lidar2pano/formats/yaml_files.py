"""YAML files, read within bounds: plain values alone, no aliases, no objects."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from lidar2pano.bounded_files import MOST_CALIBRATION_BYTES, read_input
from lidar2pano.errors import InputError
from lidar2pano.formats.json_files import read_json


class _Loader(yaml.SafeLoader):
    """Plain values alone; OpenCV's matrices are mappings."""

    def compose_node(self, parent: Any, index: Any) -> Any:  # noqa: ANN401
        if self.check_event(yaml.AliasEvent):  # a few lines of them stand for billions of values
            raise yaml.YAMLError("aliases are not read")
        return super().compose_node(parent, index)

    def opencv_matrix(self, node: Any) -> Any:  # noqa: ANN401
        return self.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _Loader.opencv_matrix)


def read_document(path: Path, mend: str) -> Any:  # noqa: ANN401
    """Read a file of JSON (by its ending) or YAML, OpenCV's among it; InputError "PATH: is no YAML (REASON); MEND"."""
    if path.suffix.lower() == ".json":
        return read_json(path, mend, nan=True)
    data = read_input(path, mend, MOST_CALIBRATION_BYTES)  # 4 s of its parser
    try:
        lines = data.decode().splitlines()
        lines = lines[1:] if lines and lines[0].startswith("%YAML") else lines  # OpenCV's is no YAML
        return yaml.load("\n".join(lines), _Loader)  # noqa: S506 a SafeLoader
    except (yaml.YAMLError, ValueError, RecursionError, OverflowError, TypeError) as error:
        reason = "not text" if isinstance(error, UnicodeDecodeError) else " ".join(str(error).split())[:120]
        raise InputError(f"{path}: is no YAML ({reason}); {mend}") from None
