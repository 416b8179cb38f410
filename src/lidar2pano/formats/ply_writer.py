"""Writes point clouds as binary PLY, which Open3D, CloudCompare and MeshLab open."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

TYPES = {"float32": "float", "uint8": "uchar", "uint16": "ushort"}  # numpy's name -> PLY's


def write_ply(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write vertices whose properties are `columns`, each (N,) float32, uint8 or uint16, in that order."""
    vertices = np.empty(
        len(next(iter(columns.values()))),
        dtype=[(name, values.dtype.newbyteorder("<")) for name, values in columns.items()],
    )
    for name, values in columns.items():
        vertices[name] = values
    properties = [f"property {TYPES[values.dtype.name]} {name}" for name, values in columns.items()]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *properties,
        "end_header",
        "",
    ]
    path.write_bytes("\n".join(header).encode() + vertices.tobytes())
