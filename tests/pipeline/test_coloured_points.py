"""A panorama's colours for the points of its scan, and the PLY file with them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidar2pano.errors import InputError
from lidar2pano.formats.ply import write_ply
from lidar2pano.labels import COMMON15, SEMANTIC_KITTI
from lidar2pano.panorama import GREY, Panorama
from lidar2pano.scan import Scan
from lidar2pano.views import VIEWS
from random_weights import street

VIEW = VIEWS["panorama"].scaled(1 / 8)


def panorama(scan: Scan, depth_m: float = 1000.0) -> Panorama:
    generator = np.random.default_rng(3)
    shape = VIEW.rows, VIEW.columns
    return Panorama(
        name="a",
        frame=0,
        view=VIEW,
        colour=generator.integers(0, 256, (*shape, 3), dtype=np.uint8),
        segments=generator.integers(1, len(COMMON15), shape, dtype=np.uint8),
        depth_m=np.full(shape, depth_m, dtype=np.float32),
        labels=generator.integers(0, len(SEMANTIC_KITTI), len(scan)),
    )


def pixel_slowly(point) -> tuple[int, int]:
    x, y, z = np.asarray(point, dtype=np.float64) - VIEW.origin
    column = (np.pi - np.arctan2(y, x)) / (2 * np.pi) * VIEW.columns
    row = (VIEW.up - z / np.hypot(x, y)) / (VIEW.up - VIEW.down) * VIEW.rows
    return int(np.floor(row)), int(np.floor(column)) % VIEW.columns


def test_each_point_takes_its_pixel():
    scan = street(400)
    around = panorama(scan)
    points = around.colour_points(scan)
    assert points.colour.shape == (400, 3) and points.colour.dtype == points.segments.dtype == np.uint8
    assert 0.3 < points.in_view.mean() < 0.9 and not points.occluded.any()
    for index, point in enumerate(scan.xyz):
        row, column = pixel_slowly(point)
        inside = 0 <= row < VIEW.rows
        assert points.in_view[index] == inside
        wanted = (around.colour[row, column].tolist(), around.segments[row, column]) if inside else ([GREY] * 3, 0)
        assert (points.colour[index].tolist(), points.segments[index]) == wanted


def test_points_behind_what_the_panorama_shows_are_occluded():
    origin = np.array(VIEW.origin)
    scan = Scan(
        xyz=np.array([origin + (d, 0, 0) for d in (9.0, 12.9, 13.1, 50.0)], dtype=np.float32),
        remission=np.zeros(4, dtype=np.float32),
    )
    points = panorama(scan, depth_m=10.0).colour_points(scan)  # 10 * 1.2 + 1 = 13
    assert points.in_view.all() and points.occluded.tolist() == [False, False, True, True]
    assert points.valid.tolist() == [True, True, False, False]
    assert (points.colour[2:] == GREY).all() and not points.segments[2:].any() and points.segments[:2].all()
    sky = panorama(scan, depth_m=0.0).colour_points(scan)
    assert not sky.occluded.any()


def test_unusable_points_are_out_of_view():
    scan = street(20)
    xyz = scan.xyz.copy()
    xyz[0], xyz[1], xyz[2] = np.nan, (np.inf, 0, 0), 0
    points = panorama(scan).colour_points(replace(scan, xyz=xyz))
    assert not points.in_view[:3].any() and (points.colour[:3] == GREY).all()


def read_ply(path: Path) -> np.ndarray:
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    types = {"float": "<f4", "uchar": "u1", "ushort": "<u2"}
    fields = [
        (name, types[dtype]) for _, dtype, name in (line.split() for line in lines if line.startswith("property"))
    ]
    vertices = np.frombuffer(body, dtype=fields)
    assert f"element vertex {len(vertices)}" in lines
    return vertices


def test_the_ply_has_colours_and_classes(tmp_path):
    scan = street(300)
    xyz = scan.xyz.copy()
    xyz[5], xyz[6] = np.nan, 0
    scan = replace(scan, xyz=xyz)
    around = panorama(scan)
    vertices = read_ply(around.save_points(tmp_path / "new" / "a.ply", scan))
    kept = np.delete(np.arange(300), [5, 6])
    assert vertices.dtype.names == ("x", "y", "z", "red", "green", "blue", "remission", "label", "valid")
    np.testing.assert_array_equal(np.stack([vertices[axis] for axis in "xyz"], axis=1), scan.xyz[kept])
    points = around.colour_points(scan)
    np.testing.assert_array_equal(np.stack([vertices[c] for c in ("red", "green", "blue")], 1), points.colour[kept])
    np.testing.assert_array_equal(vertices["label"], SEMANTIC_KITTI.to_raw(around.labels[kept]))
    np.testing.assert_array_equal(vertices["valid"], points.valid[kept])
    np.testing.assert_array_equal(vertices["remission"], scan.remission[kept])


def test_another_programs_reader_opens_the_ply(tmp_path):
    plyfile = pytest.importorskip("plyfile", reason="plyfile is the second implementation")
    scan = street(50)
    vertices = plyfile.PlyData.read(panorama(scan).save_points(tmp_path / "a.ply", scan))["vertex"]
    np.testing.assert_array_equal(vertices["x"], scan.xyz[:, 0])


def test_the_scan_of_another_panorama_is_refused(tmp_path):
    with pytest.raises(ValueError, match="50 points, not 60"):
        panorama(street(50)).save_points(tmp_path / "a.ply", street(60))
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        panorama(street(50)).save_points(tmp_path / "file" / "a.ply", street(50))


def test_an_empty_ply_is_a_ply(tmp_path):
    write_ply(tmp_path / "a.ply", {"x": np.empty(0, dtype=np.float32)})
    assert len(read_ply(tmp_path / "a.ply")) == 0
