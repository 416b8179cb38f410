"""Every program in examples/ runs on the scan that ships with the package and writes what it says."""

from __future__ import annotations

import runpy
import shutil
from typing import Any

import numpy as np
import pytest
from PIL import Image

import house_rules
import lidar2pano
from lidar2pano import demo

EXAMPLES = house_rules.ROOT / "examples"


def example(name: str) -> dict[str, Any]:
    """The names that an example defines; it is not run."""
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


def test_every_example_is_listed_and_tested():
    names = {path.name for path in EXAMPLES.glob("*.py")}
    listed = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    assert names == {"panorama_from_numpy.py", "colour_points.py", "drive_to_video.py", "ros_node.py"}
    assert [name for name in names if f"({name})" not in listed] == []


@pytest.mark.parametrize("given", [True, False])
def test_panorama_from_numpy(tmp_path, random_weights, capsys, given):
    points = tmp_path / "mine.npy"
    np.save(points, np.fromfile(demo.street(), dtype="<f4").reshape(-1, 4)[::3])
    stem = "mine" if given else "demo"
    files = example("panorama_from_numpy")["main"](str(points) if given else "", str(tmp_path), str(random_weights))
    assert [file.name for file in files] == [f"{stem}.png", f"{stem}.segments.png", f"{stem}.depth.png"]
    assert "% of the pixels" in capsys.readouterr().out


def test_colour_points(tmp_path, random_weights):
    out = example("colour_points")["main"]("", str(tmp_path / "points.ply"), str(random_weights))
    header, _, body = out.read_bytes().partition(b"end_header\n")
    scan = lidar2pano.read(demo.street())
    assert f"element vertex {len(scan)}\n".encode() in header
    types = {"xyz": "3<f4", "rgb": "3u1", "remission": "<f4", "label": "<u2", "valid": "u1"}
    vertices = np.frombuffer(body, dtype=list(types.items()))
    assert np.array_equal(vertices["xyz"], scan.xyz)
    coloured = (vertices["rgb"] != 128).any(axis=1)
    assert np.array_equal(coloured, vertices["valid"] == 1)


def test_drive_to_video(tmp_path, random_weights):
    drive = tmp_path / "drive"
    drive.mkdir()
    for number in range(2):
        shutil.copy(demo.street(), drive / f"{number:06d}.bin")
    scan = np.fromfile(drive / "000001.bin", dtype="<f4").reshape(-1, 4)
    scan[:, :2] *= -1  # turned around
    scan.tofile(drive / "000001.bin")
    out = example("drive_to_video")["main"](str(drive), str(tmp_path / "drive.webp"), str(random_weights))
    with Image.open(out) as video:
        assert video.n_frames == 2
        assert video.width == 1536
