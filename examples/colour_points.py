"""A colour for every LiDAR point: python examples/colour_points.py [SCAN.bin] [OUT.ply].

The scan becomes a panorama; each point then takes the colour of the pixel that it lies in. Points outside of the
panorama (above or below it) are grey.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import lidar2pano
from lidar2pano import demo

GREY = 128
VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])


def colours_of(scan: lidar2pano.Scan, panorama: lidar2pano.Panorama) -> np.ndarray:
    """(N, 3) uint8: RGB of each point, in file order."""
    image = lidar2pano.project(scan, panorama.view)
    inside, row, column = image.inside.numpy(), image.row.numpy(), image.column.numpy()
    colours = np.full((len(scan), 3), GREY, dtype=np.uint8)
    colours[inside] = panorama.colour[row[inside], column[inside]]
    return colours


def write_ply(path: Path, xyz: np.ndarray, rgb: np.ndarray) -> None:
    """Write points (N, 3) float32 with colours (N, 3) uint8 as binary PLY."""
    properties = [f"property float {axis}" for axis in "xyz"]
    properties += [f"property uchar {colour}" for colour in ("red", "green", "blue")]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}", *properties, "end_header", ""]
    vertices = np.empty(len(xyz), dtype=VERTEX)
    vertices["xyz"], vertices["rgb"] = xyz, rgb
    path.write_bytes("\n".join(header).encode() + vertices.tobytes())


def main(scan_file: str = "", out: str = "points.ply", weights: str = "world") -> Path:
    scan = lidar2pano.read(scan_file or demo.street())
    panorama = lidar2pano.load(weights)(scan)
    usable = np.isfinite(scan.xyz).all(axis=1)
    write_ply(Path(out), scan.xyz[usable], colours_of(scan, panorama)[usable])
    return Path(out)


if __name__ == "__main__":
    print(main(*sys.argv[1:]))
