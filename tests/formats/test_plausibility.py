"""Doubts about clouds that no LiDAR gives, and none about those that one gives."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import sample_files as made
from lidar2pano import demo
from lidar2pano.cli import main
from lidar2pano.formats.interpretation import Overrides, interpret
from lidar2pano.formats.plausibility import repeated_range
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.formats.readers import interpreted

XYZ, _ = made.street(beams=32, columns=600)
REMISSION = made.remission(len(XYZ))


def doubts(xyz: np.ndarray, remission: np.ndarray = REMISSION, rows: bool = True) -> tuple[str, ...]:
    name = "float32 rows, KITTI" if rows else "PCD, binary"
    cloud = PointCloud(xyz=xyz.astype(np.float32), intensity=remission[: len(xyz)], format=name)
    return interpret(cloud, Overrides(invent=True))[1].doubts


def test_there_is_none_about_good_scans():
    assert doubts(XYZ) == ()
    assert next(interpreted(demo.street()))[1].doubts == ()


def test_what_did_not_return_is_no_doubt_where_a_format_marks_it():
    holes = XYZ.copy()
    holes[::3] = np.nan
    assert doubts(holes, rows=False) == () and "are no coordinates" in doubts(holes)[0]


@pytest.mark.parametrize("range_m", [65.535, 120, 1000, 65535, 1e9])
def test_ranges_that_mark_missing_returns_are_none(range_m):
    """A sensor's farthest range where nothing came back, above the horizon and on some of its rays below."""
    ray = XYZ / np.linalg.norm(XYZ, axis=1, keepdims=True)
    marked = np.arange(len(XYZ)) % 5 == 0
    xyz = np.where(marked[:, None], np.abs(ray) * np.sign(ray * [1, 1, 0] + [0, 0, 1]) * range_m, XYZ)
    cloud = PointCloud(xyz=xyz.astype(np.float32), intensity=REMISSION, format="PCD, binary")
    scan, found = interpret(cloud)
    assert found.no_returns == np.count_nonzero(marked) and not found.doubts and found.unit_m == 1
    assert np.isnan(scan.xyz[marked]).all()
    np.testing.assert_array_equal(scan.xyz[~marked], XYZ[~marked])


def test_a_ring_of_level_ground_is_no_mark():
    circle = np.linspace(0, 2 * np.pi, 600, endpoint=False)
    ring = np.column_stack([70 * np.cos(circle), 70 * np.sin(circle), np.full(600, -1.8)])
    assert repeated_range(np.concatenate([XYZ, ring])) is None


def test_infinite_places_are_missing_returns():
    assert doubts(np.where(np.arange(len(XYZ))[:, None] % 3, XYZ, np.inf), rows=False) == ()


BYTES = XYZ.astype(np.float32)
STRANGE = {
    "noise": (np.random.default_rng(0).normal(0, 20, XYZ.shape), "no ground was found below"),
    "z down": (XYZ * [1, -1, -1], "z seems to point down"),
    "camera": (XYZ @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), "a camera's (z forward, y down)"),
    "float64": (XYZ.astype("<f8").view("<f4").reshape(-1, 3)[: len(XYZ)], "is it float64 or big-endian"),
    "big-endian": (BYTES.byteswap(), "is it float64 or big-endian"),
    "few": (XYZ[:40], "only 40 of its points"),
}


@pytest.mark.parametrize("name", STRANGE)
def test_what_is_strange_is_doubted(name):
    xyz, says = STRANGE[name]
    (doubt,) = doubts(xyz)
    assert says in doubt


def test_full_remission_is_doubted():
    assert "full remission" in doubts(XYZ, np.where(np.arange(len(XYZ)) % 4, 1.0, 0.3).astype(np.float32))[0]


def test_strict_makes_an_error_of_a_warning_and_json_carries_it(tmp_path, monkeypatch, capsys, random_weights):
    monkeypatch.chdir(tmp_path)
    Path("noise.bin").write_bytes(made.rows(STRANGE["noise"][0], REMISSION))
    words = ["translate", "noise.bin", "--weights", str(random_weights), "--device", "cpu", "--json"]
    assert main([*words, "--strict"]) == 2
    assert capsys.readouterr().err.count("\n") == 1 and not Path("panoramas").exists()
    assert main(words) == 0
    out, err = capsys.readouterr()
    assert "noise.bin: no ground was found" in err and "a warning" in err
    assert "no ground" in json.loads(out)["reading"]["doubts"][0]
