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
    assert names == {"panorama_from_numpy.py", "colour_points.py", "drive_to_video.py"}
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
    vertices = np.frombuffer(body, dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    assert np.array_equal(vertices["xyz"], scan.xyz)
    assert (vertices["rgb"] != 128).any(axis=1).mean() > 0.75  # the lowest beams look below the panorama


def test_points_take_the_colour_of_their_pixel(random_weights):
    """A point ahead, one to the left and one high above, on a panorama whose columns all differ."""
    view = lidar2pano.load(random_weights).view.scaled(2)
    columns = np.arange(view.columns)
    shades = np.stack([columns % 256, columns // 256, 0 * columns], axis=-1).astype(np.uint8)
    nothing = np.zeros((view.rows, view.columns))
    panorama = lidar2pano.Panorama(
        name="one",
        frame=0,
        view=view,
        colour=np.broadcast_to(shades, (view.rows, *shades.shape)),
        segments=nothing.astype(np.uint8),
        depth_m=nothing.astype(np.float32),
        labels=np.zeros(3, dtype=np.int64),
    )
    origin = np.array(view.origin)
    xyz = np.array([[10, -0.001, 0], [0.001, 10, 0], [1, 0, 90]]) + origin
    scan = lidar2pano.Scan(xyz=xyz.astype(np.float32), remission=np.zeros(3, dtype=np.float32))
    found = example("colour_points")["colours_of"](scan, panorama)
    half, quarter = view.columns // 2, view.columns // 4
    assert found.tolist() == [[half % 256, half // 256, 0], [quarter % 256, quarter // 256, 0], [128, 128, 128]]


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
