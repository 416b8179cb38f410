"""Doubts about clouds that no LiDAR gives, and none about those that one gives."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import sample_files as made
from lidar2pano import demo
from lidar2pano.cli import main
from lidar2pano.errors import InputError
from lidar2pano.formats.interpretation import Overrides, interpret
from lidar2pano.formats.plausibility import is_path, repeated_range
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
    assert interpreted(demo.street())[1].doubts == ()


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


S_M = np.linspace(0, 400, 2000)
DRIVE = np.column_stack([S_M, 30 * np.sin(S_M / 60), 0.02 * S_M])
RANDOM = np.random.default_rng(0)


@pytest.mark.parametrize(
    "path",
    [
        DRIVE,
        DRIVE + RANDOM.normal(0, 0.05, DRIVE.shape),
        np.repeat(DRIVE, 3, axis=0),  # it stands now and then
        np.vstack([DRIVE, DRIVE[::-1] + (0, 4, 0)]),  # and comes back on the other side of the road
        np.column_stack([50 * np.cos(S_M / 100), 50 * np.sin(S_M / 100), 0 * S_M]) - (50, 0, 0),
    ],
)
def test_a_path_of_places_is_no_scan(path, tmp_path):
    assert is_path(path)
    np.column_stack([path, 0 * path[:, 0]]).astype("<f4").tofile(tmp_path / "a.bin")
    with pytest.raises(InputError, match=r"a.bin: its points follow each other along a line, as those of a traj"):
        interpreted(tmp_path / "a.bin")


def room(order: str) -> np.ndarray:
    """A cylinder of 10 m around the sensor without anything in it, measured by 16 beams."""
    azimuth, z = np.meshgrid(np.linspace(-np.pi, np.pi, 900), np.linspace(-2, 2, 16))
    return np.stack([10 * np.cos(azimuth), 10 * np.sin(azimuth), z], -1).reshape(-1, 3, order=order)


@pytest.mark.parametrize(
    "scan",
    [
        XYZ,
        XYZ[::50],
        room("C"),
        np.stack(np.meshgrid(np.arange(5, 45, 0.2), np.arange(-20, 20, 0.2), [-1.7]), -1).reshape(-1, 3),  # by rows
    ],
)
def test_scans_are_no_paths(scan):
    assert not is_path(scan)


def test_every_real_scan_is_no_path(kitti_mini: Path):
    for file in sorted(kitti_mini.glob("sequences/*/velodyne/*.bin"))[::16]:
        assert not is_path(np.fromfile(file, "<f4").reshape(-1, 4)[::3, :3]), file


def test_a_scan_without_any_place_is_an_error(tmp_path, capsys):
    """Zeros or NaN, of a driver whose sensor does not turn: it is no picture of nothing."""
    for value in (0, np.nan):
        np.save(tmp_path / "a.npy", np.full((600, 4), value, "<f4"))
        for command in ("inspect", "translate"):
            assert main([command, str(tmp_path / "a.npy")]) == 2
            assert "a.npy: none of its 600 points has a place (all are 0 or NaN)" in capsys.readouterr().err


def test_inspect_says_of_a_narrow_view_what_translate_says(tmp_path, capsys):
    ahead = np.abs(np.arctan2(XYZ[:, 1], XYZ[:, 0])) < np.radians(20)
    np.column_stack([XYZ, REMISSION])[ahead].astype("<f4").tofile(tmp_path / "a.bin")
    assert main(["translate", str(tmp_path / "a.bin")]) == 2
    told = capsys.readouterr().err.strip().partition("a.bin: ")[2]
    assert "of 360 degrees hold points" in told
    assert main(["inspect", str(tmp_path / "a.bin"), "--json"]) == 0
    assert told in json.loads(capsys.readouterr().out)["doubts"]
