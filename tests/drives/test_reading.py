"""Readings of scans: all of a stream like its first one, errors scan by scan."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from lidar2pano.drives.reading import ReadingOptions, ScanSource, StreamReader, move_scan, read_scan, scan_sources
from lidar2pano.errors import InputError
from lidar2pano.formats.interpretation import interpret as formats_interpret
from lidar2pano.formats.point_cloud import PointCloud
from lidar2pano.formats.readers import ReadOptions
from lidar2pano.formats.scan_files import write_bin
from miniature import street

EVERYTHING = ReadOptions()


def source(number: int = 0, count: int = 4000, stream: object = "drive") -> ScanSource:
    """A street's scan."""
    scan = street(number, count)
    cloud = PointCloud(xyz=scan.xyz, intensity=scan.remission)
    return ScanSource(path=Path("a"), title=f"scan {number}", stem="a", cloud=lambda: cloud, stream=stream)


def damaged() -> PointCloud:
    raise InputError("scan 1: is damaged")


def test_the_first_scan_of_a_stream_tells_how_the_others_are_read(monkeypatch):
    likes = []

    def interpret(cloud, overrides, like):
        likes.append(like)
        return formats_interpret(cloud, overrides, like)

    monkeypatch.setattr("lidar2pano.drives.reading.interpret", interpret)
    first, second, third, fourth = StreamReader()([source(0), source(1), source(2, stream="b"), source(3, stream="b")])
    assert likes == [None, first.interpretation, None, third.interpretation]
    assert first.scan.name == "scan 0" and list(second.timer.milliseconds) == ["read"] and fourth.error is None
    likes.clear()
    bad, good, last = StreamReader()([replace(source(0), cloud=damaged), source(1), source(2)])
    assert bad.error and likes == [None, good.interpretation] and last.scan is not None


def test_scans_without_a_stream_are_read_alone():
    first, second = StreamReader()([source(0, stream=None), source(1, stream=None)])
    assert second.interpretation == read_scan(source(1), ReadingOptions()).interpretation != first.interpretation


def test_a_bad_scan_does_not_stop_the_others():
    readings = list(StreamReader()([source(0), replace(source(1), cloud=damaged), source(2)]))
    assert [str(reading.error) for reading in readings] == ["None", "scan 1: is damaged", "None"]
    assert [reading.scan is None for reading in readings] == [False, True, False]


def test_a_doubt_is_an_error_under_strict():
    few = source(0, count=300)
    assert read_scan(few, ReadingOptions()).interpretation.doubts
    error = read_scan(few, ReadingOptions(strict=True)).error
    assert isinstance(error, InputError)
    assert str(error).startswith("scan 0: only 300 of its points") and "because of --strict" in str(error)


def test_motion_moves_a_scan_and_gives_a_pose_only_where_it_is_wanted():
    reading, pose = read_scan(source(), ReadingOptions()), np.eye(4)

    def motion(path, scan, interpretation):
        assert interpretation is reading.interpretation
        return replace(scan, xyz=scan.xyz + 1), pose

    moved = move_scan(reading, motion, poses=False)
    np.testing.assert_array_equal(moved.scan.xyz, reading.scan.xyz + 1)
    assert moved.pose is None and move_scan(reading, motion, poses=True).pose is pose
    assert list(moved.timer.milliseconds) == ["read", "pose"]


def test_unknown_places_are_errors_of_their_scans():
    def motion(path, scan, interpretation):
        raise InputError("poses.txt: has 2 lines, none for frame 000003")

    assert "none for frame" in str(move_scan(read_scan(source(), ReadingOptions()), motion, poses=True).error)


def test_sources_of_files_keep_their_order_and_names(tmp_path):
    files = [tmp_path / name / "000000.bin" for name in ("a", "b")]
    for file in files:
        file.parent.mkdir()
        write_bin(file, street(0, 2000))
    sources = list(scan_sources([files[0], tmp_path / "none.bin", files[1]], EVERYTHING))
    assert [one.stem for one in sources] == ["a-000000", "none", "b-000000"]
    assert [one.stream for one in sources] == [files[0].parent, tmp_path, files[1].parent]
    readings = list(StreamReader()(sources))
    assert [reading.error is None for reading in readings] == [True, False, True]
    assert readings[2].scan.name == str(files[1])
