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
